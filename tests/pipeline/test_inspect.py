"""`inspect` says of a camera what `locate` will say of it."""

import sfm_shapefit
from tests.models import turned
from tests.problems import turn
from tests.scenes import COURTYARD


def test_a_right_camera_before_a_repeated_facade_is_not_weak():
    """7 of the 10 pairs of 0007.jpg contradict their triangles, and its own relative rotations do not."""
    seen = sfm_shapefit.inspect(COURTYARD / "sparse" / "0", COURTYARD / "database.db")
    assert seen.diagnosis.weak == ()
    assert seen.diagnosis.corruption.share > 0.1


def test_a_turned_camera_is_named():
    model = turned(COURTYARD / "sparse" / "0", ["0010.jpg"], turn([0.0, 1.0, 0.0], 20.0))
    seen = sfm_shapefit.inspect(model, COURTYARD / "database.db")
    told = {camera.name for camera in seen.diagnosis.weak} | set(seen.diagnosis.left_out)
    assert told == {"0010.jpg"}
