"""Lines that more than one command's table has."""

import re
import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfm_shapefit.base.wording import counted
from sfm_shapefit.cli.console import Rows, shorten
from sfm_shapefit.cli.flags import OutputFlags

if TYPE_CHECKING:
    from sfm_shapefit.adjustment.estimate import Estimate


def further_piece_rows(facts: dict[str, Any]) -> Rows:
    """Return a row that says where the further pieces stand, if there are any."""
    lines = [
        f"{piece['folder']}: {piece['num_placed']} of {counted(piece['num_cameras'], 'camera')}, hinged at "
        f"{', '.join(piece['hinges']) or 'nothing'}, with a scale of its own"
        for piece in facts["pieces"][1:]
        if piece["folder"]
    ]
    return [("further pieces", shorten(lines))] if lines else []


def intrinsics_rows(facts: dict[str, Any]) -> Rows:
    """Return a row on cameras whose intrinsics were in doubt, if there are any."""
    from sfm_shapefit.facts.intrinsics import describe_intrinsics

    lines = describe_intrinsics(facts["intrinsics"])
    return [("intrinsics", shorten(lines))] if lines else []


def rig_rows(facts: dict[str, Any]) -> Rows:
    """Return a row on sensors that were refined in their rigs, if there are any."""
    from sfm_shapefit.facts.rigs import describe_rigs

    lines = describe_rigs(facts["refined_rigs"])
    return [("rigs", shorten(lines))] if lines else []


def control_point_rows(facts: dict[str, Any]) -> Rows:
    """Return a row on ground control points and their residuals, if there are any."""
    from sfm_shapefit.facts.control_points import describe_control_points

    said = describe_control_points(facts["control_points"])
    return [("control points", said)] if said else []


def scene_rows(facts: dict[str, Any]) -> Rows:
    """Return rows on straight drives, loops of videos, and doubtful pairs, if there are any."""
    from sfm_shapefit.facts.scene_words import describe_doubtful_pairs, describe_line, describe_loops

    said = {
        "straight": describe_line(facts["line_sigma"]),
        "video": describe_loops(facts["loops"]),
        "doubtful pairs": describe_doubtful_pairs(facts["num_doubtful_pairs"]),
    }
    return [(label, text) for label, text in said.items() if text]


def describe_points(facts: dict[str, Any]) -> str:
    """Say how many points there are, and how far they are off their keypoints."""
    if not facts["num_points"]:
        return "none"
    return f"{facts['num_points']}, mean error {facts['mean_reprojection_error_px']:.2f} px"


def describe_adjustment(adjusted: "Estimate") -> str:
    """Say how bundle adjustment went."""
    state = "converged" if adjusted.converged else "stopped at its limit"
    before, after = adjusted.initial_error_px, adjusted.final_error_px
    return f"{state} after {adjusted.iterations} steps, mean error {before:.2f} -> {after:.2f} px"


def picture_rows(flags: OutputFlags, names: Iterable[str]) -> Rows:
    """Return a warning if pictures were asked for, and the folder has none of the images."""
    folder = Path(flags.images)
    if not flags.images or not flags.report or any((folder / name).is_file() for name in names):
        return []
    return [("warning", f"{folder} has none of the images, so the report has no pictures")]


def next_steps(facts: dict[str, Any], out: Path, flags: OutputFlags) -> list[str]:
    """Return what to do next, a line each: look at the report, then the command that the report names."""
    from sfm_shapefit.report.first_screen import next_step

    _, command = next_step(facts["verdict"]["grade"], facts)
    filled = re.sub(r"\{out(\w*)\}", lambda found: shlex.quote(f"{out}{found[1]}"), command)
    opened = [f"open {shlex.quote(str(out / 'report.html'))}"] if flags.report else []
    return [*opened, filled]
