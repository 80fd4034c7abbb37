"""Directions measured by other processes equal those of one; a worker that dies is replaced or reported."""

import dataclasses
import os
import signal
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context

import numpy as np
import pytest

from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.pairs.estimate import estimate_directions
from sfm_shapefit.pairs.pair_directions import concatenate
from sfm_shapefit.pipeline.execution import (
    WorkerError,
    interrupts_wait,
    measure_part,
    measure_with_workers,
    open_executor,
)
from tests.program import run_python
from tests.scenes import view_of


@pytest.fixture(scope="module")
def model(tiny_ring):
    return read_model(tiny_ring / "sparse" / "0")


ESTIMATE = partial(estimate_directions, options=DirectionOptions())


def serial(tiny_ring, model):
    with view_of(tiny_ring / "database.db", model.images) as view:
        (part,) = view.parts(10**9)
    (found,) = measure_part(ESTIMATE, 1, part)
    return found


def shared(tiny_ring, model, executor, estimate=ESTIMATE):
    seen = []
    with view_of(tiny_ring / "database.db", model.images) as view:
        clock = Clock(lambda _stage, *done: seen.append(done), executor=executor)
        parts = measure_with_workers(view, estimate, clock, matches_per_task=700)
    return concatenate(parts), seen


def assert_same_bits(a, b):
    for field in dataclasses.fields(a):
        ours, theirs = getattr(a, field.name), getattr(b, field.name)
        if field.name == "status":
            assert list(ours) == list(theirs)
        else:
            np.testing.assert_array_equal(ours, theirs, err_msg=field.name)


def test_directions_of_threads_in_parts_equal_those_of_one_pass_to_the_bit(tiny_ring, model):
    with ThreadPoolExecutor(2) as pool:
        found, seen = shared(tiny_ring, model, pool)
    assert_same_bits(found, serial(tiny_ring, model))
    assert seen[-1] == (len(found.pairs), len(found.pairs))


def _die(*_given):
    os._exit(1)


@pytest.mark.slow
def test_a_worker_that_dies_in_a_pool_is_reported(tiny_ring, model):
    with (
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool,
        pytest.raises(WorkerError, match=r"a worker failed .* run again"),
    ):
        shared(tiny_ring, model, pool, _die)


def test_an_error_of_the_input_passes_as_it_is(tiny_ring, model):
    def refuse(*_given):
        raise InputError("the database is damaged")

    with ThreadPoolExecutor(1) as pool, pytest.raises(InputError, match="the database is damaged"):
        shared(tiny_ring, model, pool, refuse)


def die_once(flag, batch):
    """Kill the first worker that comes here, in the middle of the work."""
    try:
        os.close(os.open(flag, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        time.sleep(0.05)
        return ESTIMATE(batch)
    os._exit(1)


@pytest.mark.slow
def test_dask_gives_the_work_of_a_killed_worker_to_another(tiny_ring, model, tmp_path):
    pytest.importorskip("distributed")
    flag = tmp_path / "killed"
    with open_executor("dask", 2) as pool:
        found, _ = shared(tiny_ring, model, pool, partial(die_once, str(flag)))
    assert flag.exists()
    assert_same_bits(found, serial(tiny_ring, model))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["processes", "dask"])
def test_an_interrupt_of_all_processes_is_the_business_of_the_first_one(kind):
    if kind == "dask":
        pytest.importorskip("distributed")
    script = """
import os, signal, sys, time
os.setsid()
from sfm_shapefit.pipeline.execution import open_executor
try:
    with open_executor(sys.argv[1], 2) as pool:
        list(pool.map(abs, range(20)))  # all workers are there, and wait
        os.killpg(os.getpgrp(), signal.SIGINT)  # as a terminal does
        time.sleep(60)
except KeyboardInterrupt:
    sys.exit(130)
"""
    done = run_python("-c", script, kind)
    assert (done.returncode, done.stderr) == (130, "")


def test_an_interrupt_while_a_cluster_opens_comes_when_it_can_be_closed():
    done, before = [], signal.getsignal(signal.SIGINT)

    def open_cluster():
        with interrupts_wait():
            signal.raise_signal(signal.SIGINT)
            done.append(1)

    with pytest.raises(KeyboardInterrupt):
        open_cluster()
    assert done == [1]
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.slow
def test_a_second_cluster_on_a_machine_opens_without_a_word_and_one_is_found_by_its_address(recwarn):
    distributed = pytest.importorskip("distributed")
    with (
        open_executor("dask", 1) as first,
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0") as other,
        open_executor(f"dask:{other.scheduler_address}", 1) as found,
    ):
        assert [pool.submit(abs, -2).result() for pool in (first, found)] == [2, 2]
        assert found.submit(os.getpid).result() in {worker.pid for worker in other.workers.values()}
    assert [str(warning.message) for warning in recwarn if "Port" in str(warning.message)] == []


def test_no_scheduler_at_an_address_is_reported():
    pytest.importorskip("distributed")
    with pytest.raises(WorkerError, match="cannot be reached"), open_executor("dask:nonsense://1", 1):
        pass
