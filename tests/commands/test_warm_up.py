"""`warm-up`: everything is compiled beforehand, by several processes, and nothing afterwards."""

import inspect as python_inspect

import pytest
from numba.core import config

from sfm_shapefit.base import kernel_cache
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.commands import examples, part_examples
from sfm_shapefit.commands import warm_up as module
from sfm_shapefit.commands.warm_up import FURTHER, NEEDED, WarmUp, compile_together, not_done, warm_up
from tests.program import run, run_python


def test_every_example_is_run():
    defined = [
        name
        for source in (examples, part_examples)
        for name, value in vars(source).items()
        if python_inspect.isfunction(value) and value.__module__ == source.__name__ and name[0] != "_"
        if [one.lstrip("_") for one in python_inspect.signature(value).parameters] == ["folder"]
    ]
    assert sorted(defined) == sorted(NEEDED + FURTHER)


HEAR = """
import sys, tempfile
from pathlib import Path
from sfm_shapefit.base.kernel_cache import hear_of_kernels
from sfm_shapefit.commands import part_examples
heard = set()
with hear_of_kernels(heard.add), tempfile.TemporaryDirectory() as folder:
    for name in ("solve_sparse", "solve_by_splitting", "solve_iteratively"):
        getattr(part_examples, name)(Path(folder))
print(*heard)
"""


def test_examples_call_the_kernels_of_large_and_of_exact_graphs():
    done = run_python("-c", HEAR)
    heard = set(done.stdout.split())
    assert heard >= {"operators._apply_entries", "ordering._distances", "dense.gemm", "anderson._combine"}, (
        done.stderr
    )


def test_an_example_tells_of_its_kernels_and_one_that_fails_says_why():
    told = []
    done = warm_up(["find_pieces", "no_such_example"], lambda ready, total: told.append((ready, total)))
    assert done.num_kernels >= 3
    (sentence,) = done.failures
    assert sentence.startswith("no_such_example: AttributeError: ")
    ready, totals = zip(*told, strict=True)
    assert list(ready) == sorted(ready)
    assert 3 <= ready[-1] < totals[0]
    assert 100 < totals[0] < 1000
    assert kernel_cache.is_noted("find_pieces", kernel_cache.PACKAGE / "commands")
    assert not kernel_cache.is_noted("no_such_example", kernel_cache.PACKAGE / "commands")


KILLED = """
import multiprocessing, os
from pathlib import Path
from sfm_shapefit.commands.warm_up import warm_up
scratch = Path(os.environ["TMPDIR"])
def kill(_ready, _total):
    print(len(list(scratch.glob("*/find_pieces"))))
    for child in multiprocessing.active_children():
        child.kill()
if __name__ == "__main__":
    print(*warm_up(["find_pieces"], kill).failures, sep="|")
    print(len(list(scratch.iterdir())))
"""


def test_processes_that_die_are_told_of_and_what_they_leave_goes(tmp_path):
    (tmp_path / "killed.py").write_text(KILLED)
    (tmp_path / "tmp").mkdir()
    done = run_python(tmp_path / "killed.py", TMPDIR=str(tmp_path / "tmp"))
    *heard, failures, left = done.stdout.splitlines()
    assert heard, done.stderr
    assert set(heard) == {"1"}
    assert (failures, left) == ("find_pieces: its process died", "0")


@pytest.fixture
def cold(tmp_path, monkeypatch):
    """No kernel is at hand, and no example was ever run."""
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "cache"))


def compile_anew(say):
    """Call a new kernel in a command; return its answer."""
    with compile_together(print, say):
        return kernel(lambda x: 2 * x)(21)


def test_where_no_process_can_be_started_a_command_compiles_alone(cold, monkeypatch):
    monkeypatch.setattr("multiprocessing.get_context", no_process)
    assert compile_anew(print) == 42


def no_process(_how):
    raise OSError("no more processes")


def test_what_is_not_done_are_the_examples_that_never_ran(cold):
    assert not_done() == [*NEEDED, *FURTHER]
    for name in NEEDED[1:]:
        kernel_cache.note(name, kernel_cache.PACKAGE / "commands")
    assert not_done(NEEDED) == [NEEDED[0]]


@pytest.mark.parametrize("other", ["py311-numba0.61 on x86-64-v3", ""])
def test_a_wheel_for_another_numba_is_told_of(cold, monkeypatch, other):
    monkeypatch.setattr(module, "made_for", lambda: other or kernel_cache.here())
    for name in NEEDED:  # so that a miss starts no process
        kernel_cache.note(name, kernel_cache.PACKAGE / "commands")
    said = []
    assert compile_anew(said.append) == 42
    assert len(said) == bool(other)
    assert all(other in sentence and kernel_cache.here() in sentence for sentence in said)


def test_the_command_says_what_is_ready_or_what_failed(monkeypatch):
    outcome = [WarmUp(7, ())]
    monkeypatch.setattr(module, "warm_up", lambda _names, tell: (tell and tell(7, 7)) or outcome[0])
    done = run("warm-up", code=0)
    assert "7 ready on disk" in done.stdout
    assert done.stderr == ""  # which says how far it is after ten seconds
    assert run("warm-up", "-q", code=0).output == ""
    outcome[0] = WarmUp(0, ())
    assert "since before" in run("warm-up", code=0).stdout
    outcome[0] = WarmUp(6, ("an example: an error",))
    assert run("warm-up", code=3).stderr.endswith("sfm-shapefit: an example: an error\n")


COLD = """
import numpy as np
from sfm_shapefit.cli.progress import show_progress
from sfm_shapefit.commands import warm_up
from sfm_shapefit.graph.rigidity import parallel_rigid_pieces
warm_up.NEEDED = ("find_pieces",)
with show_progress(True, verbose=True):
    parallel_rigid_pieces(4, np.array([(0, 1), (1, 2), (2, 3), (3, 0)]), 3)
"""


@pytest.mark.slow
@pytest.mark.skipif(module.num_cores() < 2, reason="a single core compiles alone")
def test_a_cold_command_lets_other_processes_compile_and_says_how_far_they_are(tmp_path):
    """With one example in place of all; `.ci/run` sees that all of them leave nothing to compile."""
    cache = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    done = run_python("-c", COLD, **cache)
    assert done.returncode == 0, done.stderr[-500:]
    assert "sfm-shapefit: compiling kernels, once" in done.stderr
    assert list((tmp_path / "cache").rglob("find_pieces-*"))
