"""What sets the scale where several things would: the first by precedence, and the others check it."""

import numpy as np
import pytest

import sfm_shapefit
from sfm_shapefit.files.colmap.model import read_model
from tests.scenes import BUNDLED, COURTYARD, RING

NAMES = ("0001.jpg", "0003.jpg")


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """What may be told of the ring, by its name; each says another scale."""
    folder, model = tmp_path_factory.mktemp("told"), read_model(RING / "sparse" / "0").images
    place = dict(zip(model.names, model.centers, strict=True))
    (folder / "one.txt").write_text(model.names[4])
    (folder / "five.txt").write_text("\n".join(model.names[:5]))
    rows = zip(model.names, (2.0 * model.centers).tolist(), strict=True)
    (folder / "priors.txt").write_text("\n".join(f"{name} {x!r} {y!r} {z!r}" for name, (x, y, z) in rows))
    apart = float(np.linalg.norm(np.subtract(*(place[name] for name in NAMES))))
    return {
        "fixed": {"fix": str(folder / "five.txt")},
        "one": {"fix": str(folder / "one.txt")},
        "distance": {"known_distance": (*NAMES, 1.5 * apart)},
        "priors": {"priors": folder / "priors.txt"},
        "unit": {"scale": "unit"},
        "input": {"scale": "input"},
    }


DISTANCES = "known distances were not used for the scale, which is that of "
PRIORS = "position priors were not used for the scale, which is that of "


@pytest.mark.parametrize(
    ("told", "scale", "checks"),
    [
        (
            "fixed distance priors unit",
            "fixed",
            [
                f"{DISTANCES}the fixed cameras; they differ by 50 %",
                f"{PRIORS}the fixed cameras; they differ by 100 %",
                "the scale unit was not used, but that of the fixed cameras",
            ],
        ),
        ("distance priors", "distance", [f"{PRIORS}the known distances; they differ by 33.3 %"]),
        ("distance input", "distance", []),
        ("priors unit", "prior", ["the scale unit was not used, but that of the position priors"]),
        ("one priors", "input", [f"{PRIORS}the input; they differ by 100 %"]),
        ("one distance", "distance", []),
        ("unit", "unit", []),
    ],
)
def test_the_first_by_precedence_sets_the_scale_and_the_others_are_told_as_checks(given, told, scale, checks):
    options = {key: value for name in told.split() for key, value in given[name].items()}
    found = sfm_shapefit.locate(RING / "sparse" / "0", points="never", **options)
    assert found.gauge.scale == scale
    assert [warning for warning in found.warnings if "not used" in warning] == checks
    assert found.options.gauge.scale == options.get("scale", "auto")


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
