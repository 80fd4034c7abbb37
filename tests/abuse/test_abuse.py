"""Hostile input, faults, determinism and many calls: short rounds of `python -m tests.abuse`."""

import gc
import os
import resource
from pathlib import Path

import numpy as np
import pytest

from sfm_shapefit.commands.locate import locate
from sfm_shapefit.commands.write import write_result
from tests.abuse import determinism, verdicts
from tests.abuse.fuzz import make_base
from tests.program import run_python
from tests.scenes import COURTYARD, FACADE, RING, fingerprint


def test_damaged_inputs_end_in_a_correct_result_or_one_sentence():
    # Every kind of damage is among them, at least twice.
    done = run_python("-m", "tests.abuse", "fuzz", "--cases", 40, "--seed", 0)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "40 cases, 0 failed" in done.stdout


SINS = """
import os, signal, sys
from pathlib import Path
from tests.abuse import sandbox, verdicts

def traceback(): raise ZeroDivisionError
def crash(): os.kill(os.getpid(), signal.SIGSEGV)
def outside(): Path("../stray").write_text("x")
def network():
    import socket
    socket.socket()
def shell(): os.system("true")
def memory(): bytearray(3 * 10**9)
def chatter(): print("sfm-shapefit: one\\nand two", file=sys.stderr); sys.exit(3)
def loop():
    import resource
    resource.setrlimit(resource.RLIMIT_CPU, (1, 2))
    while True: pass
def good(): Path("inside").write_text("x"); sys.exit(0)

work = Path(sys.argv[1])
for sin in (traceback, crash, outside, network, shell, memory, chatter, loop, good):
    outcome = sandbox.run_forked(sin, work, [work])
    print(sin.__name__, "; ".join(verdicts.faults(outcome)), sep=": ")
"""


def test_the_sandbox_sees_every_sin(tmp_path):
    (tmp_path / "work").mkdir()
    done = run_python("-c", SINS, tmp_path / "work")
    assert done.returncode == 0, done.stderr
    seen = dict(line.split(": ", 1) for line in done.stdout.splitlines())
    words = {
        "traceback": "a traceback",
        "crash": "signal 11",
        "outside": "did open",
        "network": "did socket",
        "shell": "did os.system",
        "memory": "a traceback",
        "chatter": "not one sentence",
        "loop": "signal 24",
    }
    for sin, word in words.items():
        assert word in seen[sin], sin
    assert seen["good"] == ""


def test_the_verdict_sees_a_changed_input_and_another_answer(tmp_path):
    (tmp_path / "a").write_text("1")
    (tmp_path / "b").symlink_to("a")
    before = fingerprint(tmp_path)
    (tmp_path / "a").write_text("2")
    assert fingerprint(tmp_path) != before
    assert not verdicts.differs([(1.0, 0.0, 0.0)], [(1.0 + 1e-8, 0.0, 0.0)])
    assert verdicts.differs([(1.0, 0.0, 0.0)], [(1.0 + 1e-5, 0.0, 0.0)])
    assert verdicts.differs([], [(1.0, 0.0, 0.0)])


def test_signals_limits_rivals_and_locks_leave_output_and_input_whole():
    done = run_python("-m", "tests.abuse", "faults", "--moments", 2, "--cold", 0, "--rivals", 1, "--rooms", 1)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("held") == 14


@pytest.mark.parametrize(
    ("scene", "adjust", "most"),
    [
        (FACADE, "none", 1e-12),
        (COURTYARD, "none", 1e-12),
        # The adjustment ends where a step lowers the cost by less than 1e-5 of it.
        (RING, "seed", 1e-5),
    ],
)
def test_the_order_of_images_pairs_matches_and_points_does_not_matter(scene, adjust, most, tmp_path):
    assert determinism.measure_reordering(scene, tmp_path, seed=1, adjust=adjust) <= most


def test_reordering_changes_every_file_of_the_input(tmp_path):
    copy = determinism.reorder(RING, tmp_path / "copy", determinism.np.random.default_rng(1))
    for file in ("sparse/0/images.bin", "sparse/0/points3D.bin", "sparse/0/frames.bin", "database.db"):
        assert (copy / file).read_bytes() != (RING / file).read_bytes()


@pytest.mark.slow
def test_no_variant_of_a_run_changes_a_byte(tmp_path):
    assert list(determinism.differing_files(COURTYARD, tmp_path, always=("--adjust", "full"))) == []


WARM_UP = 10
"""Calls in which caches and allocators fill."""
GROWTH_BYTES = 8_000_000
"""Allowed between the first and the last quarter, whatever the number of calls."""


@pytest.mark.slow
def test_20_calls_in_one_process_leave_memory_files_and_answers_as_they_were(tmp_path):
    base = make_base(tmp_path / "base")
    sources = [(base / "sparse" / "0", base / "database.db", "auto"), (base / "old", None, "tracks")]
    answers, sizes, descriptors = {}, [], set()
    for call in range(20 + WARM_UP):
        model, database, directions = sources[call % 2]
        found = locate(model, database, directions=directions, threads=1)
        write_result(found, tmp_path / "out", overwrite=True)
        centers = np.array([row.center for row in found.cameras if row.placed]).tobytes()
        assert answers.setdefault(call % 2, centers) == centers
        del found
        if call >= WARM_UP:
            sizes.append(int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize())
            descriptors.add(len(os.listdir("/proc/self/fd")))
    gc.collect()
    assert np.median(sizes[-6:]) - np.median(sizes[:6]) < GROWTH_BYTES
    assert len(descriptors) == 1
