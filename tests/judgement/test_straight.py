"""Cameras on a line: when they are, and how well lengths along it are known."""

import numpy as np

from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.judgement.straight import find_line, sigma_along

ALONG = np.array([0.6, 0.0, 0.8])


def directions(spread_deg, wrong=0):
    rng = np.random.default_rng(3)
    found = np.where(rng.random(100) < 0.5, 1.0, -1.0)[:, None] * ALONG
    found = normalized(found + np.radians(spread_deg) * rng.uniform(-1.0, 1.0, (100, 3)) / np.sqrt(3.0))
    found[:wrong] = normalized(rng.standard_normal((wrong, 3)))
    return found


def test_a_line_is_one_to_a_degree_whatever_a_few_directions_say():
    line = find_line(directions(0.9, wrong=4))
    assert abs(line @ ALONG) > np.cos(np.radians(0.3))
    assert find_line(directions(3.0)) is None
    assert find_line(directions(0.1, wrong=20)) is None
    assert find_line(directions(0.1)[:2]) is None


def test_what_is_known_along_it_is_a_share_of_its_length():
    locations = np.arange(11.0)[:, None] * ALONG
    covariances = np.tile(0.04 * np.outer(ALONG, ALONG) + np.eye(3) - np.outer(ALONG, ALONG), (11, 1, 1))
    assert np.isclose(sigma_along(ALONG, locations, covariances), 0.02)
    assert np.isnan(sigma_along(ALONG, locations, np.full((11, 3, 3), np.nan)))
