"""The report in words: what was placed, how certain it is, and what to look at first.

What comes before all of it, the verdict and the key figures, is in `first_screen`.

Sentences are plain text. Names in them come from strangers: whoever shows a sentence shows it as text, and
`shorten` keeps a name of any length readable.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

import numpy as np

from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.wording import in_unit, make_printable
from sfm_shapefit.facts.model import FactsOfModel, ModelFacts
from sfm_shapefit.facts.placed import Facts
from sfm_shapefit.judgement.grade import OTHER_PLACE
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.judgement.trust import LOW_TRUST
from sfm_shapefit.report.drawing import Drawing, PairClass

MAX_TEXT = 160  # characters of a name or sentence that are shown; strangers may write longer ones
_OF_PAIRS = "of the pairs contradict"  # as a warning says that counts them
_SOLVER_SCALE = "the solver's own units, the centroid at the origin"
_FEW_PAIRS = 4  # contradicting pairs; that most are of one camera says nothing where there are fewer
_HAVE_TABLES = {"intrinsics", "control points", "scale bars", "numbered images"}
_SHOWN = 3  # items of a kind among the first things to look at; the tables have all
_MOST_WEAK = 6  # weak cameras among these; the table of cameras has all


@dataclass(frozen=True, slots=True, kw_only=True)
class Hint:
    """Something to look at, and which row of the cameras or of the pairs shows it."""

    text: str
    camera: int | None = None
    pair: int | None = None
    of_several: bool = False
    """Whether it is said of several cameras, `camera` being the first."""


def shorten(text: str, limit: int = MAX_TEXT) -> str:
    """Return text on one line, of bounded length, without control characters; the end of a name is kept."""
    head, tail = limit * 2 // 3, limit // 3
    if len(text) > limit:
        text = f"{text[:head]} ... {text[-tail:]}"
    return make_printable(text)


def summary_sentences(drawing: Drawing, facts: Facts) -> list[str]:
    """Return what was placed, how certain it is, and what else is told of the scene, a sentence each."""
    stated = facts.scale if isinstance(facts, FactsOfModel) else _SOLVER_SCALE
    _, _, units = stated.partition(": ")  # after the option's value
    return [
        _pairs(drawing),
        *_certainty(drawing, facts),
        *_relative_lengths(facts),
        f"Units and axes: {shorten(units or stated, 2 * MAX_TEXT)}.",
        *(
            f"{label[:1].upper()}{label[1:]}: {shorten('; '.join(lines), 4 * MAX_TEXT)}."
            for label, lines in facts.scene_rows()
            if lines and label not in _HAVE_TABLES
        ),
    ]


def first_looks(drawing: Drawing, facts: Facts) -> list[Hint]:
    """Return what deserves a look, the most telling first; empty if nothing does."""
    is_told = any(_OF_PAIRS in text for text in facts.warnings)
    if facts.verdict.grade is Grade.GOOD:  # what is of note there is no task; the banner counts the pairs
        return [hint for hint in _warnings(drawing, facts, set()) if _OF_PAIRS not in hint.text]
    cameras = [*_left_out(drawing), *_least_trusted(drawing), *_weak(drawing, facts)]
    found = _warnings(drawing, facts, {hint.camera for hint in cameras})
    warnings = sorted(found, key=lambda hint: hint.camera is not None and not hint.of_several)
    told = {hint.camera for hint in [*warnings, *cameras] if not hint.of_several}
    return _one_of_each_camera(
        drawing,
        [
            *warnings,
            *cameras,
            *_contradictions(drawing, told, is_told=is_told),
            *_loose(facts),
            *_unchecked(drawing),
        ],
    )


def _one_of_each_camera(drawing: Drawing, hints: list[Hint]) -> list[Hint]:
    """Return the hints with all that is said of a camera in one, where the first stands."""
    texts: dict[int, list[str]] = {}
    for hint in hints:
        if hint.camera is not None and not hint.of_several:
            said = texts.setdefault(hint.camera, [])
            own = f"{shorten(drawing.cameras.names[hint.camera])}: "
            said.append(hint.text.removeprefix(own) if said else hint.text)  # the first names it
    found = []
    for hint in hints:
        if hint.camera is None or hint.of_several:
            found.append(hint)
        elif lines := texts.pop(hint.camera, None):
            found.append(replace(hint, text="; ".join(lines)))
    return found


def placed_sentence(drawing: Drawing) -> str:
    """Return how many cameras are placed, as a sentence."""
    placed, total = int(drawing.cameras.placed.sum()), len(drawing.cameras.names)
    if placed == total:
        return f"All {total:,} {drawing.noun}s are placed."
    elsewhere = int(np.sum(~drawing.cameras.placed & (drawing.cameras.pieces > 0)))
    note = f" ({elsewhere:,} in smaller pieces)" if elsewhere else ""
    missing = f"{total - placed:,} {_are(total - placed)} not in this model"
    return f"{placed:,} of {total:,} {drawing.noun}s are placed; {missing}{note}."


def _pairs(drawing: Drawing) -> str:
    counts = np.bincount(drawing.pairs.classes, minlength=len(PairClass)).tolist()
    agree, against = counts[PairClass.AGREES], counts[PairClass.CONTRADICTS]
    text = (
        f"Of {len(drawing.pairs.classes):,} pairs, {agree:,} {'agrees' if agree == 1 else 'agree'} with the "
        f"placed {drawing.noun}s and {against:,} {'contradicts' if against == 1 else 'contradict'} them"
    )
    if counts[PairClass.UNDETERMINED]:
        text += f"; {counts[PairClass.UNDETERMINED]:,} cannot be judged"
    if counts[PairClass.REJECTED]:
        count = counts[PairClass.REJECTED]
        text += f"; {count:,} {_are(count)} rejected, as most of their matches contradict the rotations"
    if counts[PairClass.NO_DIRECTION]:
        has = "has" if counts[PairClass.NO_DIRECTION] == 1 else "have"
        text += f"; {counts[PairClass.NO_DIRECTION]:,} {has} no usable direction"
    return text + "."


def _certainty(drawing: Drawing, facts: Facts) -> Iterator[str]:
    sigmas = drawing.cameras.sigmas[drawing.cameras.placed]
    known = np.isfinite(sigmas)
    if not known.any() or drawing.extent <= 0.0:
        return
    worst = int(np.argmax(np.where(drawing.cameras.placed, np.nan_to_num(drawing.cameras.sigmas), -1.0)))
    covers, _, relative = facts.sigma_of.removeprefix("adjusted: ").partition("; ")
    covers = " and ".join(covers.rsplit(", ", 1))
    meaning = f" Uncertainties cover {covers}, {relative}." if covers else ""
    who = shorten(drawing.cameras.names[worst])
    sigma = in_unit(float(drawing.cameras.sigmas[worst]), facts.figures.unit, digits=2)
    yield f"The least certain position is that of {who}: ± {sigma}.{shorten(meaning)}"


def _relative_lengths(facts: Facts) -> Iterator[str]:
    """Yield how well lengths are known where nothing known set the scale; else `scene_rows` says it."""
    lengths = facts.lengths if isinstance(facts, ModelFacts) else None
    if lengths is not None and not lengths.has_scale:
        yield f"Relative to the size of the scene, {lengths.relative}."


def _warnings(drawing: Drawing, facts: Facts, told: set[int | None]) -> Iterator[Hint]:
    """Yield warnings, but for those of a camera of which something is told anyway.

    Evidence against groups, places and lenses is always told.
    """
    evidence = facts.evidence.statements if isinstance(facts, FactsOfModel) else []
    names = {name: row for row, name in enumerate(drawing.cameras.names) if not name.isdigit()}
    for warning in facts.warnings:
        # The longest name wins, as "11.jpg" is in "111.jpg".
        found = [name for name in names if name in warning]
        rows = [names[one] for one in found if not any(one in name and one != name for name in found)]
        if not rows or not told.issuperset(rows) or warning in evidence:
            text = shorten(warning, 2 * MAX_TEXT)
            text = text if warning.startswith(tuple(found)) else f"{text[:1].upper()}{text[1:]}"
            yield Hint(text=text, camera=min(rows, default=None), of_several=len(rows) > 1)


def _left_out(drawing: Drawing) -> Iterator[Hint]:
    rows = np.flatnonzero(~drawing.cameras.placed).tolist()
    for row in rows[:_SHOWN]:
        name, reason = drawing.cameras.names[row], drawing.cameras.reasons[row]
        yield Hint(text=f"{shorten(name)} is not placed: {shorten(reason)}", camera=row)
    if len(rows) > _SHOWN:
        yield Hint(text=f"{len(rows) - _SHOWN:,} more are not placed; the table of cameras says why")


def _least_trusted(drawing: Drawing) -> Iterator[Hint]:
    trust = np.where(drawing.cameras.placed, drawing.cameras.trust, np.nan)
    low = np.flatnonzero(trust < LOW_TRUST)
    for row in low[np.argsort(trust[low], kind="stable")][:_SHOWN].tolist():
        reason = shorten(drawing.cameras.reasons[row] or "its pairs speak against it")
        yield Hint(
            text=f"{shorten(drawing.cameras.names[row])} has trust {trust[row]:.2f}: {reason}", camera=row
        )


def _weak(drawing: Drawing, facts: Facts) -> Iterator[Hint]:
    """Yield cameras that have no trust, as those of a model that is only looked at, but a weakness."""
    cameras = drawing.cameras
    rows = [
        k
        for k in np.flatnonzero(cameras.placed & np.isnan(cameras.trust)).tolist()
        if cameras.reasons[k] and cameras.names[k] in facts.verdict.cameras
    ]
    for row in rows[:_MOST_WEAK]:
        clauses = [one for one in cameras.reasons[row].split("; ") if one != OTHER_PLACE]  # which is told
        if clauses:
            yield Hint(text=f"{shorten(cameras.names[row])}: {shorten('; '.join(clauses))}", camera=row)
    if len(rows) > _MOST_WEAK:
        yield Hint(text=f"{len(rows) - _MOST_WEAK:,} more are weak; the table of cameras says why")


def _contradictions(drawing: Drawing, told: Collection[int | None], *, is_told: bool) -> Iterator[Hint]:
    """Yield the contradicting pairs with most matches, but for those of cameras of which something is told.

    They are repeated structure, or wrong rotations. How many there are comes first, if that `is_told` by no
    warning.
    """
    pairs = drawing.pairs
    of_others = ~np.isin(pairs.cameras, [row for row in told if row is not None]).any(axis=1)
    against = np.flatnonzero((pairs.classes == PairClass.CONTRADICTS) & of_others)
    if len(against) and not is_told:
        yield _set_aside(drawing, against)
    order = np.lexsort((-pairs.residuals_deg[against], -pairs.support[against]))
    for row in against[order][:_SHOWN].tolist():
        first, second = (shorten(drawing.cameras.names[k], 60) for k in pairs.cameras[row].tolist())
        matches = f" with {pairs.support[row]:,} matches" if pairs.support[row] else ""
        yield Hint(
            text=f"{first} and {second}{matches}: off by {pairs.residuals_deg[row]:.3g} degrees",
            pair=row,
        )


def _set_aside(drawing: Drawing, against: IntArray) -> Hint:
    """Say how many pairs contradict the placed cameras, and whose they are."""
    pairs, count = drawing.pairs, len(against)
    verb = "contradicts" if count == 1 else "contradict"
    judged = int(np.sum(~np.isin(pairs.classes, [PairClass.NO_DIRECTION, PairClass.REJECTED])))
    text = f"{count:,} of {judged:,} pairs {verb} the placed {drawing.noun}s"
    if np.isfinite(drawing.cameras.trust).any():
        text += f" and {_are(count)} set aside"
    if np.any(pairs.support > 0):
        text += ": repeated structure, as a rule, if they have many matches"
    shares = np.bincount(pairs.cameras[against].ravel(), minlength=len(drawing.cameras.names))
    most = int(np.argmax(shares))
    if count < _FEW_PAIRS or 2 * shares[most] <= count:
        return Hint(text=text)
    return Hint(text=f"{text}; {shares[most]:,} are of {shorten(drawing.cameras.names[most])}", camera=most)


def _are(count: int) -> str:
    return "is" if count == 1 else "are"


def _loose(facts: Facts) -> Iterator[Hint]:
    for group in facts.loose_groups[:_SHOWN]:
        names = ", ".join(shorten(name, 40) for name in group.cameras[:_SHOWN])
        more = f" and {len(group.cameras) - _SHOWN:,} more" if len(group.cameras) > _SHOWN else ""
        each = "each" if len(group.cameras) > 1 else "it"
        yield Hint(text=f"{names}{more} may slide: {each} {shorten(group.cause.removeprefix('it '))}")


def _unchecked(drawing: Drawing) -> Iterator[Hint]:
    count = int(np.sum(drawing.pairs.classes == PairClass.UNDETERMINED))
    if count:
        what = "1 pair" if count == 1 else f"{count:,} pairs"
        yield Hint(text=f"{what} cannot be judged: unchecked by others, in one frame, or outside the pieces")
