"""Vectors, similarity alignment and mean rotations: properties that hold for every input."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_shapefit.base.geometry import (
    Similarity,
    angle_between_deg,
    compose,
    fit_similarity,
    fit_similarity_l1,
    invert,
    mean_rotation_l1,
    median_spread,
    normalized,
    rotation_angles_deg,
    tangent_bases,
)
from tests.problems import random_rotations, turn

EPS = np.finfo(np.float64).eps
seeds = st.integers(0, 2**32 - 1)


def random_rotation(rng: np.random.Generator, d: int = 3) -> np.ndarray:
    return random_rotations(rng, 1, d)[0]


def random_similarity(rng: np.random.Generator, d: int = 3) -> Similarity:
    return Similarity(
        scale=float(np.exp(rng.normal())), rotation=random_rotation(rng, d), translation=rng.normal(size=d)
    )


def assert_same_map(found: Similarity, expected: Similarity, rtol: float) -> None:
    assert found.scale == pytest.approx(expected.scale, rel=rtol)
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=rtol)
    size = 1.0 + np.abs(expected.translation).max() + expected.scale
    np.testing.assert_allclose(found.translation, expected.translation, atol=rtol * size)


def nearby(fit: Similarity, rng: np.random.Generator, size: float) -> Similarity:
    """A similarity that differs by a share of the scale, as much of a shift, and 50 times as many degrees."""
    return Similarity(
        scale=fit.scale * (1 + size * rng.normal()),
        rotation=turn(rng.normal(size=3), 50 * size * rng.normal()) @ fit.rotation,
        translation=fit.translation + size * rng.normal(size=3),
    )


def test_normalized_vectors_have_unit_length_and_keep_their_direction_and_zero_gives_nan():
    v = np.array([[3.0, 0.0, 4.0], [-1e-150, 0.0, 0.0], [0.0, 1e150, 0.0]])
    np.testing.assert_allclose(normalized(v), [[0.6, 0, 0.8], [-1, 0, 0], [0, 1, 0]], atol=2 * EPS)
    assert np.isnan(normalized(np.zeros((2, 3)))).all()


@pytest.mark.parametrize(
    "angle", [0.0, 1e-12, 1e-6, 0.1, 45.0, 90.0, 179.9, 180.0 - 1e-6, 180.0 - 1e-12, 180.0]
)
def test_angles_are_exact_at_0_and_at_180_degrees_too(angle):
    rad = np.radians(angle)
    # Near 180 degrees the second vector is written from its distance to the antipode: cos and sin of the
    # rounded angle near pi would themselves lose the digits that are tested.
    b = [np.cos(rad), np.sin(rad), 0.0] if angle < 90 else [-np.cos(np.pi - rad), np.sin(np.pi - rad), 0.0]
    found = angle_between_deg(np.array([[1.0, 0.0, 0.0]]), np.array([b]))[0]
    # A few roundings of the unit vectors are 180/pi * EPS degrees each; arccos would be off by 1e-6.
    assert found == pytest.approx(angle, abs=4 * np.degrees(EPS))


def test_angles_broadcast_over_leading_axes():
    axes = np.eye(3)
    found = angle_between_deg(axes[:, None], axes[None])
    np.testing.assert_allclose(found, 90.0 * (1 - np.eye(3)), atol=1e-13)


@given(seed=seeds, d=st.integers(2, 10))
def test_a_tangent_basis_completes_its_direction_to_an_orthonormal_frame(seed, d):
    rng = np.random.default_rng(seed)
    v = normalized(np.vstack([rng.normal(size=(5, d)), 1e-9 * rng.normal(size=(4, d)) + np.eye(d)[0]]))
    v = np.vstack([v, -v[5:], np.eye(d), -np.eye(d)])
    frame = np.concatenate([v[:, :, None], tangent_bases(v)], axis=2)
    product = np.swapaxes(frame, 1, 2) @ frame
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(d), product.shape), atol=8 * EPS)


@given(seed=seeds, d=st.integers(2, 5), n=st.integers(6, 12))
def test_an_exact_similarity_is_found_in_any_dimension(seed, d, n):
    rng = np.random.default_rng(seed)
    true = random_similarity(rng, d)
    source = rng.normal(size=(n, d))
    # 6 points in 5 dimensions may be poorly spread: the rotation loses the condition number's digits.
    spread = np.linalg.svd(source - source.mean(axis=0), compute_uv=False)
    rtol = 100 * EPS * (spread[0] / spread[-2]) ** 2
    assert_same_map(fit_similarity(source, true.apply(source)), true, rtol=rtol)


def test_coplanar_and_mirrored_points_determine_a_rotation_and_never_a_reflection():
    rng = np.random.default_rng(5)
    source = rng.normal(size=(9, 3)) * [1.0, 1.0, 0.0]
    true = random_similarity(rng)
    assert_same_map(fit_similarity(source, true.apply(source)), true, rtol=1e-13)
    source = rng.normal(size=(20, 3))
    fit = fit_similarity(source, source * [1.0, 1.0, -1.0])
    assert np.linalg.det(fit.rotation) == pytest.approx(1.0)
    assert fit.scale > 0.0


@given(seed=seeds)
@settings(max_examples=30)
def test_no_nearby_similarity_has_a_smaller_weighted_sum_of_squares(seed):
    rng = np.random.default_rng(seed)
    source, target, weights = rng.normal(size=(8, 3)), rng.normal(size=(8, 3)), rng.uniform(0.1, 3, size=8)
    fit = fit_similarity(source, target, weights)

    def cost(s: Similarity) -> float:
        return float(weights @ np.sum((s.apply(source) - target) ** 2, axis=1))

    for _ in range(20):
        assert cost(nearby(fit, rng, 1e-3)) >= cost(fit)


def test_a_weight_of_zero_leaves_a_point_out_and_a_source_turned_inside_out_gets_scale_zero():
    rng = np.random.default_rng(7)
    true = random_similarity(rng)
    source = rng.normal(size=(6, 3))
    target = true.apply(source)
    target[2] += 100.0
    assert_same_map(fit_similarity(source, target, np.array([1.0, 1, 0, 1, 1, 1])), true, rtol=1e-13)
    fit = fit_similarity(source, -source, rotate=False)
    assert fit.scale == 0.0
    np.testing.assert_allclose(fit.translation, -source.mean(axis=0), atol=1e-15)


@pytest.mark.parametrize("fit", [fit_similarity, fit_similarity_l1])
def test_without_rotation_the_axes_are_kept_exactly(fit):
    rng = np.random.default_rng(8)
    source = rng.normal(size=(7, 3))
    found = fit(source, 2.5 * source + [1.0, 2.0, 3.0], rotate=False)
    np.testing.assert_array_equal(found.rotation, np.eye(3))
    assert_same_map(
        found, Similarity(scale=2.5, rotation=np.eye(3), translation=np.array([1.0, 2, 3])), rtol=1e-13
    )


@pytest.mark.parametrize("fit", [fit_similarity, fit_similarity_l1])
@pytest.mark.parametrize("n", [1, 2, 5])
def test_coincident_points_are_mapped_onto_each_other_with_scale_one(fit, n):
    found = fit(np.full((n, 3), 2.0), np.full((n, 3), -7.0))
    assert found.scale == 1.0
    np.testing.assert_allclose(found.apply(np.full((1, 3), 2.0)), -7.0, atol=1e-14)


@given(seed=seeds, n=st.integers(3, 30))
@settings(max_examples=20)
def test_an_exact_similarity_is_found_by_l1_too(seed, n):
    rng = np.random.default_rng(seed)
    true = random_similarity(rng)
    source = rng.normal(size=(n, 3))
    target = true.apply(source)
    np.testing.assert_allclose(
        fit_similarity_l1(source, target).apply(source), target, atol=1e-13 * (1 + np.abs(target).max())
    )


def test_a_fifth_of_bad_targets_leaves_the_l1_fit_exact():
    rng = np.random.default_rng(11)
    true = random_similarity(rng)
    source = rng.normal(size=(30, 3))
    target = true.apply(source)
    target[:6] += rng.normal(size=(6, 3)) * 10
    # The floor of the weights, 1e-9 of the spread, is the bias that bad points may leave.
    assert_same_map(fit_similarity_l1(source, target), true, rtol=1e-8)
    assert abs(fit_similarity(source, target).scale / true.scale - 1) > 0.05  # least squares is not


@pytest.mark.parametrize("cap", [np.inf, 0.3])
def test_no_nearby_similarity_has_a_smaller_sum_of_distances(cap):
    rng = np.random.default_rng(12)
    source = rng.normal(size=(15, 3))
    target = source + 0.1 * rng.standard_t(2, size=(15, 3))
    target[:4] += 1.0
    fit = fit_similarity_l1(source, target, cap=cap)

    def cost(s: Similarity) -> float:
        return float(np.minimum(np.linalg.norm(s.apply(source) - target, axis=1), cap).sum())

    for size in (1e-2, 1e-4):
        for _ in range(100):
            assert cost(nearby(fit, rng, size)) >= cost(fit) * (1 - 1e-9)


def test_without_a_cap_one_point_far_away_shrinks_everything_and_one_that_nothing_reaches_changes_nothing():
    """The documented weakness that the cap is for: if this fails, the docstring is wrong."""
    rng = np.random.default_rng(13)
    target = rng.normal(size=(20, 3))
    source = target.copy()
    source[0] += 1e4
    assert fit_similarity_l1(source, target).scale < 0.01
    assert fit_similarity_l1(source, target, cap=1.0).scale == pytest.approx(1.0, rel=1e-12)
    source = target + 0.01 * rng.normal(size=(20, 3))
    plain, capped = fit_similarity_l1(source, target), fit_similarity_l1(source, target, cap=5.0)
    assert plain.scale == capped.scale
    np.testing.assert_array_equal(plain.translation, capped.translation)


def test_targets_of_which_most_coincide_do_not_break_the_weights():
    rng = np.random.default_rng(15)
    target = np.zeros((9, 3))
    target[:3] = rng.normal(size=(3, 3))
    fit = fit_similarity_l1(rng.normal(size=(9, 3)), target)
    assert np.isfinite(fit.scale)
    assert np.isfinite(fit.apply(target)).all()


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ([[-1.0, 0], [0, 0], [1, 0], [100, 0], [-1, 0]], 1.0),
        ([[0.0, 0], [0, 0], [0, 0], [3, 4]], 5.0),
        ([[2.0, 2], [2, 2]], 0.0),
        ([[-1.0, 0], [0, 0], [1, 0], [1e13, 0], [-1, 0]], 1.0),
        ([[0.0, 0], [1e-9, 0], [0, 1e-9], [1e6, 0]], 1e6),
    ],
)
def test_the_median_spread_ignores_far_points_unless_the_rest_coincides(points, expected):
    assert median_spread(np.array(points)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-10, 1e-3, 30.0, 90.0, 179.999, 180.0])
def test_rotation_angles_are_exact_at_0_and_at_180_degrees_too(angle):
    axis = np.array([1.0, -2.0, 0.5])
    found = rotation_angles_deg(turn(axis, angle)[None])[0]
    assert found == pytest.approx(angle, abs=8 * np.degrees(EPS))  # entries of R carry a few roundings


@given(seed=seeds, n=st.integers(3, 40))
@settings(max_examples=40)
def test_a_majority_of_equal_rotations_is_the_mean_whatever_the_others_are(seed, n):
    rng = np.random.default_rng(seed)
    true = random_rotation(rng)
    bad = (n - 1) // 2
    others = random_rotations(rng, bad)
    if seed % 2:
        others[:] = others[:1]  # all wrong in the same way
    rotations = np.concatenate([others, np.repeat(true[None], n - bad, axis=0)])[rng.permutation(n)]
    # Weights are at most 1e9 times those of a rotation that is off by 1.
    np.testing.assert_allclose(mean_rotation_l1(rotations), true, atol=1e-6)


def test_the_mean_of_small_turns_about_one_axis_is_their_median():
    axis = np.array([0.3, -1.0, 2.0])
    rotations = np.array([turn(axis, a) for a in (-1.0, 0.1, 0.2, 3.0, 5.0)])
    # Chords of small angles are the angles to 4e-4, and the median does not depend on their lengths.
    np.testing.assert_allclose(mean_rotation_l1(rotations), turn(axis, 0.2), atol=1e-6)


def test_the_mean_rotation_turns_with_its_inputs_and_that_of_one_is_itself():
    rng = np.random.default_rng(17)
    rotations = np.array([turn(rng.normal(size=3), rng.normal()) for _ in range(11)])
    left, right = random_rotation(rng), random_rotation(rng)
    turned = left @ mean_rotation_l1(rotations) @ right
    np.testing.assert_allclose(mean_rotation_l1(left @ rotations @ right), turned, atol=1e-6)
    np.testing.assert_allclose(mean_rotation_l1(left[None]), left, atol=4 * EPS)


@settings(max_examples=50)
@given(seed=seeds, d=st.integers(2, 5))
def test_similarities_compose_like_maps_and_their_inverses_undo_them(seed, d):
    rng = np.random.default_rng(seed)
    first, second, third = (random_similarity(rng, d) for _ in range(3))
    points = rng.standard_normal((7, d))
    both = compose(second, first)
    np.testing.assert_allclose(both.apply(points), second.apply(first.apply(points)), rtol=1e-9, atol=1e-9)
    one, other = compose(third, both), compose(compose(third, second), first)
    assert_same_map(one, other, rtol=1e-9)
    np.testing.assert_allclose(compose(invert(first), first).apply(points), points, atol=1e-9)
    assert_same_map(invert(invert(first)), first, rtol=1e-9)
