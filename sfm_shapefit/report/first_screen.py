"""What the page says first: whether the model is good, what to do next, and the figures that matter."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePath

import numpy as np

from sfm_shapefit.base.wording import counted, first_of, in_pixels, in_unit, rounded
from sfm_shapefit.facts.model import CheckedFacts, FactsOfModel, JoinedFacts, ModelFacts
from sfm_shapefit.facts.placed import IN_MEMORY, Facts, GraphFacts, relation_of, scope_of
from sfm_shapefit.judgement.reasons import Grade, Kind
from sfm_shapefit.report.drawing import Drawing, PairClass
from sfm_shapefit.report.sentences import MAX_TEXT, placed_sentence, shorten

# Folders of these names say nothing of the scene.
_NAMELESS = {"sparse", "dense", "model", "models", "colmap", "text", "triangulated", "database", "."}


def scene_name(facts: Facts) -> str:
    """Return the name of the scene: of the folder that holds the model or database, or of the graph."""
    path = facts.inputs.path
    if isinstance(facts, GraphFacts) or path == IN_MEMORY:
        return shorten(PurePath(path).name)
    if isinstance(facts, JoinedFacts):
        return shorten(" + ".join(PurePath(model).name for model in facts.models))
    parts = Path(os.path.abspath(path)).parts[1:]
    named = [part for part in parts if part.lower() not in _NAMELESS and not part.isdigit()]
    folders = [part for part in named if PurePath(part).suffix.lower() != ".db"]
    return shorten((folders or named or [path])[-1])


def banner(drawing: Drawing, facts: Facts, out: str = "OUT", images: str = "IMAGES") -> dict[str, str]:
    """Return the verdict in a headline and a sentence, and the next step with its command.

    That names `out`, the folder of the model, and `images`, that of the images.
    """
    step = facts.next_step.at(out=out, images=images, out_dense=f"{out}_dense")
    return {
        "grade": facts.verdict.grade.value,
        "headline": _headline(drawing, facts),
        "sentence": _sentence(drawing, facts),
        "next": step.text,
        "command": step.command,
    }


def tiles(drawing: Drawing, facts: Facts) -> list[dict[str, str]]:
    """Return the key figures: value, label, what it means, and whether it is good."""
    return [
        _placed_tile(drawing),
        *_uncertainty_tile(facts),
        *_length_tile(facts),
        *_points_tile(drawing, facts),
        _doubtful_tile(drawing, facts),
        *_error_tile(facts),
        *_shift_tile(drawing, facts.figures.unit),
        *_track_tile(facts),
    ]


# --- the banner ------------------------------------------------------------------------------------


def _headline(drawing: Drawing, facts: Facts) -> str:
    cameras = len(facts.verdict.cameras)
    if facts.verdict.grade is Grade.GOOD:
        return f"Good: this {'graph is placed' if drawing.noun == 'node' else 'model can be used'}"
    if facts.verdict.grade is Grade.LOOK:
        return f"Look at {counted(cameras, drawing.noun)} first" if cameras else "Look before you use it"
    return (
        "This cannot be judged" if facts.verdict.grade is Grade.CANNOT_BE_JUDGED else "Do not use this model"
    )


def _sentence(drawing: Drawing, facts: Facts) -> str:
    reasons, is_checked = "; ".join(facts.verdict.reasons), isinstance(facts, CheckedFacts)
    reasons = shorten(reasons[:1].upper() + reasons[1:], 4 * MAX_TEXT)
    if facts.verdict.grade is Grade.GOOD:
        agree = int(np.sum(drawing.pairs.classes == PairClass.AGREES))
        against = int(np.sum(drawing.pairs.classes == PairClass.CONTRADICTS))
        others = "none contradicts them"
        if against:
            verb, are = ("contradicts", "is") if against == 1 else ("contradict", "are")
            others = f"{against:,} {verb} them" + ("" if is_checked else f" and {are} set aside")
        return (
            f"{placed_sentence(drawing)[:-1]}; {agree:,} pairs agree with them, {others}, and no "
            f"{drawing.noun} stands out."
        )
    if facts.verdict.grade is not Grade.LOOK or not facts.verdict.cameras:
        named = f"; look at {_named(facts.verdict.cameras)}" if facts.verdict.cameras else ""
        return f"{reasons}{named}." if reasons else ""
    placed = set(np.array(drawing.cameras.names)[drawing.cameras.placed].tolist())
    doubted = [name for name in facts.verdict.cameras if name in placed]
    left_out = [name for name in facts.verdict.cameras if name not in placed]
    is_weak = {one.kind for one in facts.verdict.findings if one.images} == {Kind.POINTS}
    weak = f"{'is' if len(doubted) == 1 else 'are'} weak" if is_weak else "may be wrong"
    parts = [f"{_named(doubted)} {weak}"] if doubted else []
    if left_out:
        parts.append(f"{_named(left_out)} {'is' if len(left_out) == 1 else 'are'} left out")
    if reasons:
        parts.append(reasons[:1].lower() + reasons[1:])
    elif len(doubted) < len(placed):
        parts.append("the others show no weakness")
    return f"{'; '.join(parts)}."


def _named(names: Sequence[str]) -> str:
    """Return the first names, and how many more there are; the table has all."""
    return first_of([shorten(name, 60) for name in names])


# --- the tiles -------------------------------------------------------------------------------------


def _tile(value: str, label: str, hint: str, mood: str = "") -> dict[str, str]:
    return {"value": value, "label": label, "hint": hint, "mood": mood}


def _placed_tile(drawing: Drawing) -> dict[str, str]:
    placed, total = int(drawing.cameras.placed.sum()), len(drawing.cameras.names)
    mood = "good" if placed == total else "look"
    hint = "Images that are left out are listed with the reason."
    return _tile(f"{placed:,} of {total:,}", f"{drawing.noun}s placed", hint, mood)


def _error_tile(facts: Facts) -> Iterator[dict[str, str]]:
    figures = facts.figures
    if figures.pair_error_deg is not None:
        angle = f"{rounded(figures.pair_error_deg, digits=2)}°"
        yield _tile(
            angle if figures.pair_error_px is None else f"{figures.pair_error_px:.2g} px, {angle}",
            "typical error of a pair",
            "Median angle between what the matches of a pair that agrees say and where its cameras stand; in "
            "pixels at the middle of a picture.",
        )


def _uncertainty_tile(facts: Facts) -> Iterator[dict[str, str]]:
    figures, of = facts.figures, facts.sigma_of
    sigma, share = figures.sigma, figures.sigma_of_extent
    if sigma is not None and share is not None and share <= 1.0:  # beyond, nothing is known of it
        relation = f", {relation_of(of)}" if figures.has_scale else ""
        label = f"typical uncertainty, {100.0 * share:.2g}% of the scene{relation}{scope_of(of)}"
        hint = f"Median standard deviation of a position: {sigma:.2g} {figures.sigma_unit} ({of})."
        yield _tile(f"± {in_unit(sigma, figures.unit, digits=2)}", label, hint)


def _length_tile(facts: Facts) -> Iterator[dict[str, str]]:
    lengths = facts.lengths if isinstance(facts, ModelFacts) else None
    if lengths is not None and lengths.has_scale:
        label = f"on a length of {lengths.length:g} {lengths.unit} (95 %)"
        statement = lengths.statement
        yield _tile(f"± {lengths.said(lengths.half_width)}", label, f"{statement[0].upper()}{statement[1:]}.")


def _doubtful_tile(drawing: Drawing, facts: Facts) -> dict[str, str]:
    cameras = len(facts.verdict.cameras)
    label = f"{drawing.noun}{'' if cameras == 1 else 's'} to check"
    hint = "Cameras of low trust, uncertain ones, and those left out; Look at first names them."
    return _tile(f"{cameras:,}", label, hint, "look" if cameras else "good")


def _points_tile(drawing: Drawing, facts: Facts) -> Iterator[dict[str, str]]:
    if not drawing.points.num_all or not isinstance(facts, FactsOfModel):
        return
    label, hint = "3D points", "Triangulated from the placed cameras."
    if facts.mean_reprojection_error_px is not None:
        label += f", {in_pixels(facts.mean_reprojection_error_px, 2)} mean reprojection error"
    if isinstance(facts, ModelFacts) and facts.agreement.observations is not None:
        hint += f" {facts.agreement.observations:.0%} of the matched keypoints see one."
    yield _tile(f"{drawing.points.num_all:,}", label, hint)


def _shift_tile(drawing: Drawing, unit: str) -> Iterator[dict[str, str]]:
    shifts = drawing.shifts()
    known = shifts[np.isfinite(shifts)]
    if len(known) and drawing.extent > 0.0:
        median = float(np.median(known))
        share = f"{100.0 * median / drawing.extent:.2g}% of the scene"
        label = f"typical shift from the input's positions ({share})"
        yield _tile(
            in_unit(median, unit, digits=2),
            label,
            "The input's positions place no camera; they may be wrong.",
        )


def _track_tile(facts: Facts) -> Iterator[dict[str, str]]:
    if isinstance(facts, CheckedFacts) and facts.median_track_length is not None:
        length = f"{facts.median_track_length:.3g}"
        yield _tile(length, "images see a 3D point (median)", "The median track length.")
