"""Files that commands write: whole or not at all, never over an input, and a failed run leaves nothing."""

import errno
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sfm_shapefit.base.atomic_folder import atomic_file
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.commands.check import check
from tests.program import run, run_python, run_refused
from tests.scenes import COURTYARD, RING, ROOT, copied, fingerprint

NO_ROOM = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def scene(tmp_path):
    folder = copied(RING, tmp_path)
    (folder / "positions.csv").write_text("0001.jpg,0,0,0\n0002.jpg,1,0,0\n0003.jpg,0,1,0\n")
    (folder / "linked").symlink_to("sparse")
    os.link(folder / "sparse/0/points3D.bin", folder / "hard.bin")
    (folder / "images").mkdir()
    (folder / "images/0001.jpg").write_bytes(b"a picture")
    run("locate", folder / "sparse/0", folder / "out", "-q", code=0)
    return folder


OVER_INPUTS = [
    ("convert", "sparse/0", "sparse/0/images.bin", "--format", "csv"),
    ("convert", "sparse/0", "linked/0/images.bin", "--format", "csv"),
    ("convert", "linked/0", "sparse/0/cameras.bin", "--format", "tum"),
    ("convert", "sparse/0", "hard.bin", "--format", "glb"),
    ("convert", "out", "out/cameras.csv", "--format", "csv"),
    ("convert", "out", "out/locate.json"),
    ("check", "sparse/0", "--report", "database.db"),
    ("check", "sparse/0", "--report", "database.db-wal"),
    ("check", "sparse/0", "--report", "sparse/0/points3D.bin"),
    ("check", "sparse/0", "--database", "database.db", "--report", "sparse/../database.db"),
    ("check", "sparse/0", "--images", "images", "--report", "images/0001.jpg"),
    ("evaluate", "sparse/0", "positions.csv", "--csv", "positions.csv"),
    ("evaluate", "sparse/0", "out", "--csv", "out/cameras.csv"),
    ("evaluate", "out", "sparse/0", "--csv", "hard.bin"),
]


@pytest.mark.parametrize("arguments", OVER_INPUTS, ids=" ".join)
def test_no_input_of_a_command_is_overwritten_however_its_path_is_spelled(scene, monkeypatch, arguments):
    before = fingerprint(scene)
    monkeypatch.chdir(scene)
    assert "belongs to the input" in run_refused(*arguments, "--overwrite")
    assert fingerprint(scene) == before


def test_the_report_of_a_result_goes_over_no_input_of_it(scene):
    found = check(scene / "sparse/0", second_opinion=False)
    before = fingerprint(scene)
    for name in ("database.db", "sparse/0/images.bin"):
        with pytest.raises(InputError, match="belongs to the input"):
            found.report(scene / name, overwrite=True)
    assert fingerprint(scene) == before


def test_an_earlier_file_in_the_folder_of_a_model_is_replaced(scene):
    for arguments, name in (
        (("convert", scene / "out"), "scene.glb"),
        (("check", scene / "out", "--report"), "report.html"),
        (("evaluate", scene / "out", scene / "sparse/0", "--csv"), "errors.csv"),
    ):
        (scene / "out" / name).write_text("of before")
        run(*arguments, scene / "out" / name, "--overwrite", code=0)
        assert (scene / "out" / name).read_bytes() != b"of before"


WRITING = {
    "convert": ("sparse/0", "new.json"),
    "check": ("sparse/0", "--no-second-opinion", "--report", "new.html"),
    "evaluate": ("sparse/0", "out", "--csv", "new.csv"),
}


@pytest.mark.parametrize("command", WRITING)
def test_a_link_is_never_replaced_nor_followed(scene, monkeypatch, command):
    monkeypatch.chdir(scene)
    name = WRITING[command][-1]
    for target, how, word in (
        ("nowhere", (), "exists already"),
        ("nowhere", ("--overwrite",), "is a symbolic link"),
        ("positions.csv", ("--overwrite",), "is a symbolic link"),
        ("/dev/null", ("--overwrite",), "is a symbolic link"),
    ):
        (scene / name).unlink(missing_ok=True)
        (scene / name).symlink_to(target)
        before = fingerprint(scene)
        assert word in run_refused(command, *WRITING[command], *how)
        assert fingerprint(scene) == before


@pytest.mark.parametrize("command", WRITING)
def test_a_file_that_cannot_be_written_leaves_the_earlier_one_and_nothing_else(scene, monkeypatch, command):
    monkeypatch.chdir(scene)
    name = WRITING[command][-1]

    def full(*_arguments, **_how):
        raise NO_ROOM

    monkeypatch.setattr(os, "replace", full)
    for how in ((), ("--overwrite",)):
        if how:
            (scene / name).write_text("earlier")
        before = fingerprint(scene)
        said = run_refused(command, *WRITING[command], *how)
        assert re.search(rf"{Path(name).stem}\S* cannot be written \(No space left on device\)", said)
        assert fingerprint(scene) == before


def test_a_file_is_written_whole_and_what_a_killed_run_left_goes(tmp_path):
    left = tmp_path / ".shapefit-0123456789abcdef.partial"
    left.mkdir(mode=0o700)
    (left / "half").touch()
    (tmp_path / "file").write_text("earlier")
    with pytest.raises(TypeError), atomic_file(tmp_path / "file") as place:
        place.write_bytes("no bytes")
    assert fingerprint(tmp_path).keys() == {"file"}
    assert (tmp_path / "file").read_text() == "earlier"
    with atomic_file(tmp_path / "file") as place:
        place.write_text("new")
        with pytest.raises(InputError, match="another run is writing"), atomic_file(tmp_path / "file"):
            pass
    assert (tmp_path / "file").read_text() == "new"
    assert os.listdir(tmp_path) == ["file"]


@pytest.mark.parametrize("closed", ["0<&-", "1>&-", "2>&-", "0<&- 1>&- 2>&-"])
def test_closed_streams_lead_nowhere(tmp_path, closed):
    command = f"{sys.executable} -m sfm_shapefit.cli locate {COURTYARD}/sparse/0 {tmp_path}/out {closed}"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(["sh", "-c", command], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stderr == ""
    assert ("verdict" in done.stdout) == ("1>" not in closed)
    assert (tmp_path / "out/report.html").exists()


def test_what_a_workspace_lacks_room_for_is_said_in_a_sentence(tmp_path):
    script = (
        "import resource, sys; from sfm_shapefit.cli import main; "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)); sys.argv[0] = 'x'; main()"
    )
    small = ("--num-images", 4, "--num-points", 400)
    done = run_python("-c", script, "synth", tmp_path / "out", *small)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
    assert "out cannot be written" in done.stderr
    assert os.listdir(tmp_path) == []


def test_a_table_of_zeros_is_read_no_further_than_the_first(tmp_path):
    scene, table = shutil.copytree(RING / "sparse/0", tmp_path / "model"), tmp_path / "table.csv"
    with table.open("wb") as stream:
        stream.write(b"0001.jpg 1 2 3\n")
        stream.truncate(3_000_000_000)
    script = (
        "import resource, sys; from sfm_shapefit.cli import main; sys.argv[0] = 'x'; "
        "resource.setrlimit(resource.RLIMIT_AS, (2_000_000_000, 2_000_000_000)); main()"
    )
    for arguments in (
        ("locate", scene, tmp_path / "out", "--priors", table),
        ("locate", scene, tmp_path / "out", "--config", table),
        ("evaluate", scene, table),
        ("place", table, tmp_path / "out"),
    ):
        done = run_python("-c", script, *arguments, OPENBLAS_NUM_THREADS="1")
        assert done.returncode in (2, 3), done.stderr
        assert "has binary zeros" in done.stderr.replace("│", "").replace("\n", "").replace("  ", " ")
