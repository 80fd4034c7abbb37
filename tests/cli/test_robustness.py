"""What an adversary broke once: each ends in a sentence or a verdict, never in a traceback."""

import csv
import os
import signal
import subprocess
import sys

import numpy as np
import pycolmap
import pytest

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.facts.tables import read_trust
from sfm_shapefit.files.colmap import reconstructions
from tests.models import posed
from tests.problems import random_rotations
from tests.program import run, run_python, run_refused
from tests.scenes import COURTYARD, RING, ROOT

LONG = 300 * "x"
COMMAND = [sys.executable, "-m", "sfm_shapefit.cli"]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT)}


@pytest.mark.parametrize("with_database", [False, True])
@pytest.mark.parametrize(
    "change",
    [
        lambda _name, rotation, center: (rotation, -center),
        lambda name, _rotation, center: (
            random_rotations(np.random.default_rng(int(name[:4])), 1)[0],
            center,
        ),
        lambda _name, rotation, center: (rotation, 0.0 * center),
    ],
    ids=["mirrored", "random rotations", "all at one place"],
)
def test_a_model_without_a_usable_direction_gets_a_verdict_and_a_page(tmp_path, change, with_database):
    folder, page = tmp_path / "posed", tmp_path / "page.html"
    folder.mkdir()
    posed(RING / "sparse/0", change).write(folder)
    database = ["--database", RING / "database.db"] if with_database else []
    assert "verdict: do not use" in run("check", folder, "--report", page, *database, code=0).stdout
    assert page.exists()


def test_the_database_of_another_scene_gets_a_verdict():
    said = run("check", RING / "sparse/0", "--database", COURTYARD / "database.db", code=0).stdout
    assert "verdict: do not use" in said
    assert "courtyard/database.db; no pair determines where cameras are\n" in said
    assert "contradict it and none agrees: is this the model's database?\n" in said
    assert "second opinion: 8 cameras have nothing in common with their places" in said


def test_pairs_without_a_direction_do_not_contradict_a_model():
    """Nine pairs of the photographs are false, and have none."""
    said = run("check", ROOT / "data_synthetic/photographed/truth", code=0).stdout
    assert "photographed/database.db; 0 of 48 pairs contradict the result\n" in said


def test_names_that_are_too_long_are_refused_in_a_sentence(tmp_path):
    ring, out = RING / "sparse/0", tmp_path / LONG
    for words in (
        ("locate", ring, out),
        ("map", RING / "database.db", out),
        ("synth", out),
        ("convert", ring, f"{out}.json"),
        ("check", ring, "--report", f"{out}.html"),
        ("evaluate", ring, ring, "--csv", f"{out}.csv"),
        ("locate", out, tmp_path / "out"),
    ):
        assert "File name too long" in run_refused(*words)


def test_an_image_with_a_name_that_is_too_long_has_no_picture(tmp_path):
    model = pycolmap.Reconstruction(RING / "sparse/0")
    model.images[1].name = f"{LONG}.jpg"
    (tmp_path / "named").mkdir()
    model.write(tmp_path / "named")
    said = run("locate", tmp_path / "named", tmp_path / "out", "--images", tmp_path, code=0).stdout
    assert "lacks 8 of 8 images" in said


def test_a_full_device_a_closed_stdout_and_a_reader_that_has_left_end_quietly():
    table = [*COMMAND, "inspect", str(RING / "sparse/0")]
    words = [*table, "--json"]
    how = {"cwd": ROOT, "env": ENVIRONMENT, "stderr": subprocess.PIPE, "text": True}
    for printed in (words, table):
        with open("/dev/full", "w") as full:
            done = subprocess.run(printed, check=False, stdout=full, **how)
        assert (done.returncode, done.stderr.count("\n")) == (3, 1)
        assert "No space left on device" in done.stderr
    done = subprocess.run(["sh", "-c", 'exec "$@" >&-', "sh", *words], check=False, **how)
    assert (done.returncode, done.stderr) == (0, "")
    for printed, code in ((words, 141), (table, 1)):  # rich, which prints the table, has a code of its own
        process = subprocess.Popen(printed, stdout=subprocess.PIPE, **how)
        process.stdout.close()
        assert process.communicate()[1] == ""
        assert process.returncode == code


def test_a_working_folder_that_is_removed_meanwhile_is_told(tmp_path):
    script = (
        "import os, sys\nfrom sfm_shapefit.commands import locate as stages\n"
        "from sfm_shapefit.cli import main\n"
        "make = stages.make_model\n"
        "def remove(*given, **options):\n    os.rmdir(os.getcwd())\n    return make(*given, **options)\n"
        "stages.make_model = remove\nos.chdir(sys.argv.pop(1))\nmain()"
    )
    gone = tmp_path / "gone"
    gone.mkdir()
    done = run_python("-c", script, gone, "locate", RING / "sparse/0", "out")
    assert done.returncode == 3
    assert done.stderr.count("\n") == 1
    assert "Traceback" not in done.stderr


def test_a_carriage_return_in_a_name_is_quoted_and_read_again(tmp_path):
    model, name = pycolmap.Reconstruction(RING / "sparse/0"), "one\rtwo.jpg"
    model.images[1].name = name
    (tmp_path / "named").mkdir()
    model.write(tmp_path / "named")
    run("locate", tmp_path / "named", tmp_path / "out", "-q", code=0)
    with (tmp_path / "out/cameras.csv").open(newline="") as stream:
        assert name in [row["name"] for row in csv.DictReader(stream)]
    assert name in read_trust(tmp_path / "out/cameras.csv")
    run("convert", tmp_path / "out", tmp_path / "scene.glb", code=0)


def test_names_that_spreadsheets_take_for_formulas_stay_as_they_are_which_the_docs_say(tmp_path):
    names = ["=1+1", "+2.jpg", "-3.jpg", "@sum"]
    model = pycolmap.Reconstruction(RING / "sparse/0")
    for k, name in enumerate(names, start=1):
        model.images[k].name = name
    model.write(tmp_path)
    run("locate", tmp_path, tmp_path / "out", "-q", code=0)
    with (tmp_path / "out/cameras.csv").open(newline="") as stream:
        assert {row["name"] for row in csv.DictReader(stream)} >= set(names)
    assert "begins with `=` for a formula" in (ROOT / "docs/commands.md").read_text(encoding="utf-8")


def test_assertions_of_colmap_are_put_in_words_of_ours(monkeypatch):
    def fails(*_arguments):
        raise ValueError("[reconstruction.cc:12] Check failed: images_.count(id) (0 vs. 1)")

    model = pycolmap.Reconstruction(RING / "sparse/0")
    monkeypatch.setattr(reconstructions, "read_files", fails)
    with pytest.raises(InputError, match="not a sound COLMAP model: its parts contradict one another"):
        reconstructions.arrays_of(model)


@pytest.mark.parametrize("command", ["inspect", "place"])
def test_a_huge_file_is_refused_at_once(tmp_path, command):
    with (tmp_path / "graph.txt").open("wb") as stream:
        stream.truncate(40_000_000_000)
    out = [tmp_path / "out"] if command == "place" else []
    assert "more than 8 GB" in run_refused(command, tmp_path / "graph.txt", *out)


def test_an_interrupt_while_typer_is_imported_ends_without_a_traceback():
    """The moment is exact: typer's own module sends the signal at its end."""
    script = (
        "import importlib.machinery, os; from sfm_shapefit.cli import main\n"
        "load = importlib.machinery.SourceFileLoader.exec_module\n"
        "def signalled(self, module):\n"
        "    load(self, module)\n"
        f"    if module.__name__ == 'typer': os.kill(os.getpid(), {int(signal.SIGINT)})\n"
        "importlib.machinery.SourceFileLoader.exec_module = signalled\nmain()"
    )
    done = run_python("-c", script, "--help")
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_while_pycolmap_is_imported_end_without_a_stack_trace(tmp_path, number):
    """The moment is exact: pycolmap's own module sends the signal at its end."""
    script = (
        "import importlib.machinery, os, sys; from sfm_shapefit.cli import main\n"
        "load = importlib.machinery.SourceFileLoader.exec_module\n"
        "def signalled(self, module):\n"
        "    load(self, module)\n"
        f"    if module.__name__ == 'pycolmap': os.kill(os.getpid(), {int(number)})\n"
        "importlib.machinery.SourceFileLoader.exec_module = signalled\nmain()"
    )
    done = run_python("-c", script, "locate", RING / "sparse/0", tmp_path / "out")
    assert done.returncode == 130
    assert done.stderr == "sfm-shapefit: interrupted; nothing was written\n"
