"""Interrupts and lack of memory end a command in one sentence."""

import signal

import pytest

from sfm_shapefit.cli import console
from tests.program import run_python
from tests.scenes import RING


@pytest.mark.parametrize(
    ("error", "received", "code", "words"),
    [
        (
            RuntimeError("Caught an unknown exception!"),
            [signal.SIGINT],
            130,
            "interrupted; nothing was written",
        ),
        (MemoryError(), [], 3, "memory"),
        (RuntimeError("can't start new thread"), [], 3, "memory"),
    ],
)
def test_what_native_code_makes_of_an_interrupt_and_lack_of_memory_are_one_sentence(
    capsys, monkeypatch, error, received, code, words
):
    monkeypatch.setattr(console, "_received", received)
    with pytest.raises(console.typer.Exit) as caught, console.report_errors():
        raise error
    assert caught.value.exit_code == code
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1
    monkeypatch.setattr(console, "_received", [])
    with pytest.raises(ZeroDivisionError), console.report_errors():  # a defect of ours stays visible
        raise ZeroDivisionError


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
