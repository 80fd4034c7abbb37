"""What is said of intrinsics in doubt: each camera of few, of many what they have in common."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_shapefit.adjustment.estimate import BundleAdjustment, Estimate
from sfm_shapefit.adjustment.freedom import Freedom
from sfm_shapefit.facts.intrinsics import (
    CameraIntrinsics,
    describe_intrinsics,
    intrinsics_in_doubt,
    intrinsics_warnings,
)
from sfm_shapefit.scene.lens import Lens, Origin

HEAD = "camera 1 (1.jpg and 3 more): focal length 1,000.0 px (a guess)"


def row(camera=1, decided_by="adjusted", given=1000.0, found=1100.0, sigma=5.0, num_images=4):
    """A row of locate.json."""
    return CameraIntrinsics(
        camera=camera,
        image=f"{camera}.jpg",
        num_images=num_images,
        model="SIMPLE_RADIAL",
        origin=Origin.GUESS.value,
        decided_by=decided_by,
        given_focal_px=given,
        focal_px=found,
        focal_sigma_px=sigma,
        given_parameters=[given, 600.0, 450.0, 0.0],
        parameters=[found, 600.0, 450.0, -0.05 if decided_by == "adjusted" else 0.0],
    )


@pytest.mark.parametrize(
    ("one", "sentence"),
    [
        (
            row(),
            f"{HEAD} became 1,100.0 ± 5.0 px (+10.0%) by adjustment, distortion -0.0500",
        ),
        (
            row(decided_by="view graph", sigma=None),
            f"{HEAD} became 1,100.0 px (+10.0%) by the view graph",
        ),
        (
            row(decided_by="undetermined", found=1000.0, sigma=None),
            f"{HEAD} kept, as the matches do not determine it",
        ),
        (
            replace(
                row(decided_by="undetermined", found=1000.0, sigma=None),
                parameters=[1000.0, 600.0, 450.0, -0.05],
            ),
            f"{HEAD} kept, as the matches do not determine it, distortion -0.0500",
        ),
        (
            row(decided_by="held", found=1000.0),
            f"{HEAD} kept",
        ),
    ],
)
def test_each_of_few_cameras_is_told(one, sentence):
    assert describe_intrinsics([one]) == [sentence]
    more = row(camera=2, num_images=9)
    assert [line[:8] for line in describe_intrinsics([one, more])] == ["camera 2", "camera 1"]


def test_many_cameras_are_told_in_one_sentence():
    rows = [row(k, found=1000.0 + 100.0 * k) for k in range(1, 4)]
    rows += [row(9, "undetermined", found=1000.0), row(10, "held", found=1000.0)]
    (line,) = describe_intrinsics(rows)
    assert line == (
        "the focal lengths of 3 of 5 cameras in doubt changed by +10.0% to +30.0% (median +20.0%), most "
        "that of camera 3 (3.jpg and 3 more); 1 kept the given one, as the matches do not determine it; 1 "
        "were not to be changed; locate.json has each"
    )


def estimate_of(freedom, sigmas, undetermined):
    """An adjustment's answer, as far as lenses go."""
    return Estimate(
        images=None,
        freedom=freedom,
        focal_sigmas=np.array(sigmas),
        undetermined=np.array(undetermined),
        sensor_sigmas=np.full((len(sigmas), 2), np.nan),
        solves=BundleAdjustment(converged=True, iterations=9, initial_error_px=2.0, final_error_px=1.0),
    )


def test_what_adjustments_leave_open_is_held_from_then_on_and_warned_of():
    lens = Lens("SIMPLE_RADIAL", (1000.0, 600.0, 450.0, 0.0))
    every, nan = np.ones((3, 2), bool), np.nan
    known = intrinsics_in_doubt(every, np.array([True, False, False]))
    assert known.parts.any()
    assert [known.how(k) for k in (0, 1)] == ["view graph", "held"]
    free = Freedom(parts=every)
    after = known.after(estimate_of(free, [0.02, 0.1, nan], [False, False, False]), np.arange(3))
    held = free.holding(np.array([False, True, True]), [lens] * 3)
    after = after.after(estimate_of(held, [0.01, nan, nan], [False, True, True]), np.arange(3))
    # The second adjustment is one of the first and the last lens alone.
    part = held.of(np.arange(0), np.array([0, 2])).holding(np.array([False, True]), [lens] * 2)
    after = after.after(estimate_of(part, [0.005, nan], [False, True]), np.array([0, 2]))
    assert after.parts.tolist() == [[True, True], [False, True], [False, False]]
    assert after.undetermined.tolist() == [False, True, True]
    assert [after.how(k) for k in range(3)] == ["adjusted", "undetermined", "undetermined"]
    np.testing.assert_array_equal(after.focal_sigmas, [0.005, nan, nan])
    assert [after.part(np.array([2, 0])).how(k) for k in range(2)] == ["undetermined", "adjusted"]
    rows = [row(1), row(2, "undetermined"), replace(row(3, "undetermined"), origin="given")]
    (warning,) = intrinsics_warnings(rows)  # what was calibrated needs none
    assert warning.startswith(
        "camera 2 (2.jpg and 3 more) kept a focal length that was never measured, which the matches do not"
    )


def test_cameras_whose_focal_length_is_hardly_known_are_named():
    rows = [row(1, sigma=10.0), row(2, sigma=12.0), row(3, sigma=None), row(4, "view graph", sigma=None)]
    (warning,) = intrinsics_warnings(rows)
    assert warning.startswith(
        "the matches hardly determine the focal length of camera 2 (2.jpg and 3 more), camera 3 (3.jpg and 3 "
        "more) (± 1% or more), so"
    )
    assert list(intrinsics_warnings([*rows[:1], replace(rows[1], origin="given")])) == []
