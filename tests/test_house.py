"""Changes that a newcomer may want to make, and the files that each edits beside a module of its own.

The nearest thing that is there already shows the way: its names stand in the files that a new one would edit,
and in no others. A feature that is spread over the house makes its list longer than the change is worth.

Something else that adjustments may free is a part of lenses, as the distortion is: principal points were
freed on a branch of their own, which edited these five files. Another pose, as that of a sensor in its rig,
has unknowns, a gauge and standard deviations of its own, and is spread as wide as its last list says.
"""

import re
from typing import NamedTuple

import pytest

from tests.test_architecture import PACKAGE


class Change(NamedTuple):
    """Something new, and where the nearest old thing stands."""

    most: int
    """Files that the change may edit."""
    names: str
    """What finds the old thing: a pattern of its names."""
    files: set[str]
    """Files of the package that have such a name."""


CHANGES = {
    "a camera model that adjustments may change": Change(
        2, r"\b_LENS_MODELS\b|\bRAD_TAN\b", {"scene/lens.py", "scene/wide_lenses.py"}
    ),
    "an output format": Change(2, r"\btum_text\b|\"tum\"", {"files/tum.py", "pipeline/convert.py"}),
    "a robust loss": Change(2, r"\bsettle_points\b", {"adjustment/lone_points.py", "adjustment/solve.py"}),
    "a flag": Change(
        2, r"\"min_trust\", \"points\"|\bmin_trust: float = option", {"judgement/options.py", "cli/locate.py"}
    ),
    "another kind of prior": Change(
        4,
        r"\bclass ControlPoints\b|\blook_at_marks\b|\bcontrol_gauge\b",
        {
            "scene/given.py",
            "files/colmap/control_points.py",
            "placement/control_points.py",
            "pipeline/gauge_choice.py",
        },
    ),
    "a warning": Change(1, r"two ways to find lengths disagree", {"facts/warnings.py"}),
    "a GPU solver": Change(
        2,
        r"\bLiteral\b.*\"conic\"|\bsolve_conic\(graph, tol, limit\)",
        {"solver/options.py", "solver/solve.py"},
    ),
    "an averaging method": Change(
        2, r"(?m)^    anneal,|\bdef anneal\b", {"rotations/annealing.py", "rotations/average.py"}
    ),
    "a figure in locate.json": Change(2, r"\bline_sigma\b", {"facts/model.py", "facts/result.py"}),
    "something else that adjustments may free": Change(
        5,
        r"\bfree_distortion\b|\"distortion\"|\bby_values\[1, 4\]|\bdef _distortion\b",
        {
            "adjustment/options.py",
            "adjustment/projection.py",
            "facts/intrinsics.py",
            "scene/freedom.py",
            "scene/lens.py",
        },
    ),
    "another pose that adjustments may free": Change(
        5,
        r"\b(has|judge|free|refines)_sensors\b|\bby_sensor\b|\bfreedom\.sensors\b|\bsensor_(sigmas|bases|entry)\b"
        r"|\brestore_baselines\b|\brefined_rigs\b|\bRigFreedom\b",
        {
            "adjustment/covariance.py",
            "adjustment/estimate.py",
            "adjustment/free_sensors.py",
            "adjustment/freedom.py",
            "adjustment/gauge.py",
            "adjustment/layout.py",
            "adjustment/residuals.py",
            "adjustment/run.py",
            "adjustment/solve.py",
            "facts/model.py",
            "facts/result.py",
            "facts/rigs.py",
            "pipeline/camera_adjustment.py",
            "pipeline/finish.py",
            "pipeline/starts.py",
            "scene/freedom.py",
        },
    ),
}
STILL_MORE = {"another pose that adjustments may free": 16}
"""Files of the changes that touch more than they may; the list may only become shorter."""


@pytest.mark.parametrize("what", CHANGES)
def test_a_change_edits_few_files_and_these_are_known(what):
    change = CHANGES[what]
    pattern = re.compile(change.names)
    found = {
        str(path.relative_to(PACKAGE))
        for path in PACKAGE.rglob("*.py")
        if pattern.search(path.read_text(encoding="utf-8"))
    }
    assert found == change.files
    assert len(found) <= STILL_MORE.get(what, change.most)
