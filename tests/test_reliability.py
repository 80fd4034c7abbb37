"""Hostile input, faults and many calls, in small; scripts/reliability.py does the same in large."""

import os
import signal
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sfm_shapefit import atomic_folder as output
from sfm_shapefit.atomic_folder import atomic_folder, claimed_output
from sfm_shapefit.cli import console
from sfm_shapefit.commands.place import solve_graph_file
from sfm_shapefit.errors import InputError
from tests.scenes import COURTYARD, FACADE, RING, ROOT

SCRIPT = ROOT / "scripts" / "reliability.py"
sys.path.insert(0, str(ROOT / "scripts"))  # as `python scripts/reliability.py` does

from abuse import determinism, sandbox, verdicts  # noqa: E402


def reliability(*arguments, timeout=280):
    return subprocess.run(
        [sys.executable, str(SCRIPT), *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=timeout,
        cwd=ROOT,
    )


# --- hostile input -------------------------------------------------------------------------------------


def test_300_damaged_inputs_end_in_a_correct_result_or_one_sentence():
    done = reliability("fuzz", "--cases", 300, "--seed", 7)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "300 cases, 0 failed" in done.stdout


SINS = """
import os, signal, sys
sys.path.insert(0, "scripts")
from pathlib import Path
from abuse import sandbox, verdicts

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
    done = subprocess.run(
        [sys.executable, "-c", SINS, str(tmp_path / "work")],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
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
    before = verdicts.snapshot(tmp_path)
    (tmp_path / "a").write_text("2")
    assert verdicts.snapshot(tmp_path) != before
    assert not verdicts.differs([(1.0, 0.0, 0.0)], [(1.0 + 1e-8, 0.0, 0.0)])
    assert verdicts.differs([(1.0, 0.0, 0.0)], [(1.0 + 1e-5, 0.0, 0.0)])
    assert verdicts.differs([], [(1.0, 0.0, 0.0)])


# --- places --------------------------------------------------------------------------------------------


def test_a_second_run_into_the_same_place_is_told_so_and_the_first_goes_on(tmp_path):
    out = tmp_path / "out"
    with claimed_output(out), atomic_folder(out) as partial:
        (partial / "locate.json").write_text("first")
        script = (
            "import sys\nfrom sfm_shapefit.atomic_folder import claimed_output\n"
            f"with claimed_output({str(out)!r}): pass"
        )
        second = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, check=False, cwd=ROOT
        )
        assert "another run is writing" in second.stderr
    assert (out / "locate.json").read_text() == "first"
    assert list(tmp_path.iterdir()) == [out]


def test_what_a_killed_run_left_is_removed_by_the_next_into_any_place_beside_it(tmp_path):
    script = f"""
import os, signal
from sfm_shapefit.atomic_folder import atomic_folder
with atomic_folder({str(tmp_path / "a")!r}) as partial:
    (partial / "file").write_text("x")
    os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", script], check=False, cwd=ROOT)
    assert done.returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert stat.S_IMODE(left.stat().st_mode) == 0o700
    with atomic_folder(tmp_path / "b"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["b"]


def test_a_folder_of_somebody_else_that_looks_abandoned_is_left_alone(tmp_path):
    open_to_all = tmp_path / ".shapefit-0123.partial"
    open_to_all.mkdir(mode=0o755)
    (tmp_path / "target").mkdir(mode=0o700)
    (tmp_path / ".shapefit-4567.partial").symlink_to(tmp_path / "target")
    with atomic_folder(tmp_path / "out"):
        pass
    assert open_to_all.is_dir()
    assert (tmp_path / "target").is_dir()


def test_an_earlier_output_is_replaced_in_one_step(tmp_path, monkeypatch):
    out = tmp_path / "out"
    out.mkdir()
    (out / "locate.json").write_text("old")
    seen = []
    real = output._renamed_at_once

    def watched(source, target, how):
        done = real(source, target, how)
        seen.append(((target / "locate.json").read_text(), (source / "locate.json").read_text()))
        return done

    monkeypatch.setattr(output, "_renamed_at_once", watched)
    with atomic_folder(out, overwrite=True) as partial:
        (partial / "locate.json").write_text("new")
    if sys.platform == "linux":
        assert seen == [("new", "old")]
    assert (out / "locate.json").read_text() == "new"
    assert list(tmp_path.iterdir()) == [out]


def test_an_empty_folder_that_appears_meanwhile_is_not_replaced(tmp_path, monkeypatch):
    real = os.path.lexists

    def appearing(path):
        found = real(path)
        if Path(path) == tmp_path / "out" and (tmp_path / ".hit").exists():
            (tmp_path / "out").mkdir(exist_ok=True)
        return found

    monkeypatch.setattr(os.path, "lexists", appearing)
    with (
        pytest.raises(InputError, match="made by another program meanwhile"),
        atomic_folder(tmp_path / "out"),
    ):
        (tmp_path / ".hit").touch()
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize(("module", "name"), [("shutil", "rmtree"), ("fcntl", "flock")])
def test_an_interrupt_while_a_claim_is_made_or_removed_leaves_nothing(tmp_path, monkeypatch, module, name):
    calls, plain = [], getattr(getattr(output, module), name)

    def interrupted(*arguments, **how):
        calls.append(name)
        if len(calls) == 1:
            raise KeyboardInterrupt
        return plain(*arguments, **how)

    monkeypatch.setattr(getattr(output, module), name, interrupted)
    with pytest.raises(KeyboardInterrupt), output.locked_folder(tmp_path / "claim") as folder:
        (folder / "file").touch()
    assert list(tmp_path.iterdir()) == []
    with output.locked_folder(tmp_path / "claim"):  # its lock is free again
        pass


# --- faults --------------------------------------------------------------------------------------------


def test_signals_limits_rivals_and_locks_leave_output_and_input_whole():
    done = reliability("faults", "--moments", 3, "--cold", 0, "--rivals", 2)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("held") == 12


def failing(error):
    with console.report_errors():
        raise error


def test_an_error_that_native_code_makes_of_an_interrupt_is_an_interrupt(capsys, monkeypatch):
    monkeypatch.setattr(console, "_received", [signal.SIGINT])
    with pytest.raises(console.typer.Exit) as caught:
        failing(RuntimeError("Caught an unknown exception!"))
    assert caught.value.exit_code == 130
    assert capsys.readouterr().err == "sfm-shapefit: interrupted; nothing was written\n"


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
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (130, "")


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("can't start new thread")])
def test_lack_of_memory_is_one_sentence(capsys, error):
    with pytest.raises(console.typer.Exit) as caught:
        failing(error)
    assert caught.value.exit_code == 3
    assert "memory" in capsys.readouterr().err
    with pytest.raises(ZeroDivisionError):  # a defect of ours stays visible
        failing(ZeroDivisionError())


def test_an_address_space_too_small_for_the_libraries_is_refused_at_once(tmp_path):
    command = (
        f"ulimit -v 500000; exec {sys.executable} -m sfm_shapefit.cli locate {RING}/sparse/0 {tmp_path}/out"
    )
    done = subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, check=False, cwd=ROOT, timeout=60
    )
    assert done.returncode == 3
    assert "512 MB of address space" in done.stderr
    assert done.stderr.count("\n") == 1


# --- determinism ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", [RING, FACADE, COURTYARD], ids=lambda scene: scene.name)
def test_the_order_of_images_pairs_matches_and_points_does_not_matter(scene, tmp_path):
    assert determinism.reordered_difference(scene, tmp_path, seed=1) <= 1e-12


def test_reordering_changes_every_file_of_the_input(tmp_path):
    copy = determinism.reordered(RING, tmp_path / "copy", determinism.np.random.default_rng(1))
    for file in ("sparse/0/images.bin", "sparse/0/points3D.bin", "sparse/0/frames.bin", "database.db"):
        assert (copy / file).read_bytes() != (RING / file).read_bytes()


def test_hash_seed_and_threads_do_not_change_a_byte(tmp_path, monkeypatch):
    name = "hash seed 4242, two threads"
    monkeypatch.setattr(determinism, "VARIANTS", {name: determinism.VARIANTS[name]})
    assert list(determinism.differing_files(RING, tmp_path)) == []


def test_the_order_of_a_graphs_lines_does_not_matter(tmp_path):
    rng = np.random.default_rng(5)
    centers = rng.normal(size=(30, 3))
    pairs = np.array([(i, j) for i in range(30) for j in range(i) if rng.random() < 0.4])
    baselines = centers[pairs[:, 0]] - centers[pairs[:, 1]]
    baselines += 0.03 * rng.standard_normal(baselines.shape)
    units = baselines / np.linalg.norm(baselines, axis=1, keepdims=True)
    located = []
    for order, flip in ((np.arange(len(pairs)), 0.0), (rng.permutation(len(pairs)), 0.5)):
        lines = []
        for e in order.tolist():
            (i, j), v = (pairs[e], units[e]) if rng.random() >= flip else (pairs[e][::-1], -units[e])
            lines.append(f"{i} {j} {' '.join(map(repr, v.tolist()))}\n")
        (tmp_path / "graph.txt").write_text("".join(lines))
        located.append(solve_graph_file(tmp_path / "graph.txt").placement.locations)
    assert np.abs(located[0] - located[1]).max() <= 1e-12 * np.ptp(located[0], axis=0).max()


@pytest.mark.slow
def test_no_variant_of_a_run_changes_a_byte(tmp_path):
    assert list(determinism.differing_files(COURTYARD, tmp_path)) == []


# --- many calls ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_30_calls_in_one_process_leave_memory_files_and_answers_as_they_were():
    done = reliability("soak", "--calls", 30)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_walkers_are_fuzzed_if_atheris_is_there_and_say_so_if_not(tmp_path):
    done = reliability("walkers", "--seconds", 1)
    assert done.returncode == (2 if "not installed" in done.stdout else 0), done.stdout + done.stderr


def test_the_sandbox_limits_are_those_that_are_promised():
    assert (sandbox.CPU_LIMIT_S, sandbox.MEMORY_LIMIT_BYTES) == (10, 2_000_000_000)
