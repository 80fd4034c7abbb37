"""The workers of a dask scheduler change no bit, however many, and whichever dies; what they lack is told."""

import dataclasses
import os
import signal
import time
from functools import partial

import numpy as np
import pytest

import sfm_shapefit
from sfm_shapefit.adjustment.solve import adjust
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.executors import Crew, WorkerError
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.pairs.estimate import estimate_directions
from sfm_shapefit.pairs.pair_directions import concatenate
from sfm_shapefit.pipeline.execution import DaskWorkers, measure_with_workers
from tests.adjustment.made import disturb
from tests.adjustment.test_iterative import make_wall
from tests.clusters import client_of
from tests.program import run, run_refused
from tests.scenes import COURTYARD, RING, view_of

RING_MODEL, RING_DATABASE = RING / "sparse" / "0", RING / "database.db"


@pytest.fixture(scope="module")
def model(tiny_ring):
    return read_model(tiny_ring / "sparse" / "0")


ESTIMATE = partial(estimate_directions, options=DirectionOptions())


@dataclasses.dataclass
class Counting:
    """Workers that note what they are asked to do, and of which the first leaves before some task.

    It leaves between two tasks, since a thread cannot be killed within one; what it keeps is lost.
    """

    workers: DaskWorkers
    leaves_at: int = -1
    asked: list = dataclasses.field(default_factory=list)

    def submit(self, work, *given):
        if len(self.asked) == self.leaves_at:
            client, cluster = self.workers.client, self.workers.client.cluster
            while any(client.processing().values()):
                time.sleep(0.01)
            cluster.sync(cluster.workers[min(cluster.workers)].close)
        self.asked.append(work.__name__)
        return self.workers.submit(work, *given)


def measured(tiny_ring, model, cluster, estimate=ESTIMATE):
    seen = []
    with view_of(tiny_ring / "database.db", model.images) as view:
        clock = Clock(lambda _stage, *done: seen.append(done), cluster=cluster)
        parts = measure_with_workers(view, estimate, clock, matches_per_task=700)
    return concatenate(parts), seen


def assert_same_bits(a, b):
    for field in dataclasses.fields(a):
        ours, theirs = getattr(a, field.name), getattr(b, field.name)
        if field.name == "status":
            assert list(ours) == list(theirs)
        else:
            np.testing.assert_array_equal(ours, theirs, err_msg=field.name)


def test_directions_of_workers_in_parts_equal_those_of_one_pass_to_the_bit(tiny_ring, model, dask_client):
    cluster = Counting(DaskWorkers(dask_client))
    found, seen = measured(tiny_ring, model, cluster)
    with view_of(tiny_ring / "database.db", model.images) as view:
        assert_same_bits(found, concatenate([ESTIMATE(batch) for batch in view.batches()]))
    assert seen[-1] == (len(found.pairs), len(found.pairs))
    assert cluster.asked.count("measure_part") > 3


def refuse(_batch):
    raise InputError("the database is damaged")


def lack(_batch):
    raise MemoryError("no room\nand more")


def test_what_the_input_lacks_passes_as_it_is_and_what_a_worker_lacks_is_told(tiny_ring, model, dask_client):
    with pytest.raises(InputError, match="the database is damaged"):
        measured(tiny_ring, model, DaskWorkers(dask_client), refuse)
    with pytest.raises(WorkerError, match=r"the workers failed \(no room\); look at their logs"):
        measured(tiny_ring, model, DaskWorkers(dask_client), lack)


def columns(adjusted):
    solved = adjusted.problem
    return solved.centers, solved.rotations, solved.points, adjusted.costs


@pytest.mark.parametrize(("workers", "leaves_at"), [(1, -1), (3, -1), (3, 14)])
def test_an_adjustment_in_parts_is_the_same_for_any_number_of_workers_one_of_which_dies(workers, leaves_at):
    start = disturb(make_wall((20, 30)), np.random.default_rng(1), center=0.01, rotation_rad=1e-3, point=0.01)
    steps = {"max_iterations": 2, "settles_points": True}
    here = adjust(start, crew=Crew(1), **steps)
    with client_of(workers) as client:
        cluster = Counting(DaskWorkers(client), leaves_at)
        there = adjust(start, crew=Crew(2, cluster), **steps)
        assert len(client.scheduler_info()["workers"]) == workers - (leaves_at >= 0)
    assert cluster.asked.count("lay_out") == 3
    for ours, theirs in zip(columns(here), columns(there), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.slow
def test_a_process_that_is_killed_is_replaced(tiny_ring, model, tmp_path):
    flag, alone = tmp_path / "killed", ESTIMATE
    with client_of(2, processes=True) as client:
        found, _ = measured(tiny_ring, model, DaskWorkers(client), partial(die_once, str(flag)))
    assert flag.exists()
    with view_of(tiny_ring / "database.db", model.images) as view:
        assert_same_bits(found, concatenate([alone(batch) for batch in view.batches()]))


def die_once(flag, batch):
    """Kill the first worker that comes here, in the middle of the work."""
    try:
        os.close(os.open(flag, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return ESTIMATE(batch)
    return os.kill(os.getpid(), signal.SIGKILL)


def files_of(folder):
    """Return the bytes of the files of a model and its tables; JSON has timings."""
    return {one.name: one.read_bytes() for one in folder.rglob("*") if one.suffix in (".bin", ".csv")}


@pytest.mark.parametrize(("command", "source"), [("locate", RING_MODEL), ("map", RING_DATABASE)])
def test_a_command_with_a_scheduler_writes_the_same_bytes(command, source, tmp_path, dask_client):
    address = dask_client.cluster.scheduler_address
    run(command, source, tmp_path / "there", "--scheduler", address, "--no-report", "-q", code=0)
    run(command, source, tmp_path / "here", "--no-report", "-q", code=0)
    here = files_of(tmp_path / "here")
    assert {"images.bin", "points3D.bin", "cameras.csv", "pairs.csv"} <= set(here)
    assert files_of(tmp_path / "there") == here


def test_adjustments_in_parts_for_memory_write_the_same_bytes_with_a_scheduler(tmp_path, dask_client):
    limit = int(sfm_shapefit.inspect(RING_MODEL).expected.peak_mb)
    found, alone = (
        sfm_shapefit.locate(RING_MODEL, max_memory_mb=limit, client=client) for client in (dask_client, None)
    )
    (said,) = (text for text in alone.warnings if text.startswith("to stay below"))
    assert "adjustments go part by part" in said
    assert "not adjusted" not in said
    for result, name in ((found, "there"), (alone, "here")):
        result.write(tmp_path / name, report=False)
    assert files_of(tmp_path / "there") == files_of(tmp_path / "here")


def test_no_scheduler_at_an_address_is_told_in_a_sentence(tmp_path):
    said = run_refused("locate", RING_MODEL, tmp_path / "out", "--scheduler", "nonsense://1", "-q")
    assert "the dask scheduler nonsense://1 cannot be reached; check its address" in said
    assert list(tmp_path.iterdir()) == []


def test_a_scheduler_that_is_gone_is_told(tiny_ring, model):
    with client_of(1) as client:
        client.close()
        with pytest.raises(WorkerError, match=r"the workers failed \(Client is closed.* look at their logs"):
            measured(tiny_ring, model, DaskWorkers(client))


def test_a_scheduler_without_workers_is_told():
    with (
        client_of(0) as client,
        pytest.raises(WorkerError, match="has no worker; start one"),
    ):
        sfm_shapefit.map_database(COURTYARD / "database.db", client=client)


class Elsewhere:
    """A client one of whose workers is on a machine where something is otherwise."""

    def __init__(self, change):
        self.change = change

    def run(self, look, path, **_options):
        return {"tcp://a": look(path), "tcp://b": self.change(look(path))}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda seen: seen._replace(size=seen.size + 1), "does not see .*database.db as it is here; share"),
        (lambda seen: seen._replace(modified_ns=0), "does not see .*database.db as it is here; share"),
        (lambda seen: seen._replace(version="0"), "has sfm_shapefit 0; install version"),
        (lambda _seen: ModuleNotFoundError("sfm_shapefit"), "has no sfm_shapefit; install version"),
    ],
)
def test_a_worker_that_lacks_the_database_or_the_package_is_named_before_anything_is_measured(change, words):
    with pytest.raises(WorkerError, match=f"the worker tcp://b {words}"):
        sfm_shapefit.locate(RING_MODEL, RING_DATABASE, client=Elsewhere(change))


def test_the_option_before_is_answered(tmp_path):
    said = run("locate", RING_MODEL, tmp_path / "out", "--executor", "processes", code=2).output
    assert "--executor is gone: threads share all work; for other machines there is --scheduler" in said
