"""Lenses: distortions undone."""

import numpy as np
import pycolmap
import pytest

from sfm_shapefit.scene.lens import Lens


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("SIMPLE_PINHOLE", (900.0, 600.0, 400.0)),
        ("PINHOLE", (900.0, 910.0, 600.0, 400.0)),
        ("SIMPLE_RADIAL", (900.0, 600.0, 400.0, -0.3)),
        ("RADIAL", (900.0, 600.0, 400.0, -0.25, 0.1)),
        ("OPENCV", (900.0, 910.0, 600.0, 400.0, -0.2, 0.05, 2e-3, -3e-3)),
    ],
)
def test_distortion_is_undone_as_by_pycolmap_and_where_the_picture_is_folded_there_is_no_ray(
    model, parameters
):
    rng = np.random.default_rng(0)
    pixels = rng.uniform([-100.0, -100.0], [1300.0, 900.0], (30_000, 2))
    camera = pycolmap.Camera(model=model, width=1200, height=800, params=parameters)
    found, theirs = Lens(model, parameters).undistort(pixels), np.asarray(camera.cam_from_img(pixels))
    has_ray = np.isfinite(found).all(axis=1)
    np.testing.assert_array_equal(has_ray, np.isfinite(theirs).all(axis=1))
    assert has_ray.all() == (parameters[-1] != -0.3)
    ahead = np.concatenate([found[has_ray], np.ones((has_ray.sum(), 1))], axis=1)
    np.testing.assert_allclose(camera.img_from_cam(ahead), pixels[has_ray], atol=1e-9)


def test_a_coefficient_next_to_none_is_none():
    # An adjustment leaves as much of a coefficient that its prior alone pulls at, step by step.
    pixels = np.array([[600.0, 400.0], [1300.0, 900.0], [-100.0, 400.0]])
    plain = Lens("PINHOLE", (900.0, 900.0, 600.0, 400.0)).undistort(pixels)
    for distortion in ((1e-310, 0.0), (-1e-310, 1e-310), (0.0, 1e-310), (0.0, -1e-310)):
        found = Lens("RADIAL", (900.0, 600.0, 400.0, *distortion)).undistort(pixels)
        np.testing.assert_array_equal(found, plain)


@pytest.mark.parametrize(
    ("model", "focal", "distortion", "differs"),
    [
        ("SIMPLE_RADIAL", 900.0, 0.0, False),
        ("SIMPLE_RADIAL", 910.0, 0.0, False),  # 0.4 % of the angle at the edge, which is 34 deg
        ("SIMPLE_RADIAL", 960.0, 0.0, True),
        ("SIMPLE_RADIAL", 900.0, 0.1, True),
        ("SIMPLE_RADIAL", 900.0, -0.3, True),  # the corner has no ray
        ("SIMPLE_RADIAL_FISHEYE", 901.0, 0.0, True),  # it cannot be adjusted
    ],
)
def test_lenses_differ_where_their_rays_do_by_a_hundredth(model, focal, distortion, differs):
    one, other = (
        Lens(model, (f, 600.0, 400.0, k), width=1200, height=800)
        for f, k in ((900.0, 0.0), (focal, distortion))
    )
    assert one.differs_in_rays(other) is differs
    assert one.differs_in_rays(one) is False
