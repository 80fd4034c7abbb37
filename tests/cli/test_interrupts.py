"""Interrupts and lack of memory end a command in one sentence."""

import pytest

from sfm_shapefit.cli import console
from tests.program import run_python
from tests.scenes import RING


@pytest.mark.parametrize(
    ("error", "words"),
    [(MemoryError(), "memory"), (RuntimeError("can't start new thread"), "memory")],
)
def test_lack_of_memory_is_one_sentence(capsys, error, words):
    with pytest.raises(console.typer.Exit) as caught, console.report_errors():
        raise error
    assert caught.value.exit_code == 3
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1
    with pytest.raises(ZeroDivisionError), console.report_errors():  # a defect of ours stays visible
        raise ZeroDivisionError


SWALLOWED = """
import os, signal, sys, typer
from sfm_shapefit.cli.console import catch_termination, report_errors
catch_termination()
try:
    with report_errors():
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt:
            raise RuntimeError("Caught an unknown exception!") from None
except typer.Exit as ending:
    sys.exit(ending.exit_code)
"""


def test_what_native_code_makes_of_an_interrupt_is_told_as_one():
    done = run_python("-c", SWALLOWED)
    assert (done.returncode, done.stderr) == (130, "sfm-shapefit: interrupted; nothing was written\n")


def test_an_interrupt_that_a_callback_of_native_code_loses_comes_again_without_a_traceback():
    script = """
import ctypes, os, signal, sys, time
from sfm_shapefit.cli import console
console.catch_termination()
console.repeat_lost_interrupts()
try:
    ctypes.CFUNCTYPE(None)(lambda: os.kill(os.getpid(), signal.SIGTERM))()
    time.sleep(20)
except KeyboardInterrupt:
    sys.exit(130)
"""
    done = run_python("-c", script)
    assert (done.returncode, done.stderr) == (130, "")


def test_an_address_space_too_small_for_the_libraries_is_refused_at_once(tmp_path):
    limit = "import os, resource, sys; resource.setrlimit(resource.RLIMIT_AS, (512_000_000,) * 2); "
    start = "os.execv(sys.executable, [sys.executable, '-m', 'sfm_shapefit.cli', *sys.argv[1:]])"
    done = run_python("-c", limit + start, "locate", RING / "sparse/0", tmp_path / "out")
    assert done.returncode == 3
    assert "512 MB of address space" in done.stderr
    assert done.stderr.count("\n") == 1
