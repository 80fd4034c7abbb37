"""Which pairs agree with where cameras stand: limits that no model can set for itself."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.judgement.pair_fits import fit_pairs
from sfm_shapefit.judgement.seams import find_cuts
from sfm_shapefit.pairs.pair_directions import DirectionStatus
from sfm_shapefit.scene.images import Frames
from sfm_shapefit.scene.points import Points
from tests.judgement.test_left_out import Scene
from tests.judgement.test_seams import EVERY, GROUP, N
from tests.problems import made_directions


def measured(centers, *, off_deg=0.0, sigma_deg=0.01, status=None):
    """Directions of all pairs, off by an angle each."""
    k = len(EVERY)
    directions = normalized(centers[EVERY[:, 0]] - centers[EVERY[:, 1]])
    across = normalized(np.cross(directions, [0.3, 0.5, 0.8]))
    angles = np.radians(np.broadcast_to(off_deg, k))[:, None]
    directions = np.cos(angles) * directions + np.sin(angles) * across
    status = [DirectionStatus.USABLE] * k if status is None else status
    known = np.array([value is DirectionStatus.USABLE for value in status])[:, None]
    covariance = np.tile(np.radians(sigma_deg) ** 2 * np.eye(2), (k, 1, 1))
    return made_directions(EVERY, np.where(known, directions, np.nan), status=status, covariance=covariance)


def each_alone(centers):
    """Images, each in a frame of its own."""
    images, turns = Scene().images.part(np.zeros(N, dtype=int)), np.tile(np.eye(3), (N, 1, 1))
    frames = Frames(ids=np.arange(N), rotations=turns, centers=centers)
    return replace(images, frame_of=np.arange(N), frames=frames)


@pytest.fixture
def centers():
    return np.random.default_rng(1).uniform(-5.0, 5.0, (N, 3))


@pytest.mark.parametrize(
    ("usual_deg", "off_deg", "agrees"),
    [(0.01, 0.9, True), (0.01, 1.1, False), (0.2, 1.5, True), (0.2, 1.9, False), (1.9, 2.1, False)],
)
def test_the_limit_is_six_levels_but_within_one_and_two_degrees(centers, usual_deg, off_deg, agrees):
    angles = np.full(len(EVERY), usual_deg)
    angles[7] = off_deg
    fits = fit_pairs(centers, measured(centers, off_deg=angles))
    assert fits.level_deg == pytest.approx(1.4826 * usual_deg)
    assert fits.agrees[7] == agrees
    assert fits.contradicts[7] != agrees
    assert fits.agrees.sum() >= len(EVERY) - 1


def test_a_pair_that_knows_its_direction_badly_agrees_within_three_of_its_deviations_and_never_contradicts(
    centers,
):
    fits = fit_pairs(centers, measured(centers, off_deg=4.0, sigma_deg=1.5))
    assert fits.agrees.all()
    assert fit_pairs(centers, measured(centers, off_deg=4.0, sigma_deg=1.0)).contradicts.all()
    vague = fit_pairs(centers, measured(centers, off_deg=40.0, sigma_deg=1.5))
    assert not (vague.agrees | vague.contradicts).any()


def test_the_cameras_that_agreeing_pairs_hold_are_counted(centers):
    assert fit_pairs(centers, measured(centers)).held(each_alone(centers)).sum() == N
    moved = centers.copy()
    moved[GROUP] += [0.0, 3.0, 0.0]
    assert fit_pairs(moved, measured(centers)).held(each_alone(centers)).sum() == N - len(GROUP)
    assert fit_pairs(-centers, measured(centers)).held(each_alone(centers)).sum() == 0


def test_points_of_three_images_hold_a_chain_whose_pairs_tell_no_lengths(centers):
    off_deg = np.where(EVERY[:, 1] - EVERY[:, 0] == 1, 0.0, 30.0)
    fits = fit_pairs(centers, measured(centers, off_deg=off_deg))
    assert fits.held(each_alone(centers)).sum() == 2
    seen = np.array([[k, k + 1, k + 2] for k in range(4, N - 2) for _ in range(2)])
    of_three = points_seen_by(seen)
    assert fits.held(each_alone(centers), of_three).sum() == N - 4
    assert (
        fits.held(each_alone(centers), of_three.taken(np.arange(seen.size) % 3 < 2)).sum() == 2
    )  # points of two tell no length


def test_images_of_one_frame_are_held_together(centers):
    apart = np.isin(EVERY, [4, 5]).any(axis=1) & ~(EVERY == [2, 4]).all(axis=1)
    fits = fit_pairs(centers, measured(centers, off_deg=np.where(apart, 30.0, 0.0)))
    images = each_alone(centers)
    assert np.flatnonzero(~fits.held(images)).tolist() == [4, 5]
    frame_of = np.arange(N)
    frame_of[[4, 5]] = 3
    assert fits.held(replace(images, frame_of=frame_of)).all()


def points_seen_by(images):
    """Points, each seen by a row of images."""
    (x, many), none = images.shape, np.zeros(images.size, dtype=np.int64)
    offsets = many * np.arange(x + 1)
    return Points(
        xyz=np.zeros((x, 3)), offsets=offsets, images=images.ravel(), keypoints=none, ids=np.arange(x)
    )


def test_pairs_whose_matches_contradict_the_rotations_count_and_others_without_direction_do_not(centers):
    status = [DirectionStatus.USABLE] * len(EVERY)
    status[3], status[4] = DirectionStatus.LOW_INLIER_RATIO, DirectionStatus.NO_PARALLAX
    fits = fit_pairs(centers, measured(centers, status=status))
    assert np.flatnonzero(fits.contradicts).tolist() == [3]
    assert np.flatnonzero(~fits.agrees).tolist() == [3, 4]
    centers[EVERY[3, 0]] = np.nan  # a camera that is not placed has no part
    fits = fit_pairs(centers, measured(centers, status=status))
    assert not (fits.agrees | fits.contradicts)[np.isin(EVERY, EVERY[3, 0]).any(axis=1)].any()


def test_a_shifted_group_is_cut_and_a_moved_camera_has_its_other_place(centers):
    moved = centers.copy()
    moved[GROUP] += [0.0, 3.0, 0.0]
    fits = fit_pairs(moved, measured(centers))
    (cut,) = find_cuts(*fits.sides, ~fits.held(each_alone(moved)) * np.arange(1, N + 1))
    assert cut.cameras.tolist() == GROUP.tolist()
    moved = centers.copy()
    moved[5] += [0.0, 3.0, 0.0]
    places = fit_pairs(moved, measured(centers)).other_places([str(k) for k in range(N)])
    (place,) = [place for place in places if place.image == "5"]
    assert place.offset == pytest.approx([0.0, -3.0, 0.0], abs=1e-6)
    assert (place.num_here, place.num_there) == (0, N - 1)


def test_a_camera_is_asked_if_more_of_its_pairs_contradict_it_than_is_usual(centers):

    def contradicted(wrong, frame_of):
        own = replace(each_alone(centers), frame_of=np.array(frame_of))
        fits = fit_pairs(centers, measured(centers, off_deg=np.where(wrong, 30.0, 0.0)))
        return fits.contradicted(own)

    def name(row):
        return each_alone(centers).names[row]

    each = list(range(N))
    of_first = (EVERY == 0).any(axis=1)
    assert contradicted(of_first & (EVERY[:, 1] <= (N - 1) // 3), each) == {}
    assert contradicted(of_first & (EVERY[:, 1] <= 6), each) == {name(0): (N - 1, 6)}
    everywhere = EVERY.sum(axis=1) % 4 == 0  # a fourth of all
    assert contradicted(everywhere | (of_first & (EVERY[:, 1] <= 4)), each) == {}
    assert [*contradicted(everywhere | (of_first & (EVERY[:, 1] <= 12)), each)] == [name(0)]
    with_last = [*each[:-1], 0]  # of one frame, whose pairs count together; those inside do not
    assert contradicted(of_first & (EVERY[:, 1] <= 6), with_last) == {}
    both = contradicted(of_first & (EVERY[:, 1] <= 12), with_last)
    assert both == {name(0): (2 * (N - 2), 12), name(N - 1): (2 * (N - 2), 12)}
