"""Directions from matches and known rotations, on pairs whose true direction is known."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_shapefit.base.geometry import angle_between_deg, fit_similarity, normalized, tangent_bases
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.pairs.estimate import estimate_directions
from sfm_shapefit.pairs.pair_directions import DirectionStatus, PairDirections, concatenate
from sfm_shapefit.scene.matches import RayMatches
from sfm_shapefit.solver.solve import solve
from tests.problems import all_pairs, random_rotations

FOCAL_PX = 1000.0
EXACT_DEG = 1e-9  # rays are exact to 1e-16 rad, and 5 degrees of parallax amplify that by a hundred or so


def see(points, noise_px, rng):
    """Unit rays (k, 3) to points in a camera's axes, of pixels with noise."""
    pixels = FOCAL_PX * points[:, :2] / points[:, 2:] + noise_px * rng.standard_normal((len(points), 2))
    return normalized(np.column_stack([pixels / FOCAL_PX, np.ones(len(points))]))


def make_pair(seed, *, count=100, noise_px=0.0, wrong=0.0, baseline=(1.0, 0.2, -0.1), depth=(4.0, 8.0)):
    """Unit rays (k, 3) of one pair in world axes, and the unit direction of C_i - C_j."""
    rng = np.random.default_rng(seed)
    center_i, center_j = np.zeros(3), -np.asarray(baseline, dtype=float)
    points = np.column_stack([rng.uniform(-2, 2, (count, 2)), rng.uniform(*depth, count)])
    rays = [see(points - center, noise_px, rng) for center in (center_i, center_j)]
    shuffled = rng.random(count) < wrong
    rays[1][shuffled] = rays[1][rng.permutation(np.flatnonzero(shuffled))][::-1]
    direction = normalized(center_i - center_j) if np.any(baseline) else np.full(3, np.nan)
    return rays[0], rays[1], direction


def errors_deg(found, pairs):
    """Angles between estimated and true directions."""
    return angle_between_deg(found.directions, np.array([pair[2] for pair in pairs]))


def squared_errors(found, pairs):
    """Errors of the usable directions in units of their covariance: chi-squares of 2 degrees of freedom."""
    usable = found.usable()
    truth = np.array([pair[2] for pair in pairs])[usable]
    tangential = np.einsum("kdi,kd->ki", tangent_bases(found.directions[usable]), truth)
    return np.einsum("ki,kij,kj->k", tangential, np.linalg.inv(found.covariance[usable]), tangential)


def estimate(pairs, options=None, threads=1) -> PairDirections:
    """Estimate a list of (rays_i, rays_j, ...) as one batch."""
    counts = [len(pair[0]) for pair in pairs]
    matches = RayMatches(
        pairs=np.array([(k, k + 1) for k in range(len(pairs))]),
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        rays_i=np.concatenate([pair[0] for pair in pairs]),
        rays_j=np.concatenate([pair[1] for pair in pairs]),
        pixel_angles=np.full(len(pairs), 1.0 / FOCAL_PX),
    )
    return estimate_directions(matches, options, threads)


@pytest.mark.parametrize(
    "baseline", [(1.0, 0.2, -0.1), (-0.4, 0.0, 0.0), (0.05, 0.02, 1.0), (0.0, 0.0, -1.0)]
)
def test_exact_matches_give_the_exact_direction_with_its_sign(baseline):
    pair = make_pair(1, baseline=baseline)
    found = estimate([pair])
    assert found.status == [DirectionStatus.USABLE]
    assert angle_between_deg(found.directions[0], pair[2]) < EXACT_DEG
    assert found.cheirality_fraction[0] == 1.0


def test_swapping_the_images_flips_the_direction_and_turning_the_world_turns_it():
    rays_i, rays_j, direction = make_pair(2, noise_px=0.5)
    rotation = random_rotations(np.random.default_rng(3), 1)[0]
    turned_rays = (rays_i @ rotation.T, rays_j @ rotation.T)
    forward, backward, turned = (
        estimate([rays]).directions[0] for rays in ((rays_i, rays_j), (rays_j, rays_i), turned_rays)
    )
    # The same draws fall on the same matches, so only roundings differ.
    assert angle_between_deg(forward, -backward) < 1e-6
    assert angle_between_deg(turned, rotation @ forward) < 1e-6
    assert angle_between_deg(forward, direction) < 1.0


# 0.5 px in 200 matches at a baseline of a sixth of the depth: about 0.1 degrees; 45 % wrong doubles it. Of 40
# right matches it is 0.12 degrees in the median; the worst of 100 is 4 standard deviations.
@pytest.mark.parametrize(
    ("wrong", "count", "median_deg", "max_deg"),
    [(0.1, 200, 0.2, 1.0), (0.3, 200, 0.2, 1.0), (0.45, 200, 0.2, 1.0), (0.6, 100, 0.25, 2.0)],
)
def test_wrong_matches_inside_the_list_do_not_move_the_direction(wrong, count, median_deg, max_deg):
    options = DirectionOptions(min_inlier_ratio=0.1) if wrong > 0.5 else None
    num_pairs = 100 if wrong > 0.5 else 20
    pairs = [make_pair(seed, count=count, noise_px=0.5, wrong=wrong) for seed in range(num_pairs)]
    found = estimate(pairs, options)
    assert wrong > 0.5 or set(found.status) == {DirectionStatus.USABLE}
    errors = errors_deg(found, pairs)
    assert np.median(errors) < median_deg
    assert errors.max() < max_deg


def test_two_motions_in_one_list_give_the_direction_of_the_larger_one_or_none_if_alike():
    larger, smaller = make_pair(4, count=140), make_pair(5, count=60, baseline=(0.0, 1.0, 0.3))
    found = estimate([tuple(np.concatenate([larger[k], smaller[k]]) for k in (0, 1))])
    assert found.status == [DirectionStatus.USABLE]
    assert angle_between_deg(found.directions[0], larger[2]) < 0.01  # soft weights keep a trace of the rest
    pairs = []
    for seed in range(20):
        one = make_pair(seed, count=100, noise_px=0.5)
        other = make_pair(seed + 50, count=80, noise_px=0.5, baseline=(0.0, 1.0, 0.3))
        pairs.append(tuple(np.concatenate([one[k], other[k]]) for k in (0, 1)))
    assert set(estimate(pairs).status) == {DirectionStatus.TWO_MOTIONS}
    lenient = estimate(pairs, DirectionOptions(max_rival_share=1.0))
    assert set(lenient.status) == {DirectionStatus.USABLE}
    assert all(60 < rivals <= 80 for rivals in lenient.num_rivals)


def test_identical_rays_empty_lists_and_random_matches_give_no_direction():
    rays = make_pair(6)[0]
    found = estimate([(rays, rays), (rays[:0], rays[:0]), (rays[:4], rays[:4])])
    few = DirectionStatus.TOO_FEW_MATCHES
    assert found.status == [DirectionStatus.NO_PARALLAX, few, few]
    assert np.isnan(found.directions).all()
    pairs = []
    for seed in range(20):
        rays_i, rays_j, _ = make_pair(seed, count=60)
        pairs.append((rays_i, np.random.default_rng(seed).permutation(rays_j)))
    assert set(estimate(pairs).status) == {DirectionStatus.LOW_INLIER_RATIO}


def test_planar_scenes_and_five_pixels_of_parallax_are_no_obstacle():
    pair = make_pair(7, noise_px=0.5, depth=(6.0, 6.0), count=200)
    found = estimate([pair])
    assert found.status == [DirectionStatus.USABLE]
    assert angle_between_deg(found.directions[0], pair[2]) < 1.0
    pairs = [make_pair(seed, noise_px=0.5, count=100, baseline=(0.03, 0.0, 0.0)) for seed in range(100)]
    assert estimate(pairs).counts()[DirectionStatus.USABLE] >= 95


@pytest.mark.parametrize(
    "kind",
    [
        {},
        {"count": 15},
        {"noise_px": 2.0},
        {"depth": (6.0, 6.0)},
        {"baseline": (0.12, 0.03, -0.02)},
        {"baseline": (0.06, 0.01, -0.01), "count": 200},
        {"wrong": 0.4},
        {"wrong": 0.4, "baseline": (0.12, 0.03, -0.02)},
    ],
    ids=str,
)
def test_the_covariance_predicts_the_errors(kind):
    # The mean of a chi-square of 2 degrees of freedom is 2; 500 draws give it to 5 %, and the goal is 20 %.
    options = DirectionOptions(min_inlier_ratio=0.1, min_inliers=8)
    pairs = [make_pair(seed, **{"noise_px": 0.7, "count": 80, **kind}) for seed in range(500)]
    found = estimate(pairs, options)
    assert len(found.usable()) == len(pairs)
    assert 1.6 < squared_errors(found, pairs).mean() < 2.4


def test_little_parallax_does_not_pull_the_direction_towards_the_view():
    # 10 px of parallax, 0.7 px of noise: the normals' noise lies across the optical axis z, and plain least
    # squares turns the direction towards it by several degrees. The mean of 200 errors of 1.2 degrees is 0.
    pairs = [make_pair(seed, noise_px=0.7, count=80, baseline=(0.06, 0.0, 0.02)) for seed in range(200)]
    along_view_deg = np.degrees(np.arcsin(estimate(pairs).directions[:, 2]) - np.arcsin(pairs[0][2][2]))
    assert abs(along_view_deg.mean()) < 4.0 * along_view_deg.std() / np.sqrt(len(pairs))


def make_facade(seed, shifted):
    """A wall 8 away whose pattern repeats every unit; a share of the matches joins the next period."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-4, 4, 150), rng.uniform(-2, 2, 150), np.full(150, 8.0)])
    direction = normalized(np.array([1.0, rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6)]))
    matched = points + (rng.random(150) < shifted)[:, None] * [1.0, 0.0, 0.0]
    return see(points, 0.5, rng), see(matched + 1.5 * direction, 0.5, rng), direction


@pytest.mark.parametrize("shifted", [0.2, 0.5, 0.6])
def test_a_repeated_facade_that_half_the_matches_confuse_is_refused_and_a_few_do_no_harm(shifted):
    pairs = [make_facade(seed, shifted) for seed in range(60)]
    found = estimate(pairs)
    if shifted < 0.5:
        assert set(found.status) == {DirectionStatus.USABLE}
        assert errors_deg(found, pairs).max() < 3.0
        return
    lenient = estimate(pairs, DirectionOptions(max_rival_share=100.0, min_inlier_ratio=0.1))
    # Two baselines whose epipolar lines nearly coincide (a sixth of these) share their inliers and stay.
    assert np.mean(errors_deg(found, pairs) > 3.0) < 0.25
    assert np.mean(errors_deg(lenient, pairs) > 3.0) > 0.3


@pytest.mark.parametrize(
    "kind",
    [{}, {"noise_px": 2.0}, {"wrong": 0.3}, {"depth": (4e4, 8e4)}, {"depth": (4e5, 8e5), "count": 100}],
    ids=str,
)
def test_no_parallax_is_recognized_whatever_the_noise(kind):
    baseline = (1.0, 0.2, -0.1) if "depth" in kind else (0.0, 0.0, 0.0)
    usual = {"noise_px": 0.5, "count": 300, "baseline": baseline}
    pairs = [make_pair(seed, **(usual | kind)) for seed in range(40)]
    options = DirectionOptions(min_inlier_ratio=0.1)
    assert set(estimate(pairs, options).status) == {DirectionStatus.NO_PARALLAX}


@pytest.mark.parametrize(("near", "baseline", "error_deg"), [(50, 0.3, 0.3), (20, 0.12, 1.5)])
def test_few_near_points_among_many_far_ones_give_the_direction_and_its_covariance(near, baseline, error_deg):
    pairs = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        count = 450 + near
        image = np.column_stack([rng.uniform(-0.45, 0.45, (count, 2)), np.ones(count)])
        points = image * np.where(np.arange(count) < 450, 1e5, rng.uniform(4, 8, count))[:, None]
        direction = normalized(rng.standard_normal(3) * [1.0, 0.6, 0.6])
        pairs.append((see(points, 0.5, rng), see(points + baseline * direction, 0.5, rng), direction))
    found = estimate(pairs)
    usable = found.usable()
    assert len(usable) >= 0.95 * len(pairs)
    # 2 within 20 %, and 200 draws give the mean to 7 %.
    assert 1.5 < squared_errors(found, pairs).mean() < 2.5
    # A standard deviation of 0.2 and 1.1 degrees (parallax 50 and 20 px), whatever noise the far ones add.
    assert np.median(errors_deg(found, pairs)[usable]) < error_deg


def test_support_says_what_the_pair_has_and_neither_batches_nor_threads_change_a_bit():
    found = estimate([make_pair(8, count=100, noise_px=0.5, wrong=0.3)])
    assert found.num_matches[0] == 100
    assert 60 <= found.num_inliers[0] <= 80  # 70 are right; a few wrong ones fall on their epipolar line
    # A Sampson error of 0.5 px noise has median 0.6745 * 0.5 px, and 70 of them give it to 15 %.
    assert found.median_residual_px[0] == pytest.approx(0.6745 * 0.5, rel=0.45)
    assert 5.0 < found.parallax_deg[0] < 15.0  # baseline 1.02 seen from 4 to 8
    pairs = [make_pair(seed, noise_px=0.5, wrong=0.2) for seed in range(7)]
    whole, threaded = estimate(pairs), estimate(pairs, threads=2)
    for other in (threaded, concatenate([estimate([pair]) for pair in pairs])):
        for name in ("directions", "covariance", "num_inliers", "median_residual_px", "parallax_deg"):
            np.testing.assert_array_equal(getattr(whole, name), getattr(other, name))
        assert whole.status == other.status


def test_each_rule_can_be_the_reason():
    pair = make_pair(9, count=40, noise_px=0.5, wrong=0.3)
    strict = {
        "min_inliers": (39, DirectionStatus.FEW_INLIERS),
        "min_inlier_ratio": (0.99, DirectionStatus.LOW_INLIER_RATIO),
        "max_sigma_deg": (1e-3, DirectionStatus.NO_PARALLAX),
        "inlier_threshold_px": (1e-3, DirectionStatus.LOW_INLIER_RATIO),
    }
    assert estimate([pair]).status == [DirectionStatus.USABLE]
    for name, (value, reason) in strict.items():
        assert estimate([pair], DirectionOptions(**{name: value})).status == [reason], name
    # A scene as far behind the cameras as before them fits either sign.
    rays_i, rays_j, _ = make_pair(10, count=60)
    flipped = np.where(np.arange(60) % 2, 1.0, -1.0)[:, None]
    assert estimate([(rays_i * flipped, rays_j * flipped)]).status == [DirectionStatus.AMBIGUOUS_SIGN]


def directions_with(sigmas_deg, ratios, directions=None, edges=None) -> PairDirections:
    """Usable directions of given uncertainty and inlier ratio, out of 1000 matches each."""
    k = len(sigmas_deg)
    unknown = np.full(k, np.nan)
    return PairDirections(
        pairs=np.array([(i, i + 1) for i in range(k)]) if edges is None else edges,
        directions=np.tile([1.0, 0.0, 0.0], (k, 1)) if directions is None else directions,
        status=[DirectionStatus.USABLE] * k,
        num_matches=np.full(k, 1000),
        num_inliers=np.rint(1000 * np.asarray(ratios)).astype(int),
        num_rivals=np.zeros(k, dtype=int),
        cheirality_fraction=unknown,
        median_residual_px=unknown,
        parallax_deg=unknown,
        covariance=np.radians(sigmas_deg)[:, None, None] ** 2 * np.diag([1.0, 0.25]),
    )


def test_weights_fall_with_uncertainty_and_contradicting_matches_and_without_a_direction_there_is_none():
    weights = directions_with([0.0, 0.0, 0.0, 0.15, 90.0], [1.0, 1.0, 0.5, 1.0, 1.0]).weights()
    # Relative to the median, 1 / sqrt(1 + 3^2) = 0.316: 1, 1, 1/4, 0.316, and 5e-4 raised to the floor.
    expected = [np.sqrt(10.0), np.sqrt(10.0), np.sqrt(10.0) / 4.0, 1.0, 0.02]
    np.testing.assert_allclose(weights, expected, rtol=1e-12)
    found = directions_with([0.0, 0.0, 0.1], [1.0, 1.0, 1.0])
    found = replace(found, status=[*found.status[:2], DirectionStatus.FEW_INLIERS])
    np.testing.assert_array_equal(found.weights(), [1.0, 1.0, np.nan])
    assert np.isnan(replace(found, status=[DirectionStatus.NO_PARALLAX] * 3).weights()).all()


def test_weights_make_the_locations_of_uneven_pairs_better():
    ratios = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        truth = rng.standard_normal((20, 3))
        edges = np.array(all_pairs(20))
        sigmas_deg = np.where(rng.random(len(edges)) < 0.3, 0.03, 1.5)
        noise = np.radians(sigmas_deg)[:, None] * rng.standard_normal((len(edges), 3))
        directions = normalized(normalized(truth[edges[:, 0]] - truth[edges[:, 1]]) + noise)
        weights = directions_with(sigmas_deg, np.ones(len(edges)), directions, edges).weights()
        errors = []
        for used in (weights, None):
            found = solve(ViewGraph(20, edges, directions, used)).locations
            aligned = fit_similarity(found, truth).apply(found)
            errors.append(np.linalg.norm(aligned - truth, axis=1).mean())
        ratios.append(errors[0] / errors[1])
    assert np.median(ratios) < 0.7


def test_more_hypotheses_survive_more_wrong_matches():
    options = DirectionOptions(min_inlier_ratio=0.1, min_sign_majority=1.0)
    pairs = [make_pair(seed, count=150, noise_px=0.3, wrong=0.75) for seed in range(20)]

    def failures(num_hypotheses):
        found = estimate(pairs, replace(options, num_hypotheses=num_hypotheses))
        return np.sum(~(errors_deg(found, pairs) < 5.0))

    assert failures(400) < failures(5)
