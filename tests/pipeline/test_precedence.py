"""What sets the scale where control points would: the first by precedence, and the others check it."""

import numpy as np
import pytest

import sfm_shapefit
from sfm_shapefit.files.colmap.model import read_model
from tests.scenes import BUNDLED, COURTYARD


@pytest.mark.parametrize("fixed", [False, True])
def test_control_points_come_before_distances_and_priors_and_only_check_what_is_fixed(tmp_path, fixed):
    truth = read_model(COURTYARD / "truth").images
    apart = float(np.linalg.norm(truth.centers[0] - truth.centers[9]))
    told = {
        "control_points": str(BUNDLED / "gcp_list.txt"),
        "known_distance": (truth.names[0], truth.names[9], 1.1 * apart),
        "priors": BUNDLED / "gps.csv",
    }
    if fixed:
        (tmp_path / "names.txt").write_text("\n".join(truth.names[:6]))
        told["fix"] = str(tmp_path / "names.txt")
    found = sfm_shapefit.locate(COURTYARD / "truth", COURTYARD / "database.db", **told)
    unused = [warning for warning in found.warnings if "not used" in warning]
    uses = {row.use for row in found.control_points}
    assert found.gauge.scale == ("fixed" if fixed else "control points")
    assert [warning.split(" were")[0] for warning in unused] == [
        "known distances",
        "position priors",
        *(["control points"] if fixed else []),
    ]
    assert all("; they differ by " in warning for warning in unused)
    assert uses == ({"check"} if fixed else {"control", "check", "unused"})
