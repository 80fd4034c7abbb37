"""The examples run as a reader would run them, and what is shipped is complete."""

import ast
import inspect
import itertools
import json
import re
from pathlib import Path

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from tests.program import run_python
from tests.scenes import ROOT

ANCHOR = re.compile('id="([^"]+)"')


def run_example(name: str, *arguments) -> str:
    """Run an example as a program, in a process of its own; return what it prints."""
    done = run_python(ROOT / "examples" / name, *arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


def assert_near_truth(model: Path | pycolmap.Reconstruction, workspace: Path, least: int = 8) -> None:
    """Cameras stand 10 m before the houses, where a pixel is 29 mm: a pixel for the median camera. The lens'
    distortion is not told to the examples, so it is bundle adjustment that finds it."""
    errors = sfm_shapefit.evaluate(model, workspace / "sparse/0")
    assert least <= len(errors.names) <= 8
    assert errors.position.median < 0.029
    assert errors.rotation_deg.median < 0.2


@pytest.mark.slow
def test_the_pycolmap_pipeline_places_the_cameras_of_drawn_images(drawn, tmp_path):
    scene, folder = drawn
    focal_px = scene.options.focal_length_px
    said = run_example("pycolmap_pipeline.py", folder / "images", tmp_path / "out", focal_px)
    assert re.search(r"^8 cameras, \d{3,} points", said, flags=re.MULTILINE)
    assert_near_truth(tmp_path / "out/sparse/0", folder, least=8)
    assert_near_truth(tmp_path / "out/located", folder, least=8)
    assert (tmp_path / "out/located/report.html").stat().st_size > 0


@pytest.mark.slow
def test_hlocs_files_become_placed_cameras(drawn, tmp_path):
    h5py = pytest.importorskip("h5py")
    scene, folder = drawn
    with (
        pycolmap.Database.open(folder / "database.db") as database,
        h5py.File(tmp_path / "features.h5", "w") as features,
        h5py.File(tmp_path / "matches.h5", "w") as matches,
    ):
        names = {image.image_id: image.name for image in database.read_all_images()}
        counts = {}
        for image_id, name in names.items():
            keypoints = database.read_keypoints(image_id)[:, :2] - 0.5  # hloc's first pixel is at 0
            features[f"{name}/keypoints"] = keypoints.astype(np.float32)
            counts[image_id] = len(keypoints)
        lines = []
        for i, j in itertools.combinations(names, 2):
            if not database.exists_matches(i, j):
                continue
            pairs = database.read_matches(i, j)
            # hloc keeps every second pair here in the order that the list does not have.
            first, second, pairs = (j, i, pairs[:, ::-1]) if (i + j) % 2 else (i, j, pairs)
            found = np.full(counts[first], -1)
            found[pairs[:, 0]] = pairs[:, 1]
            matches[f"{names[first]}/{names[second]}/matches0"] = found.astype(np.int16)
            lines.append(f"{names[i]} {names[j]}\n")
    (tmp_path / "pairs.txt").write_text("".join(lines))
    paths = [tmp_path / name for name in ("pairs.txt", "features.h5", "matches.h5", "out")]
    said = run_example("hloc_outputs.py", folder / "images", *paths, scene.options.focal_length_px)
    assert "model 0: 8 of 8 cameras" in said
    keypoints = []
    for path in (folder, tmp_path / "out"):
        with pycolmap.Database.open(path / "database.db") as database:
            image_id = database.read_image_with_name("0001.jpg").image_id
            keypoints.append(database.read_keypoints(image_id)[:, :2])
    np.testing.assert_allclose(*keypoints, atol=1e-3)
    assert_near_truth(tmp_path / "out/models/0", folder)


@pytest.mark.parametrize("name", ["pycolmap_pipeline.py", "hloc_outputs.py"])
def test_an_example_without_arguments_says_how_it_is_called(name):
    done = run_python(ROOT / "examples" / name)
    assert done.returncode == 2
    assert f"python examples/{name} IMAGES" in done.stderr
    assert "Traceback" not in done.stderr


def test_the_example_for_hloc_says_which_package_it_lacks():
    path = ROOT / "examples/hloc_outputs.py"
    done = run_python("-c", f"import runpy, sys; sys.modules['h5py'] = None; runpy.run_path({str(path)!r})")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "pip install h5py" in done.stderr


@pytest.mark.parametrize("name", sfm_shapefit.__all__)
def test_every_public_name_says_what_it_is_and_what_it_takes(name):
    public = getattr(sfm_shapefit, name)
    text = inspect.getdoc(public)
    assert text
    assert not text.startswith(f"{name}(")  # what a dataclass says that has no words of its own
    if inspect.isfunction(public):
        for argument in inspect.signature(public).parameters:
            assert re.search(rf"^ {{4}}(\w+, )*[*]*{argument}(, \w+)*: ", text, flags=re.MULTILINE), argument


def user_seconds(code: str) -> float:
    """Return the processor time of a fresh Python that runs some code: least of three, for others run too."""
    times = []
    for _ in range(3):
        end = "import resource as r; print(r.getrusage(r.RUSAGE_SELF).ru_utime)"
        done = run_python("-c", f"{code}\n{end}")
        times.append(float(done.stdout.split()[-1]))
    return min(times)


def test_the_package_is_imported_and_help_shown_in_tenths_of_a_second():
    assert user_seconds("import sfm_shapefit") < 0.4
    assert user_seconds("from sfm_shapefit.cli import app\napp(['--help'], standalone_mode=False)") < 0.3


@pytest.mark.slow
def test_the_documentation_builds_as_a_site_with_a_search_over_pages_and_api(tmp_path):
    pytest.importorskip("pdoc")
    done = run_python("-W", "error", "scripts/docs_site.py", tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    page = (tmp_path / "api/sfm_shapefit.html").read_text(encoding="utf-8")
    assert all(f'id="{name}"' in page for name in sfm_shapefit.__all__)
    text = (tmp_path / "search-index.js").read_text(encoding="utf-8")
    index = json.loads(text.removeprefix("const INDEX = ").rstrip(";\n"))
    urls = {entry["url"] for entry in index}
    assert {"glossary.html#glossary", "api/sfm_shapefit.html#locate"} <= urls
    pages = {path: path.read_text(encoding="utf-8") for path in tmp_path.rglob("*.html")}
    anchors = {
        f"{path.relative_to(tmp_path)}#{name}" for path in pages for name in ANCHOR.findall(pages[path])
    }
    assert urls <= anchors
    home = (tmp_path / "index.html").read_text(encoding="utf-8")
    for link in re.findall(r'(?:href|src)="(?!https:|#)([^"#]+)', home):
        assert (tmp_path / link).is_file(), link


def outputs_of(notebook: Path) -> list[object]:
    """Run the code cells of a notebook in order; return what each ends in, None for a statement."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    scope: dict[str, object] = {"__name__": "__main__"}
    found = []
    for cell in cells:
        if cell["cell_type"] != "code":
            continue
        assert cell["outputs"] == [], "outputs are not kept in the repository"
        body = ast.parse("".join(cell["source"])).body
        last = body.pop() if isinstance(body[-1], ast.Expr) else None
        exec(compile(ast.Module(body, []), str(notebook), "exec"), scope)
        shown = last and eval(compile(ast.Expression(last.value), str(notebook), "eval"), scope)
        found.append(shown)
    return found


def test_the_notebook_runs_and_ends_in_the_scene(monkeypatch, capsys):
    monkeypatch.chdir(ROOT / "examples")
    *_, verdict, _, _, _, scene = outputs_of(ROOT / "examples/courtyard.ipynb")
    said = capsys.readouterr().out
    assert "largest coordinate of a center: 0.0" in said
    assert float(re.search(r"median error (\S+) mm", said).group(1)) < 2.0
    assert int(re.search(r"(\d+) of 176 pairs contradict", said).group(1)) == 44
    assert verdict == "good"
    assert "25 of 25 images" in scene._repr_html_()
    assert "<iframe" in scene._repr_html_()
