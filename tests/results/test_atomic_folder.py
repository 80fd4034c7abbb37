"""The folder of an output appears whole or not at all, and nobody else's is touched."""

import os
import signal
import stat
import sys
from pathlib import Path

import pytest

from sfm_shapefit import atomic_folder as output
from sfm_shapefit.atomic_folder import atomic_folder, claimed_output
from sfm_shapefit.errors import InputError
from tests.program import run_python


def test_a_second_run_into_the_same_place_is_told_so_and_the_first_goes_on(tmp_path):
    out = tmp_path / "out"
    with claimed_output(out), atomic_folder(out) as partial:
        (partial / "locate.json").write_text("first")
        script = (
            "import sys\nfrom sfm_shapefit.atomic_folder import claimed_output\n"
            f"with claimed_output({str(out)!r}): pass"
        )
        assert "another run is writing" in run_python("-c", script).stderr
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
    assert run_python("-c", script).returncode == -signal.SIGKILL
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
