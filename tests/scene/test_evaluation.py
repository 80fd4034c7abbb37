"""Errors against a reference: what the alignment absorbs, what it must not, and what is refused."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import fit_similarity
from sfm_shapefit.scene.evaluation import RELATIVE_THRESHOLDS, evaluate_poses, evaluate_positions
from tests.problems import random_rotations, turn


@dataclass(frozen=True)
class Poses:
    names: tuple[str, ...]
    rotations: np.ndarray
    centers: np.ndarray

    def moved(self, scale: float, rotation: np.ndarray, shift: np.ndarray) -> "Poses":
        """The same cameras in a world w' = scale * rotation w + shift."""
        return Poses(self.names, self.rotations @ rotation.T, scale * self.centers @ rotation.T + shift)

    def taken(self, indices) -> "Poses":
        return Poses(tuple(self.names[k] for k in indices), self.rotations[indices], self.centers[indices])


def scene(seed: int, n: int = 20) -> Poses:
    rng = np.random.default_rng(seed)
    names = tuple(f"img{k:03d}.jpg" for k in range(n))
    return Poses(names, random_rotations(rng, n), 10.0 * rng.normal(size=(n, 3)) + [100.0, 0.0, -50.0])


def in_another_world(poses: Poses, seed: int) -> Poses:
    rng = np.random.default_rng(seed)
    return poses.moved(float(np.exp(rng.normal())), random_rotations(rng, 1)[0], rng.normal(size=3))


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(3, 25))
@settings(max_examples=25)
def test_the_same_cameras_in_another_world_have_no_error(seed, n):
    reference = scene(seed, n)
    found = evaluate_poses(in_another_world(reference, seed + 1), reference)
    # Coordinates of about 130 and their products carry some roundings of 3e-14 each.
    assert found.position.max < 1e-10
    assert found.rotation_deg.max < 1e-11
    assert all(r.recall == 1.0 for r in found.recalls)
    assert len(found.warnings) == (n < 5)
    np.testing.assert_allclose(found.aligned_centers, reference.centers, atol=1e-10)
    np.testing.assert_allclose(found.rotation_ref_from_model, found.ref_from_model.rotation, atol=1e-10)


@pytest.mark.parametrize("n", [3, 4])
def test_few_cameras_are_aligned_by_least_squares_and_it_is_said_what_that_takes_up(n):
    reference = scene(6, n)
    rng = np.random.default_rng(7)
    moved = replace(reference, centers=reference.centers + 0.1 * rng.normal(size=(n, 3)))
    found = evaluate_poses(moved, reference)
    best = fit_similarity(moved.centers, reference.centers).apply(moved.centers) - reference.centers
    np.testing.assert_allclose(found.position_errors, np.linalg.norm(best, axis=1), atol=1e-12)
    assert found.position.median > 0.01  # none is 0, as none is fitted exactly
    assert f"takes up 7 of their {3 * n} coordinates" in found.warnings[0]
    positions = evaluate_positions(
        (moved.names, moved.centers), (reference.names, reference.centers), "this", as_they_stand=False
    )
    assert positions.statement.startswith(f"this; the alignment of {n} cameras")
    with pytest.raises(InputError, match="leaves two without errors"):
        evaluate_poses(moved, scene(6, 2))


def test_one_moved_camera_has_exactly_its_own_error_in_the_references_units_and_its_row():
    reference = scene(1)
    moved = reference.centers.copy()
    moved[4] += [0.0, 3.0, 4.0]
    found = evaluate_poses(in_another_world(replace(reference, centers=moved), 2), reference)
    # One of 20 pulls with weight 1 against 19 of weight up to 1e9: bias 1e-9 of the spread, 10.
    assert found.position_errors[4] == pytest.approx(5.0, abs=1e-6)
    assert np.delete(found.position_errors, 4).max() < 1e-6
    assert found.position.max == found.position_errors.max()
    assert found.position.mean == pytest.approx(5.0 / 20, abs=1e-6)
    assert found.position.rms == pytest.approx(5.0 / np.sqrt(20), abs=1e-6)
    assert found.position.median < 1e-6
    rows = found.rows()
    assert [row["name"] for row in rows] == list(reference.names)
    assert list(rows[4]) == ["name", "position_error", "rotation_error_deg", "x", "y", "z"]
    assert rows[4]["position_error"] == found.position_errors[4]
    np.testing.assert_allclose([rows[4][axis] for axis in "xyz"], moved[4], atol=1e-6)
    assert all(type(value) in (str, float) for row in rows for value in row.values())


def test_one_turned_camera_has_exactly_its_own_rotation_error_and_no_position_error():
    reference = scene(2)
    turned = reference.rotations.copy()
    turned[7] = turn(np.array([1.0, 2.0, 3.0]), 12.5) @ turned[7]
    found = evaluate_poses(in_another_world(replace(reference, rotations=turned), 3), reference)
    assert found.rotation_errors_deg[7] == pytest.approx(12.5, abs=1e-6)
    assert np.delete(found.rotation_errors_deg, 7).max() < 1e-6
    assert found.position.max < 1e-10


def test_rotations_are_compared_independently_of_the_centers():
    """All rotations turned in the world by 30 degrees: no error, though the centers were not turned."""
    reference = scene(3)
    world_turn = turn(np.array([0.0, 1.0, 1.0]), 30.0)
    found = evaluate_poses(replace(reference, rotations=reference.rotations @ world_turn), reference)
    assert found.rotation_deg.max < 1e-11
    # R_ref = R_model Q^T with R_model = R_ref W gives Q = W.
    np.testing.assert_allclose(found.rotation_ref_from_model, world_turn, atol=1e-13)
    np.testing.assert_allclose(found.ref_from_model.rotation, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("kind", ["flown", "flown far", "at the origin", "shifted together", "second piece"])
@pytest.mark.parametrize("n", [7, 12, 41])
def test_half_minus_one_wrong_cameras_do_not_disturb_the_others(kind, n):
    for seed in range(3):
        rng = np.random.default_rng(100 * n + seed)
        reference = scene(100 * n + seed, n)
        bad = rng.permutation(n)[: (n - 1) // 2]
        wrong = random_rotations(rng, 1)[0]
        rotations, centers = reference.rotations.copy(), reference.centers.copy()
        rotations[bad] = rotations[bad] @ wrong
        centers[bad] = {
            "flown": centers[bad] + 100.0 * rng.normal(size=(len(bad), 3)),
            "flown far": centers[bad] + 1e6 * rng.normal(size=(len(bad), 3)),
            "at the origin": np.zeros((len(bad), 3)),
            "shifted together": centers[bad] + 50.0 * np.array([1.0, 0.3, 0.2]),
            "second piece": 0.5 * centers[bad] @ wrong,
        }[kind]
        found = evaluate_poses(in_another_world(Poses(reference.names, rotations, centers), 5), reference)
        good = np.setdiff1d(np.arange(n), bad)
        # The far cameras are 1e5 extents away: rounding there is 1e-9 of the others' coordinates.
        assert found.position_errors[good].max() < 1e-6
        assert found.position_errors[bad].min() > 0.1
        assert found.rotation_errors_deg[good].max() < 1e-5
        assert found.rotation_errors_deg[bad].min() > 1.0


def test_noise_comes_out_at_its_size():
    rng = np.random.default_rng(4)
    reference = scene(4, 200)
    noisy = replace(reference, centers=reference.centers + 0.01 * rng.normal(size=(200, 3)))
    found = evaluate_poses(in_another_world(noisy, 6), reference)
    # 0.01 * sqrt(3) rms, less the 7 of 600 degrees of freedom; its own spread is 1 / sqrt(1200) = 3 %.
    assert found.position.rms == pytest.approx(0.01 * np.sqrt(3), rel=0.12)


def test_cameras_are_matched_by_name_whatever_their_order_and_rotations_of_six_digits_are_accepted():
    reference = scene(5)
    order = np.random.default_rng(5).permutation(20)
    found = evaluate_poses(reference.taken(order), reference)
    assert found.names == reference.names
    assert found.position.max < 1e-10
    assert found.rotation_deg.max < 1e-11
    printed = replace(reference, rotations=np.round(reference.rotations, 6))
    # Each entry is off by up to 5e-7, together by at most sqrt(9 / 2) * 5e-7 rad = 6e-5 degrees.
    assert evaluate_poses(printed, reference).rotation_deg.max < 1.3e-4


def test_recall_is_given_at_fractions_of_the_extent_and_at_the_thresholds_asked_for():
    # A box of diagonal 100 whose corners are all exact, and 4 cameras off by 0.2, 0.5, 2 and 5 along x.
    corners = np.array([[x, y, z] for x in (0, 48.0) for y in (0, 60.0) for z in (0, 64.0)])
    inner = np.array([[10.0, 20, 30], [20, 20, 20], [30, 40, 10], [15, 30, 40]])
    centers = np.concatenate([corners, inner])
    names = tuple(str(k) for k in range(12))
    reference = Poses(names, np.repeat(np.eye(3)[None], 12, axis=0), centers)
    moved = centers.copy()
    moved[8:, 0] += [0.2, 0.5, 2.0, 5.0]
    found = evaluate_poses(replace(reference, centers=moved), reference, thresholds=[0.3, 4])
    assert found.extent == pytest.approx(np.sqrt(48.0**2 + 60**2 + 64**2))
    assert found.extent == pytest.approx(100.0)
    assert [r.fraction_of_extent for r in found.recalls] == [*RELATIVE_THRESHOLDS, None, None]
    assert [r.threshold for r in found.recalls] == pytest.approx([0.1, 0.3, 1, 3, 10, 0.3, 4])
    assert [r.recall * 12 for r in found.recalls] == pytest.approx([8, 9, 10, 11, 12, 9, 11])


def test_missing_cameras_count_as_failures_and_in_the_extent_and_extra_ones_do_not_count():
    reference = scene(6)
    reference.centers[0] = [1000.0, 0.0, 0.0]
    stranger = Poses(("zebra.jpg",), np.eye(3)[None], np.array([[1e9, 0.0, 0.0]]))
    kept = reference.taken(np.arange(5, 20))
    model = Poses(
        kept.names + stranger.names,
        np.concatenate([kept.rotations, stranger.rotations]),
        np.concatenate([kept.centers, stranger.centers]),
    )
    found = evaluate_poses(model, reference)
    assert found.missing == reference.names[:5]
    assert found.extra == ("zebra.jpg",)
    assert len(found.names) == 15
    assert [r.recall for r in found.recalls] == [0.75] * 5
    assert found.position.max < 1e-9
    assert found.extent > 800


@pytest.mark.parametrize("side", ["model", "reference", "both"])
def test_centers_on_a_line_are_flagged_and_explained(side):
    straight = scene(8)
    direction = np.array([1.0, 2.0, -1.0])
    line = replace(straight, centers=np.linspace(0, 30, 20)[:, None] * direction + 5)
    bent = replace(line, centers=line.centers + np.sin(np.arange(20))[:, None] * [0.0, 3.0, 0.0])
    model, reference = {"model": (line, bent), "reference": (bent, line), "both": (line, line)}[side]
    found = evaluate_poses(model, reference)
    assert found.degenerate
    assert len(found.warnings) == 1
    assert "line" in found.warnings[0]
    assert not evaluate_poses(bent, bent).degenerate


def test_a_line_is_recognized_although_one_lost_camera_stands_beside_it():
    straight = scene(9)
    line = replace(straight, centers=np.linspace(0, 30, 20)[:, None] * np.array([1.0, 2.0, -1.0]))
    flown, beside = line.centers.copy(), line.centers.copy()
    flown[3] += [500.0, 0.0, 300.0]
    beside[3] += [0.0, 9.0, 0.0]
    assert evaluate_poses(replace(line, centers=flown), replace(line, centers=beside)).degenerate


def test_an_alignment_that_holds_for_a_minority_only_is_warned_about():
    reference = scene(10)
    model = replace(reference, centers=np.random.default_rng(10).normal(size=(20, 3)))
    found = evaluate_poses(model, reference)
    assert any("common cameras lie within" in w for w in found.warnings)
    assert not found.degenerate


def test_two_common_cameras_are_too_few_which_is_explained_with_an_example_and_three_are_enough():
    reference = scene(11)
    model = replace(reference, names=tuple(f"other_{name}" for name in reference.names))
    sides = r"only the model has 'other_img000\.jpg'.*only the reference has 'img000\.jpg'"
    with pytest.raises(InputError, match=rf"(?s)share 0 image names.*{sides}"):
        evaluate_poses(model, reference)
    with pytest.raises(InputError, match=r"share 2 image names: only the reference has 'img002\.jpg'"):
        evaluate_poses(reference.taken(np.arange(2)), reference)
    assert evaluate_poses(reference.taken(np.arange(3)), reference).position.max < 1e-10


GOOD = scene(16)
EMPTY = Poses((), np.zeros((0, 3, 3)), np.zeros((0, 3)))


@pytest.mark.parametrize(
    ("model", "thresholds", "message"),
    [
        (EMPTY, (), r"the model \(0 cameras\)"),
        *(
            (GOOD, [bad], "a recall threshold must be a positive number")
            for bad in (0.0, -1.0, np.nan, np.inf)
        ),
    ],
)
def test_what_cannot_be_compared_is_refused(model, thresholds, message):
    with pytest.raises(InputError, match=message):
        evaluate_poses(model, GOOD, thresholds=thresholds)


@pytest.mark.parametrize("point", [0.0, 1 / 3])
def test_cameras_that_all_stand_at_one_point_are_refused(point):
    good = scene(18)
    collapsed = replace(good, centers=np.full((20, 3), point))
    with pytest.raises(InputError, match="all common cameras of the model are at one point"):
        evaluate_poses(collapsed, good)
    with pytest.raises(InputError, match="all common cameras of the reference are at one point"):
        evaluate_poses(good, collapsed)


def test_the_dictionary_survives_json():
    reference = scene(20)
    found = evaluate_poses(reference.taken(np.arange(2, 20)), reference, thresholds=[1.0])
    text = json.dumps(found.summary(), allow_nan=False)
    parsed = json.loads(text)
    counts = ["num_reference", "num_model", "num_common", "num_missing", "num_extra", "missing", "extra"]
    assert [parsed[name] for name in counts] == [20, 18, 18, 2, 0, ["img000.jpg", "img001.jpg"], []]
    assert list(parsed["position_error"]) == ["median", "mean", "rms", "max"]
    last = parsed["recall"][-1]
    assert last.pop("auc") == pytest.approx(0.9, abs=1e-9)
    assert last == {"threshold": 1.0, "fraction_of_extent": None, "recall": 0.9}


def test_neither_inputs_nor_result_are_changed_and_the_answer_is_the_same_on_every_call():
    reference = scene(23)
    noise = np.random.default_rng(23).normal(size=(20, 3))
    model = replace(reference, centers=reference.centers + noise)
    given = [model.rotations, model.centers, reference.rotations, reference.centers]
    before = [array.copy() for array in given]
    first, second = evaluate_poses(model, reference), evaluate_poses(model, reference)
    assert first.summary() == second.summary()
    for old, new in zip(before, given, strict=True):
        np.testing.assert_array_equal(old, new)
    with pytest.raises(ValueError, match="read-only"):
        first.position_errors[0] = 1.0
