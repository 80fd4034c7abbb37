"""Lenses that cannot be are told from long, wide and distorted ones that can."""

import numpy as np
import pytest

from sfm_shapefit.judgement.lenses import find_odd_lenses, measure_lens
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.scene.points import Points
from sfm_shapefit.scene.structure import Structure

WIDTH, HEIGHT = 1600, 1200
MIDDLE = (800.0, 600.0)
NO_POINTS = Points(
    xyz=np.zeros((0, 3)),
    offsets=np.zeros(1, dtype=np.int64),
    images=np.zeros(0, dtype=np.int64),
    keypoints=np.zeros(0, dtype=np.int64),
    ids=np.zeros(0, dtype=np.int64),
)

IMPOSSIBLE = {
    "finer": ("PINHOLE", (2000.0 * WIDTH, 2000.0 * WIDTH, *MIDDLE)),
    "degrees wide": ("SIMPLE_RADIAL", (0.07 * WIDTH, *MIDDLE, -5e-4)),
    "turns back": ("SIMPLE_RADIAL", (38.0 * WIDTH, *MIDDLE, -3000.0)),
    "draws the edges in": ("SIMPLE_RADIAL", (2.0 * WIDTH, *MIDDLE, -1.4)),
    "as no lens does": ("RADIAL", (4.4 * WIDTH, *MIDDLE, 12_000.0, 0.0)),
    "back inside the picture": ("SIMPLE_RADIAL_FISHEYE", (1500.0, *MIDDLE, -2.0)),
    "the picture": ("SIMPLE_RADIAL", (1200.0, *MIDDLE, -1e12)),
}
UNUSUAL = {
    "hardly any lens": ("RADIAL", (1.9 * WIDTH, *MIDDLE, 3.0, -5.3)),
    "principal point outside": ("PINHOLE", (1000.0, 1000.0, 1700.0, 600.0)),
}
SOUND = {
    "phone": ("SIMPLE_RADIAL", (0.75 * WIDTH, *MIDDLE, 0.05)),
    "space probe": ("PINHOLE", (40.0 * WIDTH, 40.0 * WIDTH, *MIDDLE)),
    "face of a cube map": ("SIMPLE_PINHOLE", (0.5 * WIDTH, *MIDDLE)),
    "action camera, whose corners have no ray": ("SIMPLE_RADIAL", (0.55 * WIDTH, *MIDDLE, -0.2)),
    "fisheye of 220 degrees": ("SIMPLE_FISHEYE", (HEIGHT / 3.84, *MIDDLE)),
    "large coefficients that cancel": (
        "FULL_OPENCV",
        (1200.0, 1200.0, *MIDDLE, 5.2, 3.1, 0.0, 0.0, 0.2, 5.2, 3.0, 0.2),
    ),
    "flat port under water": ("SIMPLE_RADIAL", (0.9 * WIDTH, *MIDDLE, 0.25)),
    "one that gives twice the focal length": ("FOV", (500.0, 500.0, *MIDDLE, 0.9)),
}


def fault(model, parameters, size=(WIDTH, HEIGHT), reach_px=np.nan, is_bogus=False):
    lens = Lens(model, parameters, width=size[0], height=size[1])
    return measure_lens(lens, reach_px).fault(lens, is_bogus)


@pytest.mark.parametrize("what", IMPOSSIBLE)
def test_a_lens_that_no_maker_can_make_is_recognized(what):
    said, cannot_be = fault(*IMPOSSIBLE[what])
    assert what in said
    assert cannot_be


@pytest.mark.parametrize("what", UNUSUAL)
def test_an_unusual_lens_is_not_impossible(what):
    said, cannot_be = fault(*UNUSUAL[what])
    assert what in said
    assert not cannot_be


@pytest.mark.parametrize("what", SOUND)
def test_a_sound_lens_has_no_fault_though_its_numbers_are_large(what):
    assert fault(*SOUND[what]) == ("", False)


def test_a_lens_is_asked_as_far_as_its_points_reach():
    model, parameters = "SIMPLE_RADIAL", (139.0, 50.0, 50.0, 2.0)  # a rendered picture of 100 pixels
    # At 25 px of 139 the distortion is some 2 * .18^2 = 6 %, or 1.5 px: less than fits.
    assert fault(model, parameters, (100, 100), reach_px=25.0) == ("", False)
    assert fault(model, parameters, (100, 100), reach_px=60.0)[0]  # more than 4 px


def test_what_colmap_drops_is_named_only_if_its_distortion_matters():
    bent, straight = (("SIMPLE_RADIAL", (2.0 * WIDTH, *MIDDLE, k)) for k in (1.4, 0.2))
    assert fault(*bent) == ("", False)
    assert "COLMAP" in fault(*bent, is_bogus=True)[0]
    assert fault(*straight, is_bogus=True) == ("", False)


def test_the_measures_of_a_pinhole_are_those_of_trigonometry():
    lens = Lens("PINHOLE", (1000.0, 1100.0, *MIDDLE), width=WIDTH, height=HEIGHT)
    shape = measure_lens(lens)
    assert shape.view_deg == pytest.approx(2.0 * np.degrees(np.arctan2(800.0, 1000.0)))
    assert shape.of_tangent == pytest.approx((1.0, 1.0))
    assert shape.focal_widths == pytest.approx(1050.0 / WIDTH)


def odd(focals, names):
    """What is odd about images with lenses of their own, which have no points."""
    count = len(focals)
    lenses = [
        Lens("SIMPLE_PINHOLE", (f * WIDTH, *MIDDLE), id=k, width=WIDTH, height=HEIGHT)
        for k, f in enumerate(focals)
    ]
    images = Images.listed(names, (np.tile(np.eye(3), (count, 1, 1)), np.eye(count, 3)), range(count), lenses)
    return list(find_odd_lenses(Structure(NO_POINTS, images, None), np.zeros(count, dtype=np.bool_)))


@pytest.mark.parametrize("scatter", [0.02, 0.3])
def test_lenses_of_one_device_are_alike(scatter):
    focals = 0.8 * np.exp(np.random.default_rng(3).normal(0.0, scatter, 30))
    found = odd(focals, [f"frame{k:03}.jpg" for k in range(30)])
    assert bool(found) == (scatter > 0.1)
    for one in found:
        off = np.abs(np.log(focals / np.median(focals)))
        assert one.images == tuple(f"frame{k:03}.jpg" for k in np.flatnonzero(off > 0.1))
        unlike = focals[off > 0.1]
        assert f"{unlike.min():.2f} to {unlike.max():.2f} picture widths" in one.what
        assert [f"{focal:.2f} picture widths" in own for focal, own in zip(unlike, one.of_each, strict=True)]
        assert not one.cannot_be


@pytest.mark.parametrize("ratios", [(1.0, 1.5), (0.5, 1.0, 3.0), (24.0, 35.0, 50.0, 70.0)])
@pytest.mark.parametrize("scatter", [0.0, 0.02])
def test_devices_lenses_of_a_telephone_and_settings_of_a_zoom_are_no_scatter(ratios, scatter):
    rng = np.random.default_rng(5)
    focals = 0.8 / ratios[0] * rng.permutation(np.resize(ratios, 24)) * np.exp(rng.normal(0.0, scatter, 24))
    names = [f"frame{k:03}.jpg" for k in range(24)]
    assert odd(focals, names) == []
    focals[5] *= 7.0  # one that is not determined is no reason to doubt the rest
    assert odd(focals, names) == []


def test_ten_wild_lenses_of_a_video_are_unusual_whatever_they_are():
    rng = np.random.default_rng(6)
    names = [f"frame{k:03}.jpg" for k in range(10)]
    named = [bool(odd(0.8 * np.exp(rng.uniform(-1.0, 1.0, 10)), names)) for _ in range(50)]
    assert sum(named) >= 47  # 2 % return to few values by chance: 4 of 50 in one case of fifty


def test_photographs_that_were_collected_may_have_unlike_lenses():
    rng = np.random.default_rng(4)
    names = [f"{a:08}_{b:010}.jpg" for a, b in rng.integers(1, (10**8, 10**10), (30, 2)).tolist()]
    assert odd(0.8 * np.exp(rng.normal(0.0, 0.4, 30)), names) == []
