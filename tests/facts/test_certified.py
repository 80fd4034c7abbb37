"""What is certified and what is delivered, and how far apart they are."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_shapefit import synthetic
from sfm_shapefit.commands.place import place
from sfm_shapefit.facts.placed import Delivered
from sfm_shapefit.solver.solver_options import Status


@pytest.fixture(scope="module")
def placed():
    return place(synthetic.random_graph_problem(20, 0.6, 3, q=0.1, seed=3).view_graph, objective="shapefit")


def test_the_optimum_itself_is_delivered_if_asked_for_in_any_scale_and_place(placed):
    found = Delivered.compare(placed, 7.0 * placed.locations + [1.0, 2.0, 3.0], adjusted=False)
    assert found.from_certified_max < 1e-9
    assert found.statement.endswith("delivered: that optimum itself")
    assert "no other is as good" in found.statement


def test_the_distance_of_a_camera_that_moved_is_told_as_a_share_of_the_radius(placed):
    centers = placed.locations.copy()
    radius = np.median(np.linalg.norm(centers - np.median(centers, axis=0), axis=1))
    centers[4] += [0.3 * radius, 0.0, 0.0]
    found = Delivered.compare(placed, centers, adjusted=True)
    # The fit is robust, so one camera does not move it; the radius is nearly the same with it moved.
    assert found.from_certified_median < 1e-6
    assert found.from_certified_max == pytest.approx(0.3, rel=0.05)
    assert "then adjusted" in found.statement


def test_cameras_that_are_left_out_do_not_count(placed):
    centers = placed.locations.copy()
    centers[4] = np.nan
    assert Delivered.compare(placed, centers, adjusted=False).from_certified_max < 1e-9


def test_a_solve_that_stopped_early_is_not_said_to_be_certified(placed):
    stopped = replace(placed, certified=replace(placed.certified, status=Status.MAX_ITERATIONS))
    found = Delivered.compare(stopped, placed.locations, adjusted=False)
    assert "not certified to the tolerance" in found.statement
