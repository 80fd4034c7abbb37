"""Standard deviations of adjusted centers: made scenes whose errors are known must have them."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import Legendre
from scipy.spatial.transform import Rotation

from sfm_shapefit.adjustment import shared_errors
from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.problem import RotationPrior, isotropic_information
from sfm_shapefit.adjustment.shared_errors import estimate_center_errors
from sfm_shapefit.adjustment.solve import adjust
from sfm_shapefit.base.geometry import METRIC_SIGMA, fit_similarity_l1
from tests.adjustment.made import observed, ring_problem

OPTIONS = AdjustmentOptions(loss_scale_px=1.0, noise_px=0.5, cost_tolerance=1e-8)


def ratios(truth, options, *, start=None, turn_sigma_rad=0.0, align=True):
    """Errors of the centers over their standard deviations, and what was said of them."""
    adjusted = adjust(start or truth, options).problem
    found = estimate_center_errors(adjusted, options, turn_sigma_rad)
    centers = adjusted.centers
    if align:
        free = not options.hold_rotations and truth.rotation_prior is None
        centers = fit_similarity_l1(centers, truth.centers, rotate=free).apply(centers)
    squares = np.sum((centers - truth.centers) ** 2, axis=1)
    moves = ~truth.fixed
    variances = np.einsum("naa->n", found.covariances)
    return np.sqrt(squares[moves] / variances[moves]), found


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


# Over 5 draws of 12 cameras there are about 150 degrees of freedom: the rms scatters by 1 / sqrt(300) = 6 %,
# the standard deviations, from 32 groups, by as much again. Bands are 1 within a quarter.
@pytest.mark.parametrize("case", ["free", "held", "rig", "fixed", "weighted"])
def test_errors_under_known_noise_are_as_large_as_stated(case):
    found = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        truth = ring_problem(rng, 12, 400, share=0.4, sensors=2 if case == "rig" else 0)
        options, start = OPTIONS, None
        if case in ("held", "fixed"):
            options = replace(options, hold_rotations=case == "held")
        if case == "fixed":
            truth = replace(truth, fixed=np.arange(12) < 2)
        if case == "weighted":
            sigma = 2e-3
            given = Rotation.from_rotvec(sigma * rng.standard_normal((12, 3))).as_matrix() @ truth.rotations
            prior = RotationPrior(rotations=given, information=isotropic_information(np.full(12, sigma)))
            start = replace(truth, rotations=given, rotation_prior=prior)
            truth = replace(truth, rotation_prior=prior)
        found.append(ratios(truth, options, start=start, align=case != "fixed")[0])
    assert 0.75 < rms(np.concatenate(found)) < 1.25


def test_priors_known_equally_well_along_all_axes_err_alike_whatever_rounding_takes_for_axes():
    problem, found = ring_problem(np.random.default_rng(0), 12, 400, share=0.4), []
    for seed in range(2):
        rounding = np.random.default_rng(seed).uniform(-1e-7, 1e-7, (12, 3, 3))  # of 2.5e5
        information = isotropic_information(np.full(12, 2e-3)) + rounding + rounding.transpose(0, 2, 1)
        prior = RotationPrior(rotations=problem.rotations, information=information)
        found.append(estimate_center_errors(replace(problem, rotation_prior=prior), OPTIONS).covariances)
    np.testing.assert_allclose(*found, rtol=1e-6, atol=1e-6 * np.abs(found[0]).max())


@pytest.mark.parametrize(("offset", "is_metric"), [(0.3, True), (3e-5, False)])
def test_the_scale_of_a_rig_is_as_well_known_as_stated(offset, is_metric):
    """Noise of 0.5 of 500 px at a distance of 4 is 4e-3: offsets must be more than that."""
    scales, errors = [], []
    for seed in range(6):
        truth = ring_problem(np.random.default_rng(seed), 12, 400, share=0.4, sensors=2, offset=offset)
        adjusted = adjust(truth, OPTIONS).problem
        found = estimate_center_errors(adjusted, OPTIONS)
        fit = fit_similarity_l1(adjusted.centers, truth.centers, rotate=True)
        off = fit.apply(adjusted.centers) - truth.centers
        scales.append((1.0 / fit.scale - 1.0) / found.scale_sigma)
        assert (found.scale_sigma < METRIC_SIGMA) == is_metric
        variances = fit.scale**2 * np.einsum("naa->n", found.covariances)
        errors.append(np.sqrt(np.sum(off**2, axis=1) / variances))
    # Six draws of one number: their rms is below 0.4 or above 1.8 once in a hundred times.
    assert 0.4 < rms(scales) < 1.8 or not is_metric
    # The shape is as well known where the scale is not: the covariances are of it.
    assert 0.75 < rms(np.concatenate(errors)) < 1.25


def test_errors_of_rotations_that_are_held_are_in_it():
    found, without = [], []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        truth = ring_problem(rng, 12, 400, share=0.4)
        sigma = 3e-3
        turned = Rotation.from_rotvec(sigma * rng.standard_normal((12, 3))).as_matrix() @ truth.rotations
        start = replace(truth, rotations=turned)
        options = replace(OPTIONS, hold_rotations=True)
        found.append(ratios(truth, options, start=start, turn_sigma_rad=sigma)[0])
        without.append(ratios(truth, options, start=start)[0])
    assert 0.75 < rms(np.concatenate(found)) < 1.25
    assert rms(np.concatenate(without)) > 2.0


def test_noise_that_neighbors_share_is_in_it():
    found = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        truth = ring_problem(rng, 12, 800, share=0.4, noise_px=0.3)
        # The points of one of 80 cells err together, in each camera by 0.3 px. It sees 4 of them, which
        # multiplies the variance by 1 + 3 / 2, and the errors by 1.6.
        cells = np.floor((truth.points + 1.0) * [2.5, 2.0, 2.0]).astype(int) @ [1, 5, 20]
        shared = 0.3 * rng.standard_normal((truth.num_cameras, 80, 2))
        truth = replace(truth, pixels=truth.pixels + shared[truth.cameras_seeing, cells[truth.points_seen]])
        found.append(ratios(truth, OPTIONS)[0])
    # Groups of 12 or 13 points cut the cells: some of what these share is lost.
    assert 0.75 < rms(np.concatenate(found)) < 1.5


def test_a_lens_that_is_off_is_seen_and_one_that_is_right_is_not():
    rng = np.random.default_rng(0)
    truth = ring_problem(rng, 12, 800, share=0.5)
    right = ratios(truth, OPTIONS)[1]
    assert right.lens_errors.own_px == right.lens_errors.shared_px == 0.0
    focal, cx, cy = truth.lenses[0].parameters
    bent = (replace(truth.lenses[0], model="SIMPLE_RADIAL", parameters=(focal, cx, cy, 0.03)),)
    errors, found = ratios(truth, OPTIONS, start=replace(truth, lenses=bent))
    assert found.lens_errors.own_px > 0.2
    assert rms(errors) < 1.5


def test_what_the_images_of_a_lens_err_by_together_is_as_large_as_stated():
    """A field of each lens, drawn from the polynomials of the estimate with 0.3 px each."""
    found, sizes = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        truth = ring_problem(rng, 12, 800, share=0.5, noise_px=0.1)
        low, high = truth.pixels.min(axis=0), truth.pixels.max(axis=0)
        x, y = ((2.0 * truth.pixels - low - high) / (high - low)).T
        degrees = [(i, j) for i in range(4) for j in range(4 - i)]
        basis = np.stack(
            [
                np.sqrt((2 * i + 1) * (2 * j + 1)) * Legendre.basis(i)(x) * Legendre.basis(j)(y)
                for i, j in degrees
            ]
        )
        bent = replace(truth, pixels=truth.pixels + (0.3 * rng.standard_normal((2, 10)) @ basis).T)
        errors, estimate = ratios(truth, OPTIONS, start=bent)
        found.append(errors)
        sizes.append(estimate.lens_errors.shared_px)
    assert np.median(sizes) == pytest.approx(0.3, rel=0.3)
    # What the frames leave of the fields counts as noise of the points, too: errors are stated too large.
    assert 0.3 < rms(np.concatenate(found)) < 1.2


def test_the_variance_of_measured_numbers_is_found_beside_their_noise():
    rng = np.random.default_rng(0)
    noise = rng.uniform(0.1, 5.0, 4000)
    pure = np.sqrt(noise) * rng.standard_normal(4000)
    assert shared_errors.likeliest_variance(pure, noise) < 0.03
    measured = pure + np.sqrt(0.5) * rng.standard_normal(4000)
    assert shared_errors.likeliest_variance(measured, noise) == pytest.approx(0.5, rel=0.1)


def test_fixed_frames_have_no_error_and_unseen_ones_none_that_is_known():
    truth = ring_problem(np.random.default_rng(0), 8, 200)
    truth = replace(observed(truth, truth.cameras_seeing != 5), fixed=np.arange(8) < 2)
    covariances = estimate_center_errors(adjust(truth, OPTIONS).problem, OPTIONS).covariances
    assert (covariances[:2] == 0.0).all()
    assert np.isnan(covariances[5]).all()
    assert (np.linalg.eigvalsh(covariances[[2, 3, 4, 6, 7]])[:, 0] > 0.0).all()
