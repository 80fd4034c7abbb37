"""How often each command does what is dear: these numbers may fall, and must never rise.

A run that does more than `COUNTS` says does work twice: find out why, and do not raise the number. A run that
does less has been made cheaper: lower the number, so that it stays so.

| quantity | what it counts |
|---|---|
| passes | pairs whose matches are read or gone through again, over those of the largest pass; rounded up |
| solves | solves of the convex program with a certificate |
| assessments | full judgements of a placement: verdicts of pairs, covariances and trust of cameras |
| openings | connections to the user's database |
| conversions | models that are read or written, and pycolmap.Reconstructions that are made or copied |

Each is counted at the points of `POINTS`, the only table that changes where code moves.
"""

import inspect
import math
import sys
from collections import Counter
from contextlib import ExitStack, contextmanager
from functools import partial
from importlib import import_module
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import pytest

from sfm_shapefit.synthetic import SceneOptions, WorkspaceOptions, make_rig_drive
from sfm_shapefit.synthetic.workspace import write_workspace
from tests.program import run
from tests.scenes import BUNDLED, COURTYARD, RING, copied, edit_database

POINTS = {
    "pairs": (
        "sfm_shapefit.scene.matches:View.batches",
        "sfm_shapefit.scene.matches:View.between",
        "sfm_shapefit.scene.matches:View.links",
        "sfm_shapefit.scene.matches:View.of_pairs",
    ),
    "solves": ("sfm_shapefit.solver.certificate:certify_as_asked",),
    "assessments": ("sfm_shapefit.judgement.verdicts:assess",),
    "openings": ("sqlite3:connect", "pycolmap:Database.open"),
    "conversions": (
        *("pycolmap:Reconstruction.__init__", "pycolmap:Reconstruction.__copy__"),
        *("pycolmap:Reconstruction.__deepcopy__", "pycolmap:Reconstruction.read"),
        *("pycolmap:Reconstruction.write", "pycolmap:Reconstruction.write_text"),
        "sfm_shapefit.files.colmap.read_binary:read_files",
        "sfm_shapefit.files.colmap.write_binary:write_binary",
    ),
}
"""Functions and methods, each after its module; those of `pairs` yield batches that have `pairs`."""


class Counts(NamedTuple):
    passes: int
    solves: int
    assessments: int
    openings: int
    conversions: int


PAIR = 2147483647  # COLMAP's pair_id is id1 * this + id2
GUESS = np.array([850.0, 850.0, 600.0, 450.0], dtype="<f8").tobytes().hex()
EDITS = {
    "hinged": f"""DELETE FROM two_view_geometries WHERE
        min(pair_id / {PAIR}, pair_id % {PAIR}) < 4 AND max(pair_id / {PAIR}, pair_id % {PAIR}) > 4""",
    "apart": f"DELETE FROM two_view_geometries WHERE (pair_id / {PAIR} <= 4) != (pair_id % {PAIR} <= 4)",
    "guessed": f"UPDATE cameras SET params = x'{GUESS}', prior_focal_length = 0",
}
"""The ring as two pieces that share its fourth camera, as two components, and with a guessed lens."""

# Command line: passes, solves, assessments, openings, conversions.
COUNTS = {
    "locate COURTYARD/sparse/0 OUT": Counts(4, 1, 1, 1, 2),
    "locate COURTYARD/sparse/0 OUT --adjust full": Counts(4, 1, 1, 1, 2),
    "locate RING/sparse/0 OUT --config TRACKS": Counts(2, 1, 1, 0, 2),
    "locate RIGS/sparse/0 OUT": Counts(3, 1, 1, 1, 2),
    "locate HINGED/sparse/0 OUT --points never": Counts(4, 2, 2, 1, 3),
    "map PHOTOGRAPHED/database.db OUT": Counts(7, 1, 1, 1, 1),
    "map GUESSED/database.db OUT": Counts(9, 1, 1, 1, 1),
    "map APART/database.db OUT": Counts(7, 2, 2, 1, 2),
    "place GRAPH OUT": Counts(0, 3, 1, 0, 0),  # triangles and posteriors are starts, too
    "inspect COURTYARD/sparse/0": Counts(2, 0, 0, 1, 1),
    "check COURTYARD/truth --report OUT": Counts(8, 1, 1, 1, 1),
    "check COURTYARD/truth --report OUT --no-second-opinion": Counts(2, 0, 0, 1, 1),
}


class Meter:
    """Counts calls at the points while `at_work`; a call within another of its quantity is a part of that."""

    def __init__(self, database):
        self._database = database
        self._counted, self._depth, self._largest_pass = Counter(), Counter(), 1

    @contextmanager
    def at_work(self):
        with ExitStack() as stack:
            for quantity, points in POINTS.items():
                for point in points:
                    stack.enter_context(_replaced(point, partial(self._wrap, quantity)))
            yield

    def _wrap(self, quantity, call):
        def counting(*args, **kwargs):
            is_one = quantity != "openings" or str(self._database) in str(args[0])
            self._counted[quantity] += is_one and self._depth[quantity] == 0
            self._depth[quantity] += 1
            try:
                return call(*args, **kwargs)
            finally:
                self._depth[quantity] -= 1

        def counting_batches(*args, **kwargs):
            num_pairs = 0
            for batch in call(*args, **kwargs):
                num_pairs += len(batch.pairs)
                yield batch
            self._counted[quantity] += num_pairs
            self._largest_pass = max(self._largest_pass, num_pairs)

        return counting_batches if quantity == "pairs" else counting

    def counts(self):
        others = [self._counted[quantity] for quantity in Counts._fields[1:]]
        return Counts(math.ceil(self._counted["pairs"] / self._largest_pass), *others)


@contextmanager
def _replaced(point, wrap):
    """Replace a method in its class, or a function in every module of the package that has it."""
    module, _, path = point.partition(":")
    owner, *names = import_module(module), *path.split(".")
    for name in names[:-1]:
        owner = getattr(owner, name)
    call, is_static = getattr(owner, names[-1]), False
    if inspect.isclass(owner):
        is_static = isinstance(inspect.getattr_static(owner, names[-1]), staticmethod)
    wrapped = wrap(call)
    with patch.object(owner, names[-1], staticmethod(wrapped) if is_static else wrapped):
        _rebind(call, wrapped)
        try:
            yield
        finally:
            _rebind(wrapped, call)  # in modules too that were loaded meanwhile


def _rebind(old, new):
    """Let all modules of the package have one function in place of another."""
    modules = [module for name, module in sys.modules.items() if name.partition(".")[0] == "sfm_shapefit"]
    for module in modules:
        for name in [name for name, value in vars(module).items() if value is old]:
            setattr(module, name, new)


@pytest.fixture(scope="module")
def workspaces(tmp_path_factory):
    """Paths by the words that stand for them in command lines."""
    folder = tmp_path_factory.mktemp("work")
    made = {"COURTYARD": COURTYARD, "RING": RING, "PHOTOGRAPHED": BUNDLED / "photographed"}
    made["GRAPH"] = BUNDLED / "graph40.txt"
    made["TRACKS"] = folder / "tracks.toml"
    made["TRACKS"].write_text('directions = "tracks"')
    for name, statement in EDITS.items():
        (folder / name).mkdir()
        made[name.upper()] = copied(RING, folder / name)
        edit_database(made[name.upper()] / "database.db", statement)
    made["RIGS"] = folder / "rigs"
    drive = make_rig_drive(SceneOptions(seed=0, num_images=18, num_points=800, max_pairs_per_image=12))
    write_workspace(drive, made["RIGS"], WorkspaceOptions(model="rotations"))
    return made


def measured(line, workspaces, out, times=1):
    """Run a command some times, and return its counts."""
    source, _, _ = line.split()[1].partition("/")
    meter = Meter(workspaces[source] / "database.db")
    words = [str(out) if word == "OUT" else word for word in line.split()]
    words = [word.replace(source, str(workspaces[source]), 1) for word in words]
    words = [str(workspaces.get(word, word)) for word in words]
    with meter.at_work():
        for _ in range(times):
            run(*words, code=0)
    return meter.counts()


@pytest.mark.parametrize("line", COUNTS)
def test_no_command_does_more_than_it_did(line, workspaces, tmp_path):
    assert measured(line, workspaces, tmp_path / "out") == COUNTS[line], (
        "if a number is lower than in COUNTS, lower it there; if one is higher, find what is done twice"
    )


def test_what_is_done_twice_counts_twice(workspaces, tmp_path):
    line = next(line for line in COUNTS if line.startswith("inspect"))
    assert measured(line, workspaces, tmp_path, times=2) == tuple(2 * number for number in COUNTS[line])
