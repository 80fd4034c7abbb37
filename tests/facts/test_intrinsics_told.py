"""What is said of intrinsics in doubt: each camera of few, of many what they have in common."""

from dataclasses import replace

import pytest

from sfm_shapefit.adjustment import Lens
from sfm_shapefit.adjustment.estimate import RefinedLenses
from sfm_shapefit.adjustment.free_lenses import FreeLenses
from sfm_shapefit.facts.intrinsics import (
    CameraIntrinsics,
    DoubtedIntrinsics,
    describe_intrinsics,
    intrinsics_warnings,
)
from sfm_shapefit.files.colmap.intrinsics import Origin
from sfm_shapefit.scene.lens import LensDoubt


def row(camera=1, decided_by="adjusted", given=1000.0, found=1100.0, sigma=5.0, num_images=4):
    """A row of locate.json."""
    return CameraIntrinsics(
        camera=camera,
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
            "camera 1: focal length 1,000.0 px (a guess) became 1,100.0 +- 5.0 px (+10.0%) by adjustment, "
            "distortion -0.0500",
        ),
        (
            row(decided_by="view graph", sigma=None),
            "camera 1: focal length 1,000.0 px (a guess) became 1,100.0 px (+10.0%) by the view graph",
        ),
        (
            row(decided_by="undetermined", found=1000.0, sigma=None),
            "camera 1: focal length 1,000.0 px (a guess) kept, the matches do not tell it",
        ),
        (
            replace(
                row(decided_by="undetermined", found=1000.0, sigma=None),
                parameters=[1000.0, 600.0, 450.0, -0.05],
            ),
            "camera 1: focal length 1,000.0 px (a guess) kept, the matches do not tell it, "
            "distortion -0.0500",
        ),
        (row(decided_by="held", found=1000.0), "camera 1: focal length 1,000.0 px (a guess) kept"),
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
        "3 of 5 cameras in doubt have another focal length now, by +10.0% to +30.0% (median +20.0%); 1 kept "
        "what was given, as the matches do not tell it; 1 were not to be changed; each stands in locate.json"
    )


def test_what_adjustments_leave_open_is_held_from_then_on_and_warned_of():
    doubt = LensDoubt(Lens("SIMPLE_RADIAL", (1000.0, 600.0, 450.0, 0.0)), 0.3, 0.1)
    known = DoubtedIntrinsics(
        origins={1: Origin.GUESS, 2: Origin.GUESS, 3: Origin.CALIBRATION},
        free=FreeLenses({1: doubt, 2: doubt, 3: doubt}, distortion=True),
        view_graph={1: 1.1},
    )
    assert [known.how(camera) for camera in (1, 2)] == ["view graph", "held"]
    held = known.free.holding([2, 3])
    after = known.after(RefinedLenses({1: 0.01}, (2, 3)), held)
    after = after.after(RefinedLenses({1: 0.005}, (3,)), held.holding([3]))
    assert set(after.free.doubts) == {1, 2}
    assert after.free.with_free_focal() == [1]
    assert after.refined.undetermined == (2, 3)
    assert [after.how(camera) for camera in (1, 2, 3)] == ["adjusted", "undetermined", "undetermined"]
    assert after.refined.sigmas == {1: 0.005}
    rows = [row(1), row(2, "undetermined"), row(3, "undetermined")]
    (warning,) = intrinsics_warnings(after, rows)  # what was calibrated needs none
    assert warning.startswith(
        "camera 2 kept a focal length that was never measured, which the matches do not"
    )
