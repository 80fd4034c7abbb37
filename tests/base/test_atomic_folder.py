"""The folder of an output appears whole or not at all, and nobody else's is touched."""

import os
import re
import shutil
import signal
import stat
from pathlib import Path

import pytest

from sfm_shapefit.base import atomic_folder as output
from sfm_shapefit.base.atomic_folder import atomic_folder, check_output, claimed_output
from sfm_shapefit.base.errors import InputError
from tests.program import run_python


def earlier_output(path):
    path.mkdir()
    (path / "locate.json").write_text("{}")
    (path / "old.bin").write_bytes(b"old")
    return path


def write_and_raise(out, error, overwrite=False):
    with atomic_folder(out, overwrite=overwrite) as partial:
        (partial / "locate.json").write_text("new")
        raise error


def test_a_second_run_into_the_same_place_is_told_so_and_the_first_goes_on(tmp_path):
    out = tmp_path / "out"
    with claimed_output(out), atomic_folder(out) as partial:
        (partial / "locate.json").write_text("first")
        script = (
            "import sys\nfrom sfm_shapefit.base.atomic_folder import claimed_output\n"
            f"with claimed_output({str(out)!r}): pass"
        )
        assert "another run is writing" in run_python("-c", script).stderr
    assert (out / "locate.json").read_text() == "first"
    assert list(tmp_path.iterdir()) == [out]


def test_what_a_killed_run_left_is_removed_by_the_next_but_nothing_of_somebody_else(tmp_path):
    script = f"""
import os, signal
from sfm_shapefit.base.atomic_folder import atomic_folder
with atomic_folder({str(tmp_path / "a")!r}) as partial:
    (partial / "file").write_text("x")
    os.kill(os.getpid(), signal.SIGKILL)
"""
    assert run_python("-c", script).returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert stat.S_IMODE(left.stat().st_mode) == 0o700
    (tmp_path / ".shapefit-0123.partial").mkdir(mode=0o755)
    (tmp_path / "target").mkdir(mode=0o700)
    (tmp_path / ".shapefit-4567.partial").symlink_to(tmp_path / "target")
    others = {path for path in tmp_path.iterdir() if path != left}
    with atomic_folder(tmp_path / "b"):
        pass
    assert set(tmp_path.iterdir()) == others | {tmp_path / "b"}


def test_an_earlier_output_is_replaced_completely(tmp_path):
    out = earlier_output(tmp_path / "out")
    with atomic_folder(out, overwrite=True) as partial:
        (partial / "locate.json").write_text("new")
        assert (out / "old.bin").exists()
    assert (out / "locate.json").read_text() == "new"
    assert [path.name for path in out.iterdir()] == ["locate.json"]
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


def test_a_folder_appears_with_usual_permissions_when_the_block_ends_and_not_before(tmp_path):
    out = tmp_path / "new" / "parents" / "out"
    with atomic_folder(out) as partial:
        (partial / "sub").mkdir()
        (partial / "sub" / "file").write_text("x")
        assert partial.parent.parent == out.parent
        assert stat.S_IMODE(partial.parent.stat().st_mode) == 0o700
        assert not out.exists()
    assert (out / "sub" / "file").read_text() == "x"
    assert list(out.parent.iterdir()) == [out]
    (tmp_path / "plain").mkdir()
    assert stat.S_IMODE(out.stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt, SystemExit])
def test_an_exception_leaves_nothing_behind_not_even_new_parents_and_keeps_an_earlier_output(tmp_path, error):
    with pytest.raises(error):
        write_and_raise(tmp_path / "a" / "b" / "out", error)
    with pytest.raises(InputError, match=r"out cannot be written \(No space left on device\)"):
        write_and_raise(tmp_path / "out", OSError(28, "No space left on device"))
    assert list(tmp_path.iterdir()) == []
    out = earlier_output(tmp_path / "out")
    with pytest.raises(error):
        write_and_raise(out, error, overwrite=True)
    assert (out / "old.bin").read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [out]


def test_an_existing_folder_is_refused_and_kept_and_one_that_came_into_being_meanwhile_too(tmp_path):
    with pytest.raises(InputError, match="exists already"), atomic_folder(tmp_path / "out"):
        out = earlier_output(tmp_path / "out")
    advice = "exists already; choose another folder, or replace it (overwrite=True)"
    with pytest.raises(InputError, match=re.escape(advice)):
        check_output(out)
    (tmp_path / "foreign" / "inner").mkdir(parents=True)
    with pytest.raises(InputError, match=r"exists already; choose another folder$"):  # never replaced
        check_output(tmp_path / "foreign")
    shutil.rmtree(tmp_path / "foreign")
    with pytest.raises(InputError, match="exists already"), atomic_folder(out):
        pytest.fail("the block must not run")
    assert (out / "old.bin").read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [out]


def test_an_empty_folder_is_filled_unasked(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    with atomic_folder(out) as folder:
        (folder / "new.bin").write_bytes(b"new")
    assert [path.name for path in out.iterdir()] == ["new.bin"]
    assert list(tmp_path.iterdir()) == [out]


def test_an_earlier_output_is_put_back_if_the_new_one_cannot_be_moved_in(tmp_path, monkeypatch):
    out = earlier_output(tmp_path / "out")
    rename = Path.rename

    def failing(self, target):
        if self.parent.suffix == ".partial" and self.name == "out":
            raise OSError(5, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(output, "_renamed_at_once", lambda *_: False)  # as on other systems than Linux
    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(InputError, match="cannot be written"), atomic_folder(out, overwrite=True):
        pass
    assert (out / "old.bin").read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [out]


def test_overwriting_refuses_what_is_no_earlier_output_but_takes_an_empty_folder(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    with atomic_folder(photos, overwrite=True) as partial:
        (partial / "dear.jpg").write_bytes(b"x")
    with (
        pytest.raises(InputError, match=r"holds files but no locate\.json or map\.json"),
        atomic_folder(photos, overwrite=True),
    ):
        pytest.fail("the block must not run")
    assert (photos / "dear.jpg").exists()


@pytest.mark.parametrize("spelling", ["model", "model/../model", ".", "link", "project"])
def test_the_input_is_never_overwritten_however_it_is_spelled(tmp_path, spelling):
    model = earlier_output(tmp_path / "model")
    (tmp_path / "link").symlink_to(model)
    (tmp_path / "locate.json").write_text("{}")
    (tmp_path / "project").symlink_to(tmp_path)
    with pytest.raises(InputError, match="is or contains the input"):
        check_output(tmp_path / spelling, overwrite=True, protect=[model])
    check_output(model / "out", protect=[model])
    check_output(tmp_path / "model2", protect=[model])


def test_paths_that_cannot_hold_a_folder_are_refused_in_one_sentence(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("x")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for name, sentence in (("file", "is a file"), ("file/out", "is not a folder"), ("link", "symbolic link")):
        for overwrite in (False, True):
            with pytest.raises(InputError, match=sentence) as caught:
                check_output(tmp_path / name, overwrite=overwrite)
            assert "\n" not in str(caught.value)
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everywhere
    with pytest.raises(InputError, match="is not writable"):
        check_output(tmp_path / "out")
