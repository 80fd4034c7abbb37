"""What the page says first: whether the model is good, what to do next, and the figures that matter."""

import shlex
from collections.abc import Iterator
from pathlib import PurePath
from typing import Any

import numpy as np

from sfm_shapefit.base.wording import rounded
from sfm_shapefit.facts.key_figures import NOISE_ONLY
from sfm_shapefit.facts.tables import IN_MEMORY
from sfm_shapefit.report.drawing import Drawing, PairClass
from sfm_shapefit.report.sentences import MAX_TEXT, placed_sentence, shorten

# Folders of these names say nothing of the scene.
_NAMELESS = {"sparse", "dense", "model", "models", "colmap", "text", "triangulated", "database", "."}
_NAMED = 3


def scene_name(facts: dict[str, Any]) -> str:
    """Return the name of the scene: that of the folder which holds the model or database, or of the graph."""
    inputs = facts["inputs"]
    if "graph" in inputs:
        return shorten(PurePath(str(inputs["graph"])).name)
    path = input_of(facts)
    if path == IN_MEMORY:
        return path
    parts = PurePath(path).parts
    named = [part for part in parts if part.lower() not in _NAMELESS and not part.isdigit()]
    folders = [part for part in named if PurePath(part).suffix.lower() != ".db"]
    return shorten((folders or named or [path])[-1])


def input_of(facts: dict[str, Any]) -> str:
    """Return the path of the input; a model in memory, as of `map`, is named by its database."""
    inputs = facts["inputs"]
    model, database = inputs.get("model"), inputs.get("database")
    return str(database if model == IN_MEMORY and database else model or inputs.get("graph"))


def banner(drawing: Drawing, facts: dict[str, Any]) -> dict[str, str]:
    """Return the verdict in a headline and a sentence, and the next step with its command.

    In the command, {out} stands for the folder of the page, and {out_further} for one beside it.
    """
    verdict = facts.get("verdict", {})
    grade = str(verdict.get("grade", ""))
    text, command = next_step(grade, facts)
    return {
        "grade": grade,
        "headline": _headline(grade, drawing, verdict),
        "sentence": _sentence(grade, drawing, facts),
        "next": text,
        "command": command,
    }


def tiles(drawing: Drawing, facts: dict[str, Any]) -> list[dict[str, str]]:
    """Return the key figures: value, label, what it means, and whether it is good."""
    return [
        _placed_tile(drawing),
        *_figure_tiles(facts),
        _doubtful_tile(drawing, facts),
        *_points_tile(drawing, facts),
        *_shift_tile(drawing),
        *_track_tile(facts),
    ]


def next_step(grade: str, facts: dict[str, Any]) -> tuple[str, str]:
    """Return what to do, and the command that does it; in it {out} stands as `banner` says."""
    if "graph" in facts["inputs"]:
        return (
            "Next: the positions are in cameras.csv; look at them from all sides.",
            "sfm-shapefit view {out}",
        )
    if facts.get("examined") and "joins" not in facts:
        return _next_of_model(grade, shlex.quote(input_of(facts)))
    if grade == "do not use":
        path = shlex.quote(input_of(facts))
        return "Next: find out what is wrong with the input.", f"sfm-shapefit inspect {path}"
    if facts.get("bundle_adjustment"):
        return (
            "Next: it is bundle-adjusted already; undistort the images for dense reconstruction.",
            "colmap image_undistorter --image_path IMAGES --input_path {out} --output_path {out_dense}",
        )
    first = "Next: bundle adjustment" + (", once you have looked." if grade == "look" else ".")
    return (
        first,
        "mkdir -p {out_adjusted} && colmap bundle_adjuster --input_path {out} --output_path {out_adjusted}",
    )


# --- the banner ------------------------------------------------------------------------------------


def _headline(grade: str, drawing: Drawing, verdict: dict[str, Any]) -> str:
    cameras = len(verdict.get("cameras", []))
    if grade == "good":
        return f"Good: this {'graph is placed' if drawing.noun == 'node' else 'model can be used'}"
    if grade == "look":
        return f"Look at {_count(cameras, drawing.noun)} first" if cameras else "Look before you use it"
    if grade == "do not use":
        return "Do not use this model"
    return f"{int(drawing.cameras.placed.sum()):,} of {len(drawing.cameras.names):,} cameras placed"


def _sentence(grade: str, drawing: Drawing, facts: dict[str, Any]) -> str:
    verdict = facts.get("verdict", {})
    reasons = "; ".join(verdict.get("reasons", []))
    reasons = shorten(reasons[:1].upper() + reasons[1:], 4 * MAX_TEXT)
    if grade == "good":
        agree = int(np.sum(drawing.pairs.classes == PairClass.AGREES))
        against = int(np.sum(drawing.pairs.classes == PairClass.CONTRADICTS))
        others = "none contradicts them"
        if against:
            verb = "contradicts" if against == 1 else "contradict"
            set_aside = "" if facts.get("examined") else f" and {'is' if against == 1 else 'are'} set aside"
            others = f"{against:,} {verb} them{set_aside}"
        return (
            f"{placed_sentence(drawing)[:-1]}; {agree:,} pairs agree with them, {others}, and no "
            f"{drawing.noun} stands out."
        )
    cameras = [shorten(name, 60) for name in verdict.get("cameras", [])]
    if grade != "look" or not cameras:
        return f"{reasons}." if reasons else ""
    more = f" and {len(cameras) - _NAMED:,} more" if len(cameras) > _NAMED else ""
    named = f"{', '.join(cameras[:_NAMED])}{more}"
    verb = "is" if len(cameras) == 1 else "are"
    if facts.get("examined"):
        return f"{named} {verb} weak; the others show no weakness."
    others = "the others can be used" if not reasons else reasons[:1].lower() + reasons[1:]
    return f"{named} may be wrong or {verb} left out; {others}."


def _next_of_model(grade: str, path: str) -> tuple[str, str]:
    """Return what to do with a model that was only looked at."""
    if grade == "good":
        return (
            "Next: undistort the images for dense reconstruction.",
            f"colmap image_undistorter --image_path IMAGES --input_path {path} --output_path dense",
        )
    return (
        "Next: place the cameras anew from their rotations and matches, and compare.",
        f"sfm-shapefit locate {path} located",
    )


# --- the tiles -------------------------------------------------------------------------------------


def _tile(value: str, label: str, hint: str, mood: str = "") -> dict[str, str]:
    return {"value": value, "label": label, "hint": hint, "mood": mood}


def _placed_tile(drawing: Drawing) -> dict[str, str]:
    placed, total = int(drawing.cameras.placed.sum()), len(drawing.cameras.names)
    mood = "good" if placed == total else "look"
    hint = "Those that are left out are listed with the reason."
    return _tile(f"{placed:,} of {total:,}", f"{drawing.noun}s placed", hint, mood)


def _figure_tiles(facts: dict[str, Any]) -> Iterator[dict[str, str]]:
    """Yield the tiles of `figures` in locate.json, which earlier outputs lack."""
    figures = facts.get("figures", {})
    error_deg, error_px = figures.get("pair_error_deg"), figures.get("pair_error_px")
    if error_deg is not None:
        angle = f"{rounded(error_deg, digits=2)}°"
        yield _tile(
            angle if error_px is None else f"{error_px:.2g} px, {angle}",
            "typical error of a pair",
            "Median angle between what the matches of a pair say and where its cameras stand; in pixels at "
            "the middle of a picture.",
        )
    sigma, share = figures.get("sigma"), figures.get("sigma_of_extent")
    if sigma is not None and share is not None:
        scope = f", {NOISE_ONLY}" if facts["sigma_of"].startswith(NOISE_ONLY) else ""
        label = f"typical uncertainty, {100.0 * share:.2g}% of the scene{scope}"
        of = facts["sigma_of"]
        hint = f"Median standard deviation of a position: {sigma:.2g} {figures['sigma_unit']} ({of})."
        yield _tile(f"± {sigma:.2g} units", label, hint)


def _doubtful_tile(drawing: Drawing, facts: dict[str, Any]) -> dict[str, str]:
    cameras = len(facts.get("verdict", {}).get("cameras", []))
    label = f"{drawing.noun}{'' if cameras == 1 else 's'} to check"
    hint = "Of low trust, uncertain, or left out; they are named under Look at first."
    return _tile(f"{cameras:,}", label, hint, "look" if cameras else "good")


def _points_tile(drawing: Drawing, facts: dict[str, Any]) -> Iterator[dict[str, str]]:
    if not drawing.points.num_all:
        return
    error = facts.get("mean_reprojection_error_px")
    label = "3D points"
    if error is not None and np.isfinite(error):
        label += f", {error:.2f} px mean reprojection error"
    observations = facts.get("agreement", {}).get("observations")
    hint = "" if observations is None else f" {observations:.0%} of the matched keypoints see one."
    yield _tile(f"{drawing.points.num_all:,}", label, f"Triangulated from the placed cameras.{hint}")


def _shift_tile(drawing: Drawing) -> Iterator[dict[str, str]]:
    shifts = drawing.shifts()
    known = shifts[np.isfinite(shifts)]
    if len(known) and drawing.extent > 0.0:
        median = float(np.median(known))
        label = (
            f"typical shift from the input's positions ({100.0 * median / drawing.extent:.2g}% of the scene)"
        )
        yield _tile(f"{median:.2g} units", label, "The input's positions place no camera; they may be wrong.")


def _track_tile(facts: dict[str, Any]) -> Iterator[dict[str, str]]:
    length = facts.get("median_track_length")
    if length is not None and np.isfinite(length):
        yield _tile(f"{length:.3g}", "images see a 3D point (median)", "The median track length.")


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
