"""The examples run as a reader would run them, and what is shipped is complete."""

import itertools
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.colmap.photographs import write_rendered_workspace
from sfm_shapefit.synthetic import make_rendered_scene
from sfm_shapefit.synthetic.options import SceneOptions, WorkspaceOptions
from tests.scenes import ROOT

FOCAL_LENGTH_PX = 350.0


def run_example(name: str, *arguments) -> str:
    """Run an example as a program, in a process of its own; return what it prints."""
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / name), *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> Path:
    """Eight photographs of a row of houses, what COLMAP finds in them, and the true model."""
    options = SceneOptions(
        shape="facade",
        num_images=8,
        image_width=400,
        image_height=300,
        focal_length_px=FOCAL_LENGTH_PX,
        max_keypoints_per_image=600,
    )
    folder = tmp_path_factory.mktemp("drawn") / "workspace"
    write_rendered_workspace(make_rendered_scene(options), folder, WorkspaceOptions(relative_poses=True))
    return folder


def assert_near_truth(model: Path | pycolmap.Reconstruction, workspace: Path) -> None:
    """Cameras stand 10 m before the houses, where a pixel is 29 mm: a pixel for the median camera. The lens'
    distortion is not told to the examples, so it is bundle adjustment that finds it."""
    errors = sfm_shapefit.evaluate(model, workspace / "sparse/0")
    assert len(errors.names) == 8
    assert errors.position.median < 0.029
    assert errors.rotation_deg.median < 0.2


@pytest.mark.slow
def test_the_pycolmap_pipeline_places_the_cameras_of_drawn_images(drawn, tmp_path):
    said = run_example("pycolmap_pipeline.py", drawn / "images", tmp_path / "out", FOCAL_LENGTH_PX)
    assert re.search(r"^8 cameras, \d{3,} points", said, flags=re.MULTILINE)
    assert_near_truth(tmp_path / "out/sparse/0", drawn)
    assert (tmp_path / "out/located/report.html").stat().st_size > 0


@pytest.mark.slow
def test_hlocs_files_become_placed_cameras(drawn, tmp_path):
    h5py = pytest.importorskip("h5py")
    with (
        pycolmap.Database.open(drawn / "database.db") as database,
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
    said = run_example("hloc_outputs.py", drawn / "images", *paths, FOCAL_LENGTH_PX)
    assert "8 of 8 cameras" in said
    keypoints = []
    for path in (drawn, tmp_path / "out"):
        with pycolmap.Database.open(path / "database.db") as database:
            image_id = database.read_image_with_name("0001.jpg").image_id
            keypoints.append(database.read_keypoints(image_id)[:, :2])
    np.testing.assert_allclose(*keypoints, atol=1e-3)
    assert_near_truth(tmp_path / "out/sparse/0", drawn)
