"""Distances between cameras and points: how often the truth is within what is said of them."""

from dataclasses import replace

import numpy as np
import pytest

import sfm_shapefit
from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.given_rotations import noise_px_of
from sfm_shapefit.adjustment.lengths import estimate_lengths
from sfm_shapefit.adjustment.problem import Rig
from sfm_shapefit.adjustment.solve import adjust
from sfm_shapefit.base.errors import InputError
from tests.adjustment.made import ring_problem
from tests.adjustment.test_views import disturbed, scene

PLAIN = AdjustmentOptions(loss_scale_px=None)
ENDS = np.array([[0, 3], [0, 5], [2, 8], [11, 30], [14, 3]])
"""Cameras are 0 to 7 in ENDS, points begin at 8."""


@pytest.mark.parametrize("has_rigs", [False, True])
@pytest.mark.parametrize("free_focal_lengths", [False, True])
def test_truth_is_within_95_percent_as_often_as_that(has_rigs, free_focal_lengths):
    """Of 100 draws of 5 lengths 475 are expected inside; 15 would be three sigmas, were all independent.

    Neighboring lengths are not, and the noise that is read off the errors has an error of its own.
    """
    exact = ring_problem(np.random.default_rng(0), 8, 60, noise_px=0.0, share=0.8)
    if has_rigs:
        exact = in_pairs(exact)
    options = replace(PLAIN, free_focal_lengths=free_focal_lengths)
    right, _ = estimate_lengths(exact, options, ENDS)
    rng, inside, scores = np.random.default_rng(1), 0, []
    for _ in range(100):
        pixels = exact.pixels + 0.4 * rng.standard_normal(exact.pixels.shape)
        found = adjust(replace(exact, pixels=pixels), options).problem
        lengths, sigmas = estimate_lengths(found, replace(options, noise_px=noise_px_of(found)), ENDS)
        scores.append((lengths - right) / sigmas)
        inside += int(np.sum(np.abs(lengths - right) < 1.96 * sigmas))
    assert 450 <= inside <= 492
    rms = np.sqrt(np.mean(np.square(scores), axis=0))
    assert rms.min() > 0.75  # of 100 draws it is off by 7 %
    assert rms.max() < 1.3


def in_pairs(problem):
    """The same cameras, two of a frame each: the second one where it was, by its pose in the rig."""
    first = np.arange(0, 8, 2)
    rotations, centers = problem.rotations, problem.centers
    frames = np.repeat(first, 2)
    in_rig = rotations @ rotations[frames].transpose(0, 2, 1)
    offsets = np.einsum("cab,cb->ca", rotations[frames], centers - centers[frames])
    rig = Rig(
        frame_of_camera=np.repeat(np.arange(4), 2),
        rotations=in_rig,
        translations=-np.einsum("cab,cb->ca", in_rig, offsets),
        free_sensor_of_camera=np.full(8, -1),
    )
    fixed = np.zeros(len(first), np.bool_)
    return replace(problem, rotations=rotations[first], centers=centers[first], rig=rig, fixed=fixed)


def test_a_length_is_told_between_images_and_points_and_a_name_that_is_none_is_refused():
    truth = scene(noise_px=0.5)
    found = sfm_shapefit.bundle_adjust(disturbed(truth))
    first, second = (found.reconstruction.image(k) for k in sorted(found.reconstruction.reg_image_ids())[:2])
    length = found.length(first.name, second.name)
    apart = np.linalg.norm(first.projection_center() - second.projection_center())
    assert length.value == pytest.approx(apart, rel=1e-12)
    assert 0.0 < length.sigma < 0.1 * length.value
    assert str(length).endswith(f"{length.half_width:.{len(str(length).split()[0].split('.')[1])}f} (95 %)")
    looser = found.length(first.name, second.name, scale_sigma=0.1)
    assert looser.sigma == pytest.approx(np.hypot(length.sigma, 0.1 * apart))
    point = min(found.reconstruction.point3D_ids())
    away = np.linalg.norm(first.projection_center() - found.reconstruction.point3D(point).xyz)
    assert found.length(first.name, point).value == pytest.approx(away, rel=1e-12)
    with pytest.raises(InputError, match=r"no posed image nobody\.jpg"):
        found.length("nobody.jpg", first.name)
