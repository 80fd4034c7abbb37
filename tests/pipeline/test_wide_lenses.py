"""Lenses that are no case of OPENCV: guessed focal lengths are found, and what is said of others is true."""

import itertools
import sqlite3

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.base.geometry import fit_similarity
from sfm_shapefit.files.colmap.database_images import read_images
from sfm_shapefit.pairs.focal_lengths import find_lenses
from sfm_shapefit.scene import lens as lens_module
from tests.adjustment.made import look_at
from tests.scenes import read_from, view_of

FOCAL_PX, WIDTH, HEIGHT, NUM_IMAGES = 400.0, 1000, 800, 10
GUESS_PX = 1.2 * WIDTH  # COLMAP's, three times too long
TRUE = {
    "OPENCV_FISHEYE": [0.03, -0.01, 0.004, -0.001],
    "FULL_OPENCV": [-0.02, 0.0, 1e-4, -1e-4, 0.0, 0.0, 0.0, 0.0],
    "FOV": [0.8],
    "DIVISION": [-0.15],
    "EUCM": [0.6, 1.1],
}


def make_database(folder, model, *, guess_px=GUESS_PX, flat=False):
    """A database of a ring of images with noise of half a pixel and a guessed focal length; its centers."""
    rng = np.random.default_rng(7)
    camera = pycolmap.Camera.create_from_model_name(1, model, FOCAL_PX, WIDTH, HEIGHT)
    guess = pycolmap.Camera.create_from_model_name(1, model, guess_px, WIDTH, HEIGHT)
    params = camera.params.copy()
    params[len(params) - len(TRUE[model]) :] = TRUE[model]
    camera.params = params
    angles = 2.0 * np.pi * np.arange(NUM_IMAGES) / NUM_IMAGES
    centers = np.stack([3.0 * np.cos(angles), 3.0 * np.sin(angles), 0.5 * np.sin(3.0 * angles)], axis=1)
    points = rng.uniform([-5.0, -5.0, -2.5], [5.0, 5.0, 2.5], (500, 3)) * ([1.0, 1.0, 0.0] if flat else 1.0)
    path, seen = folder / "database.db", []
    path.unlink(missing_ok=True)
    with pycolmap.Database.open(path) as database:
        database.write_camera(guess, use_camera_id=True)
        for k, rotation in enumerate(look_at(centers, rng.normal(0.0, 0.5, (NUM_IMAGES, 3)))):
            inside = (points - centers[k]) @ rotation.T
            is_seen = inside[:, 2] > 0.1 * np.linalg.norm(inside, axis=1)
            pixels = np.full((len(points), 2), -1.0)
            pixels[is_seen] = camera.img_from_cam(inside[is_seen])
            pixels += rng.normal(0.0, 0.5, pixels.shape)
            is_seen &= ((pixels > 0.0) & (pixels < [WIDTH, HEIGHT])).all(axis=1)
            seen.append(is_seen)
            database.write_image(pycolmap.Image(name=f"{k}.jpg", camera_id=1, image_id=k + 1), True)
            database.write_keypoints(k + 1, pixels[is_seen].astype(np.float32))
        for i, j in itertools.combinations(range(NUM_IMAGES), 2):
            both = seen[i] & seen[j]
            rows = [(np.cumsum(own) - 1)[both] for own in (seen[i], seen[j])]
            found = pycolmap.TwoViewGeometry()
            found.config, found.inlier_matches = 2, np.stack(rows, axis=1).astype(np.uint32)
            if both.sum() >= 15:
                database.write_two_view_geometry(i + 1, j + 1, found)
    with sqlite3.connect(path) as opened:
        opened.execute("UPDATE cameras SET prior_focal_length = 0")
    return path, centers


@pytest.mark.parametrize("model", ["OPENCV_FISHEYE", "FOV", "DIVISION", "EUCM"])
def test_a_guess_three_times_too_long_becomes_the_focal_length(tmp_path, model):
    path, centers = make_database(tmp_path, model)
    (one,) = sfm_shapefit.map_database(path).models
    camera = one.reconstruction.cameras[1]
    # Half a pixel of noise at a few thousand observations leaves far less than the .3 % that are asked for.
    np.testing.assert_allclose(camera.mean_focal_length(), FOCAL_PX, rtol=3e-3)
    found = one.reconstruction.images
    assert len(found) == NUM_IMAGES
    placed = np.array([image.projection_center() for _, image in sorted(found.items())])
    off = np.linalg.norm(fit_similarity(placed, centers).apply(placed) - centers, axis=1)
    assert np.median(off) < 3e-3  # half a pixel at 3 units is 4e-3, and each camera sees hundreds


def factors_of(path):
    """The factors by which the matches of a database want its one lens longer."""
    images = read_from(path, read_images).images.apart()
    with view_of(path, images) as view:
        found = find_lenses(view, np.ones(1, dtype=np.bool_), np.ones(1, dtype=np.bool_))
    return {k: lens.focal_px / images.lenses[k].focal_px for k, lens in found.items()}


def test_factors_are_those_of_the_matches_and_a_flat_scene_tells_none(tmp_path):
    path, _ = make_database(tmp_path, "OPENCV_FISHEYE")
    factors = factors_of(path)
    # The guess has no distortion, which would be .03 of the radius at an angle of 57 degrees.
    assert factors[0] * GUESS_PX == pytest.approx(FOCAL_PX, rel=0.06)
    assert factors_of(path) == factors  # to the bit
    # Through a lens that does not bend, a plane has a relative pose at any focal length.
    flat, _ = make_database(tmp_path, "FULL_OPENCV", flat=True)
    assert factors_of(flat) == {}


def test_a_model_that_is_not_known_is_held_and_nothing_else_is_said(tmp_path, monkeypatch):
    monkeypatch.delitem(lens_module._LENS_MODELS, "EUCM")
    path, _ = make_database(tmp_path, "EUCM", guess_px=1.05 * FOCAL_PX)
    (one,) = sfm_shapefit.map_database(path, intrinsics="focal").models
    assert one.reconstruction.cameras[1].focal_length_x == 1.05 * FOCAL_PX
    told = " ".join(one.warnings)
    assert "not adjusted here, but by COLMAP's bundle_adjuster" in told
    assert "intrinsics=focal" not in told
    assert "sfm-shapefit map" not in told
