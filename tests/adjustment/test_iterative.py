"""Conjugate gradients in place of a factor: the same minimum on rows of many blocks, whatever is free."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.iterative_factor import IterativeFactor
from sfm_shapefit.adjustment.layout import lay_out
from sfm_shapefit.adjustment.problem import (
    AdjustmentProblem,
    LensPrior,
    Rig,
    RotationPrior,
    isotropic_information,
)
from sfm_shapefit.adjustment.reduced_factor import SparseFactor
from sfm_shapefit.adjustment.schur import eliminate_points
from sfm_shapefit.adjustment.solve import adjust, linearize_all, values_of
from sfm_shapefit.laplacian.operators import Workers
from sfm_shapefit.scene.known_positions import KnownPositions
from sfm_shapefit.scene.lens import Lens
from tests.adjustment.made import LENSES, disturb, project

FREE = {"free_focal_lengths": True, "free_distortion": True}
SIDE = 18  # frames along and up a wall; 324 make three blocks


def make_wall(size=(SIDE, SIDE), *, models=("SIMPLE_RADIAL",), own_lenses=False, baseline=0.0):
    """Return frames one apart that look at a wall, and points that all within 2.5 of them see; noisy pixels.

    Each has a lens of its own, or is a rig of two cameras `baseline` apart, of which the second is free.
    """
    rng, (width, height) = np.random.default_rng(0), size
    n = width * height
    places = np.stack([*np.divmod(np.arange(n), height)], axis=1) * 1.0
    centers = np.insert(places, 1, 0.0, axis=1) + 0.1 * rng.standard_normal((n, 3))
    points = rng.uniform([0.0, 4.0, 0.0], [width - 1.0, 6.0, height - 1.0], (6 * n, 3))
    near = np.linalg.norm(centers[:, None, ::2] - points[None, :, ::2], axis=2) < 2.5
    frames, seen = np.nonzero(near & (rng.random(near.shape) < 0.5))
    rig, cameras, count = Rig.of_single_cameras(n), frames, n
    if baseline:
        count, cameras, seen = 2 * n, np.append(2 * frames, 2 * frames + 1), np.tile(seen, 2)
        is_second = np.arange(count) % 2
        rig = Rig(
            frame_of_camera=np.arange(count) // 2,
            rotations=np.tile(np.eye(3), (count, 1, 1)),
            translations=is_second[:, None] * np.array([-baseline, 0.0, 0.0]),
            free_sensor_of_camera=is_second - 1,
        )
    lenses = [Lens(model, LENSES[model]) for model in models]
    problem = AdjustmentProblem(
        rotations=np.tile([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], (n, 1, 1)),
        centers=centers,
        points=points,
        cameras_seeing=cameras,
        points_seen=seen,
        pixels=np.zeros((len(seen), 2)),
        lenses=lenses * n if own_lenses else lenses,
        lens_of_camera=np.arange(count) % (n if own_lenses else len(lenses)),
        rig=rig,
    )
    return project(problem, rng, 0.5)


def make_row(**kwargs):
    """Return a wall as low as a row."""
    return make_wall((150, 2), **kwargs)


def prior_on_rotations(problem):
    information = isotropic_information(np.full(problem.num_frames, 1e-3))
    return replace(
        problem, rotation_prior=RotationPrior(rotations=problem.rotations, information=information)
    )


def prior_on_lenses(problem):
    values = np.array([lens.values() for lens in problem.lenses])
    return replace(problem, lens_prior=LensPrior(values=values, information=np.full(values.shape, 1e-2)))


def some_known(problem):
    rows = np.arange(0, problem.num_frames, 20)
    known = KnownPositions(rows, problem.centers[rows], np.tile(1e2 * np.eye(3), (len(rows), 1, 1)))
    return replace(problem, center_prior=known)


CASES = {
    "poses": (make_wall, {}),
    "held rotations": (make_wall, {"hold_rotations": True}),
    "fixed frames": (lambda: replace(make_wall(), fixed=np.arange(SIDE**2) % 80 == 0), {}),
    "one lens": (lambda: prior_on_lenses(make_wall()), FREE),
    "three lenses": (lambda: prior_on_lenses(make_wall(models=("PINHOLE", "SIMPLE_RADIAL", "OPENCV"))), FREE),
    "a lens each": (lambda: prior_on_lenses(make_wall(own_lenses=True)), FREE),
    "rigs": (lambda: make_wall(baseline=0.4), {}),
    "rotations weighted": (lambda: prior_on_rotations(make_wall()), {}),
    "centers weighted": (lambda: some_known(make_wall()), {}),
}


@pytest.mark.parametrize("name", CASES)
def test_steps_by_conjugate_gradients_lead_to_the_minimum_of_a_factor(name):
    make, free = CASES[name]
    start = disturb(make(), np.random.default_rng(1), center=0.005, rotation_rad=5e-4, point=0.005)
    start = start if "hold_rotations" not in free else replace(start, rotations=make().rotations)
    options = AdjustmentOptions(first_damping=1e-8, cost_tolerance=1e-12, loss_scale_px=None, **free)
    by_factor, iteratively = (adjust(start, options, linear_solver=way) for way in ("sparse", "iterative"))
    assert iteratively.converged
    assert iteratively.iterations <= 2 * by_factor.iterations
    extent = np.ptp(by_factor.problem.centers, axis=0).max()
    np.testing.assert_allclose(iteratively.problem.centers, by_factor.problem.centers, atol=1e-6 * extent)


@pytest.mark.parametrize(("rig", "free"), [({}, {}), ({}, FREE), ({"baseline": 0.4}, {})])
def test_few_iterations_see_how_a_row_bends(rig, free):
    """A long row bends for n^-4 of what moves one camera: without the coarse space, steps miss that."""
    problem, options = make_row(**rig), AdjustmentOptions(loss_scale_px=None, **free)
    bend = 0.5 * (problem.centers[:, 0] / problem.centers[:, 0].max() - 0.5) ** 2
    problem = replace(problem, centers=problem.centers + bend[:, None] * [0.0, 1.0, 0.0])
    layout, workers = lay_out(problem, options), Workers(1)
    normal = linearize_all(problem, layout, values_of(problem), options, workers)
    system = eliminate_points(layout, normal, 1e-8, workers)
    factors = SparseFactor.of(layout, 1, np.float64), IterativeFactor(problem, layout, workers)
    steps = []
    for factor in factors:
        factor.refactor(system)
        steps.append(factor.solve(system.right[:, :, None])[:, :, 0])
    size = int(layout.active.any(axis=0).sum())

    def energy(x):
        return float(np.vdot(x[:, :size], system.times(layout.pairs, x[:, :size])))

    exact, found = steps
    assert energy(found - exact) < 1e-4**2 * energy(exact)
    # Where a step ends, it promises the decrease that it takes.
    assert energy(found) == pytest.approx(float(np.vdot(found, system.right)), rel=1e-6)


def test_threads_do_not_change_one_bit_of_many_blocks():
    start = disturb(make_wall(), np.random.default_rng(1), center=0.005, rotation_rad=5e-4, point=0.005)
    one, *others = (
        adjust(start, linear_solver="iterative", max_iterations=3, threads=count, **FREE)
        for count in (1, 2, 3, 7)
    )
    for other in others:
        np.testing.assert_array_equal(other.problem.centers, one.problem.centers)
        np.testing.assert_array_equal(other.costs, one.costs)
