"""Lenses: projections of all models, their rays, and which distortions are credible."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from sfm_shapefit.scene.lens import Lens, Origin
from sfm_shapefit.scene.wide_lenses import is_seen, see
from tests.adjustment.made import LENSES

WIDE = [model for model in LENSES if not Lens(model, ()).is_plane]
ROUND = [model for model in WIDE if model not in ("FULL_OPENCV", "FOV")]  # they see behind the camera, too


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
        ("SIMPLE_RADIAL_FISHEYE", 910.0, 0.0, False),
        ("SIMPLE_RADIAL_FISHEYE", 960.0, 0.0, True),
        ("SIMPLE_RADIAL_FISHEYE", 900.0, -0.9, True),  # the corner has no ray
        ("OF_LATER", 901.0, 0.0, True),  # it cannot be adjusted
    ],
)
def test_lenses_differ_where_their_rays_do_by_a_hundredth(model, focal, distortion, differs):
    one, other = (
        Lens(model, (f, 600.0, 400.0, k), width=1200, height=800)
        for f, k in ((900.0, 0.0), (focal, distortion))
    )
    assert one.differs_in_rays(other) is differs
    assert one.differs_in_rays(one) is False


def seen_by(lens, rays):
    """The pixels of rays, by the projection that an adjustment takes."""
    return np.array([see(lens.row(), *ray)[:2] for ray in rays])


@pytest.mark.parametrize("model", sorted(pycolmap.CameraModelId.__members__))
def test_every_model_of_pycolmap_but_panoramas_can_be_adjusted(model):
    assert Lens(model, ()).is_adjustable == (model not in ("EQUIRECTANGULAR", "INVALID"))


@pytest.mark.parametrize("model", WIDE)
def test_other_lenses_project_as_pycolmap_does_and_back(model):
    rng = np.random.default_rng(0)
    lens = Lens(model, LENSES[model], width=640, height=480)
    camera = pycolmap.Camera(model=model, width=640, height=480, params=lens.parameters)
    rays = np.insert(rng.uniform(-0.8, 0.8, (300, 2)), 2, 1.0, axis=1)
    rays[:3, :2] = [[0.0, 0.0], [1e-12, 0.0], [1e-5, 2e-5]]
    found = seen_by(lens, rays)
    # 1e-6 px: pycolmap divides by the radius where it is small, which leaves as much of a FOV lens.
    np.testing.assert_allclose(found, camera.img_from_cam(rays), rtol=0.0, atol=1e-6)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    np.testing.assert_allclose(lens.rays(found), rays, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("model", ROUND)
def test_what_is_behind_a_wide_lens_has_a_pixel_and_that_its_ray(model):
    lens = Lens(model, LENSES[model])
    angle, turn = np.radians(np.meshgrid([80.0, 90.0, 91.0, 110.0], np.arange(5.0, 360.0, 30.0)))
    rays = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=-1)
    for ray in rays.reshape(-1, 3):
        assert is_seen(lens.row(), *ray)
        np.testing.assert_allclose(lens.rays(seen_by(lens, [ray]))[0], ray, atol=1e-9)
    assert not is_seen(lens.row(), 0.0, 0.0, -1.0) or model in ("EUCM", "SIMPLE_DIVISION", "DIVISION")


def test_where_a_picture_of_a_fisheye_is_folded_there_is_no_ray():
    lens = Lens("SIMPLE_RADIAL_FISHEYE", (500.0, 0.0, 0.0, -0.2))
    largest = np.sqrt(1.0 / 0.6)  # angle at which 500 a (1 - .2 a^2) is largest
    most = 500.0 * largest * (1.0 - 0.2 * largest**2)
    rays = lens.rays(np.array([[0.99 * most, 0.0], [0.0, -0.99 * most], [1.01 * most, 0.0]]))
    assert np.isfinite(rays).all(axis=1).tolist() == [True, True, False]
    assert (np.arccos(rays[:2, 2]) < largest).all()


@pytest.mark.parametrize("model", LENSES)
def test_a_lens_takes_other_values_and_a_longer_focal_length(model):
    lens = Lens(model, LENSES[model])
    values = lens.values() * 1.5
    changed = lens.with_values(values)
    np.testing.assert_array_equal(changed.values(), values)
    assert changed.parameters[8:] == lens.parameters[8:]
    assert lens.with_values(lens.values()) == lens
    own = int(lens.own_values()[:2].sum())
    assert lens.longer(2.0).parameters == (*(2.0 * f for f in lens.parameters[:own]), *lens.parameters[own:])
    assert lens.longer(2.0).focal_px == 2.0 * lens.focal_px


@pytest.mark.parametrize(
    ("model", "coefficients", "credible"),
    [
        ("RADIAL_FISHEYE", (-0.1, 0.02), True),
        ("RADIAL_FISHEYE", (-0.9, 0.1), False),  # folded inside the picture
        ("OPENCV_FISHEYE", (60.0, 0.0, 0.0, 0.0), False),
        ("EUCM", (0.7, 2.5), True),  # coefficients that are no small numbers
        ("EUCM", (0.7, 200.0), False),
        ("FOV", (2.2,), True),
        ("SIMPLE_DIVISION", (-0.5,), True),
        ("SIMPLE_DIVISION", (-30.0,), False),
        ("RADIAL", (0.1, -0.1), True),
        ("RADIAL", (0.1, -2.1), False),
    ],
)
def test_a_distortion_is_credible_by_what_it_does_in_the_picture(model, coefficients, credible):
    num_focal = 1 if model.startswith(("SIMPLE_", "RADIAL")) else 2
    sizes = (*(300.0,) * num_focal, 320.0, 240.0)
    given = Lens(model, (*sizes, *(0.0,) * len(coefficients)), width=640, height=480).in_doubt(Origin.GUESS)
    assert given.is_credible(1e-4)
    assert replace(given, parameters=(*sizes, *coefficients)).is_credible(1e-4) is credible
