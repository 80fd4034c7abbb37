"""`warm-up`: everything is compiled beforehand, by several processes, and nothing afterwards."""

import inspect as python_inspect
import os
from multiprocessing import Pipe

import pytest

from sfm_shapefit.base import kernel_cache
from sfm_shapefit.laplacian import cholesky, operators, ordering
from sfm_shapefit.pipeline import examples
from sfm_shapefit.pipeline import warm_up as module
from sfm_shapefit.pipeline.warm_up import FURTHER, NEEDED, WarmUp, compile_together, warm_up
from sfm_shapefit.solver.splitting.anderson import Anderson
from tests.program import run, run_python


def test_every_example_is_run():
    defined = [
        name
        for name, value in vars(examples).items()
        if python_inspect.isfunction(value) and value.__module__ == examples.__name__ and name[0] != "_"
    ]
    assert sorted(defined) == sorted(NEEDED + FURTHER)


def test_examples_call_the_kernels_of_large_and_of_exact_graphs(tmp_path, monkeypatch):
    called = set()

    def hear(owner, name):
        function = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *given: called.add(name) or function(*given))

    hear(cholesky, "gemm")
    hear(Anderson, "advance")
    hear(operators, "_apply_entries")
    hear(ordering, "_distances")
    examples.solve_sparse(tmp_path)
    examples.solve_by_splitting(tmp_path)
    examples.solve_iteratively(tmp_path)
    assert called == {"gemm", "advance", "_apply_entries", "_distances"}


def test_an_example_tells_of_its_kernels_and_one_that_fails_says_why():
    told = []
    done = warm_up(["find_pieces", "no_such_example"], lambda ready, total: told.append((ready, total)))
    assert done.num_kernels >= 3
    (sentence,) = done.failures
    assert sentence.startswith("no_such_example: AttributeError: ")
    ready, totals = zip(*told, strict=True)
    assert list(ready) == sorted(ready)
    assert 3 <= ready[-1] < totals[0] == len(module._kernels(only_needed=False))
    assert kernel_cache.is_noted("find_pieces", kernel_cache.PACKAGE / "pipeline")
    assert not kernel_cache.is_noted("no_such_example", kernel_cache.PACKAGE / "pipeline")


def test_processes_that_die_are_told_of(monkeypatch):
    monkeypatch.setattr(module, "num_cores", lambda: 2)
    monkeypatch.setattr(module, "_work", os.abort)  # which takes no argument, so that they end at once
    done = warm_up(["find_pieces", "place_graph"])
    assert done == WarmUp(0, ("find_pieces, place_graph: no process is left to run it",))


def test_what_a_process_that_is_killed_at_work_leaves_goes(tmp_path, monkeypatch):
    monkeypatch.setattr(module.tempfile, "tempdir", str(tmp_path))
    heard = module._run(["find_pieces"], 1)
    next(heard)
    assert list(tmp_path.glob("*/find_pieces"))
    heard.close()
    assert not list(tmp_path.iterdir())


def test_processes_look_for_garbage_as_often_as_the_one_that_began_them(monkeypatch):
    thresholds = []
    monkeypatch.setattr(module.gc, "set_threshold", lambda *given: thresholds.append(given))
    monkeypatch.setattr(module.signal, "signal", lambda *_: None)
    ours, theirs = Pipe()
    ours.send("")
    module._work(theirs, "", (50_000, 20, 100))
    assert thresholds == [(50_000, 20, 100)]


def test_where_no_process_can_be_started_a_command_compiles_alone(monkeypatch):
    monkeypatch.setattr(module, "num_cores", lambda: 2)
    monkeypatch.setattr(module, "not_done", list)
    monkeypatch.setattr("multiprocessing.get_context", no_process)
    with compile_together(print, print):
        miss()


def no_process(_how):
    raise OSError("no more processes")


@pytest.fixture
def asked(monkeypatch):
    """Warm-ups that a command asks for; none is done."""
    calls = []
    monkeypatch.setattr(module, "warm_up", lambda names, _tell: calls.append(list(names)))
    monkeypatch.setattr(module, "num_cores", lambda: 2)
    return calls


def miss():
    """Miss a kernel, as a cache does."""
    for act in list(kernel_cache._missed):
        act()


def test_a_miss_asks_for_the_examples_that_never_ran(asked, monkeypatch):
    monkeypatch.setattr(module, "is_noted", lambda name, _folder: name != "solve_dense")
    with compile_together(print, print):
        miss()
    assert asked == [["solve_dense"]]
    monkeypatch.setattr(module, "num_cores", lambda: 1)
    with compile_together(print, print):
        miss()
    monkeypatch.setattr(module, "is_noted", lambda _name, _folder: True)
    monkeypatch.setattr(module, "num_cores", lambda: 2)
    with compile_together(print, print):
        miss()
    miss()  # outside of any block
    assert len(asked) == 1


def test_a_wheel_for_another_numba_is_told_of(asked, monkeypatch):
    monkeypatch.setattr(module, "made_for", lambda: "py311-numba0.61 on x86-64-v3")
    monkeypatch.setattr(module, "is_noted", lambda _name, _folder: True)
    said = []
    with compile_together(print, said.append):
        miss()
    (sentence,) = said
    assert "py311-numba0.61 on x86-64-v3" in sentence
    assert kernel_cache.here() in sentence
    monkeypatch.setattr(module, "made_for", kernel_cache.here)
    with compile_together(print, said.append):
        miss()
    assert len(said) == 1


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
from sfm_shapefit.pipeline import warm_up
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
