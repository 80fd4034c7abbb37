"""Another place for a camera, on which its rejected pairs agree."""

import numpy as np
import pytest

from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.judgement.places import AmbiguousPlace, find_other_places

NAMES = tuple(f"{k}.jpg" for k in range(30))


def scene(*, lying=8, agreeing=10, spread_deg=0.1, coherent=True):
    """One camera, 0, and others; the last `lying` of its pairs put it at (4, 1, 2), or anywhere."""
    rng, n = np.random.default_rng(3), 1 + agreeing + lying
    centers = rng.uniform(-5.0, 5.0, (n, 3))
    elsewhere = np.array([4.0, 1.0, 2.0])
    pairs = np.stack([np.zeros(n - 1, dtype=int), np.arange(1, n)], axis=1)
    seen = np.tile(centers[0], (n - 1, 1))
    seen[agreeing:] = elsewhere if coherent else rng.uniform(-5.0, 5.0, (lying, 3))
    directions = normalized(seen - centers[1:])
    directions = normalized(directions + np.radians(spread_deg) * rng.standard_normal(directions.shape))
    agrees = np.arange(n - 1) < agreeing
    return centers, pairs, directions, agrees


def test_it_is_found_with_both_counts_whatever_the_order_of_a_pair():
    centers, pairs, directions, agrees = scene()
    for turned in (False, True):
        if turned:
            pairs, directions = pairs[:, ::-1], -directions
        (found,) = find_other_places(NAMES, centers, pairs, directions, agrees, 0.1)
        assert (found.image, found.num_here, found.num_there) == ("0.jpg", 10, 8)
        here = [tuple(NAMES[k] for k in pair) for pair in pairs[agrees].tolist()]
        assert found.pairs_here == tuple(here)
        assert centers[0] + found.offset == pytest.approx([4.0, 1.0, 2.0], abs=0.1)


def test_wrong_pairs_that_agree_on_nothing_are_no_other_place():
    assert find_other_places(NAMES, *scene(coherent=False), 0.1) == ()


def test_few_pairs_are_none_and_nor_is_one_that_more_than_twice_as_many_contradict():
    assert find_other_places(NAMES, *scene(lying=2, agreeing=2), 0.1) == ()
    assert find_other_places(NAMES, *scene(lying=4, agreeing=9), 0.1) == ()
    assert len(find_other_places(NAMES, *scene(lying=5, agreeing=9), 0.1)) == 1


def test_loose_directions_tell_none_and_nor_do_rays_that_meet_behind():
    assert find_other_places(NAMES, *scene(), 1.1) == ()
    centers, pairs, directions, agrees = scene()
    directions[~agrees] *= -1.0
    assert find_other_places(NAMES, centers, pairs, directions, agrees, 0.1) == ()


def test_a_camera_on_a_line_that_may_stand_anywhere_on_it_has_no_other_place():
    n = 8
    centers = np.zeros((n, 3))
    centers[:, 0] = np.arange(n)
    centers[5:] = [[0.0, 2.0, 0.0], [0.0, 0.0, 2.0], [2.0, 2.0, 1.0]]
    pairs = np.stack([np.zeros(n - 1, dtype=int), np.arange(1, n)], axis=1)
    seen = np.where(np.arange(1, n)[:, None] < 5, centers[0], [-3.0, 0.0, 0.0])
    agrees = np.arange(1, n) < 5
    assert find_other_places(NAMES, centers, pairs, normalized(seen - centers[1:]), agrees, 0.1) == ()


def test_cameras_without_a_place_are_not_asked():
    centers, pairs, directions, agrees = scene()
    centers[0] = np.nan
    assert find_other_places(NAMES, centers, pairs, directions, agrees, 0.1) == ()


def test_the_offset_of_another_place_goes_to_the_units_and_axes_of_the_output():
    (found,) = find_other_places(NAMES, *scene(), 0.1)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    x, y, z = found.offset
    assert found.moved(2.0, None).offset == (2.0 * x, 2.0 * y, 2.0 * z)
    assert found.moved(2.0, turn).offset == (-2.0 * y, 2.0 * x, 2.0 * z)


@pytest.mark.parametrize(
    ("num_here", "said"),
    [
        (0, "no pair puts 0.jpg where it is, 3 put it 5 units away"),
        (1, "1 pair puts 0.jpg where it is, 3 put it 5 units away"),
        (2, "2 pairs put 0.jpg where it is, 3 put it 5 units away"),
    ],
)
def test_both_places_are_told_in_a_sentence(num_here, said):
    place = AmbiguousPlace(image="0.jpg", num_here=num_here, num_there=3, offset=(3.0, 0.0, 4.0))
    assert place.statement.startswith(said)
