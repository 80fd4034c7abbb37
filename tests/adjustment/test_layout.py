"""Lenses that share a node of the reduced system: which do, and that the answer stays what it is."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.covariance import estimate_covariances
from sfm_shapefit.adjustment.layout import lay_out
from sfm_shapefit.adjustment.solve import adjust
from sfm_shapefit.scene.lens import Lens
from tests.adjustment.made import LENSES, disturb, observed, ring_problem

OPTIONS = AdjustmentOptions(
    loss_scale_px=None, cost_tolerance=1e-12, free_focal_lengths=True, free_distortion=True
)


def with_a_lens_each(models, **made):
    """A ring of eight images with a lens each, started elsewhere."""
    rng = np.random.default_rng(0)
    problem = ring_problem(rng, 8, 120, share=0.8, **made)
    lenses = [Lens(model, LENSES[model]) for model in models]
    exact = replace(problem, lenses=lenses, lens_of_camera=np.arange(8))
    return disturb(exact, rng, 0.01, 0.002, 0.01)


def lenses_by_node(problem):
    """Rows of the lenses in each node that has any, ascending."""
    of = lay_out(problem, OPTIONS).node_of_lens.tolist()
    return sorted([k for k, node in enumerate(of) if node == one] for one in set(of) - {-1})


def test_lenses_of_few_unknowns_share_a_node_as_far_as_there_is_room():
    problem = with_a_lens_each(["SIMPLE_RADIAL"] * 8)
    assert sorted(map(len, lenses_by_node(problem))) == [2, 3, 3]
    found = lay_out(problem, OPTIONS)
    taken = found.lens_slots[found.lens_slots >= 0].reshape(8, -1)
    places = [(found.node_of_lens[k], slot) for k in range(8) for slot in set(taken[k].tolist())]
    assert len(set(places)) == len(places) == 16
    assert found.num_unknowns == 8 * 6 + 16
    mixed = with_a_lens_each(["OPENCV", "RADIAL", "SIMPLE_PINHOLE", "RADIAL", *["OPENCV"] * 4])
    assert [0] in lenses_by_node(mixed)  # it has six unknowns of its own
    assert sum(len(own) > 1 for own in lenses_by_node(mixed)) == 1
    held = replace(problem, lenses=[replace(problem.lenses[0], fixed=True), *problem.lenses[1:]])
    assert lay_out(held, OPTIONS).node_of_lens[0] == -1


def test_lenses_that_look_at_other_points_share_no_node():
    problem = with_a_lens_each(["SIMPLE_RADIAL"] * 8)
    side = problem.lens_of_camera[problem.cameras_seeing] % 2 == problem.points_seen % 2
    problem = observed(problem, np.flatnonzero(side))
    assert all(len({k % 2 for k in own}) == 1 for own in lenses_by_node(problem))


@pytest.mark.parametrize("solver", ["dense", "sparse", "iterative"])
def test_the_answer_does_not_depend_on_which_lenses_share_a_node(solver):
    problem = with_a_lens_each(["SIMPLE_RADIAL"] * 8, noise_px=0.3)
    options, order = replace(OPTIONS, linear_solver=solver), np.random.default_rng(0).permutation(8)
    lenses = [problem.lenses[k] for k in order]
    other = replace(problem, lenses=lenses, lens_of_camera=np.argsort(order)[problem.lens_of_camera])
    assert lenses_by_node(problem) != lenses_by_node(other)
    answers = []
    for one, rows in ((problem, np.arange(8)), (other, np.argsort(order))):
        found = adjust(one, options).problem
        known = estimate_covariances(found, options)
        values = np.array([lens.values() for lens in found.lenses])[rows]
        answers.append((found.centers, values, known.centers, known.lens_sigmas[rows]))
    for one, two in zip(*answers, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-5, atol=1e-8)
