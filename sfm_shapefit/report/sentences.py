"""The report in words: what was placed, how certain it is, and what to look at first.

Sentences are plain text. Names in them come from strangers: whoever shows a sentence shows it as text, and
`shorten` keeps a name of any length readable.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sfm_shapefit.report.drawing import Drawing, PairClass
from sfm_shapefit.results.intrinsics import describe_intrinsics

MAX_TEXT = 160
"""Characters of a name or sentence that are shown."""
# Repeated structure and wrong rotations are off by more than this.
_FAR_DEG = 1.0
# Below this trust, reasons are given.
_LOW_TRUST = 0.75
_SOLVER_SCALE = "the solver's own units, the centroid at the origin"
# So many items of a kind are among the first things to look at.
_SHOWN = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Hint:
    """Something to look at, and which row shows it."""

    text: str
    camera: int | None = None
    """A row of the cameras."""
    pair: int | None = None
    """A row of the pairs."""


def shorten(text: str, limit: int = MAX_TEXT) -> str:
    """Return text on one line, of bounded length, without control characters; the end of a name is kept."""
    head, tail = limit * 2 // 3, limit // 3
    if len(text) > limit:
        text = f"{text[:head]} ... {text[-tail:]}"
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def summary_sentences(drawing: Drawing, facts: dict[str, Any]) -> list[str]:
    """Return what was placed and how certain it is, a sentence each; the facts are those of locate.json."""
    return [
        *_verdict(facts),
        _placed(drawing),
        _pairs(drawing, facts),
        *_certainty(drawing),
        f"Scale and origin: {shorten(facts.get('scale') or _SOLVER_SCALE, 2 * MAX_TEXT)}.",
        *_intrinsics(facts),
        *_delivered(facts),
    ]


def first_looks(drawing: Drawing, facts: dict[str, Any]) -> list[Hint]:
    """Return what deserves a look, the most telling first; empty if nothing does."""
    return [
        *(Hint(text=shorten(text, 2 * MAX_TEXT)) for text in facts["warnings"]),
        *_left_out(drawing),
        *_least_trusted(drawing),
        *_contradictions(drawing),
        *_loose(facts),
        *_unchecked(drawing),
    ]


def _verdict(facts: dict[str, Any]) -> Iterator[str]:
    """Yield the verdict, which earlier outputs lack."""
    if "verdict" in facts:
        yield f"Verdict: {shorten(facts['verdict']['statement'], 2 * MAX_TEXT)}."


def _placed(drawing: Drawing) -> str:
    placed, total = int(drawing.cameras.placed.sum()), len(drawing.cameras.names)
    noun = "images" if np.isfinite(drawing.cameras.poses.rotations).any() else "nodes"
    if placed == total:
        return f"All {total:,} {noun} were placed."
    elsewhere = int(np.sum(~drawing.cameras.placed & (drawing.cameras.pieces > 0)))
    note = f" ({elsewhere:,} in smaller pieces)" if elsewhere else ""
    missing = f"{total - placed:,} {'is' if total - placed == 1 else 'are'} not in this model"
    return f"{placed:,} of {total:,} {noun} were placed; {missing}{note}."


def _pairs(drawing: Drawing, facts: dict[str, Any]) -> str:
    counts = np.bincount(drawing.pairs.classes, minlength=len(PairClass)).tolist()
    text = (
        f"Of {len(drawing.pairs.classes):,} pairs, {counts[PairClass.AGREES]:,} agree with the solution "
        f"(a standard deviation of {facts['residual_level_deg']:.2g} degrees per axis) and "
        f"{counts[PairClass.CONTRADICTS]:,} contradict it"
    )
    if counts[PairClass.UNDETERMINED]:
        text += f"; {counts[PairClass.UNDETERMINED]:,} cannot be judged"
    if counts[PairClass.NO_DIRECTION]:
        has = "has" if counts[PairClass.NO_DIRECTION] == 1 else "have"
        text += f"; {counts[PairClass.NO_DIRECTION]:,} {has} no usable direction"
    return text + "."


def _certainty(drawing: Drawing) -> Iterator[str]:
    sigmas = drawing.cameras.sigmas[drawing.cameras.placed]
    known = np.isfinite(sigmas)
    if not known.any() or drawing.extent <= 0.0:
        return
    worst = int(np.argmax(np.where(drawing.cameras.placed, np.nan_to_num(drawing.cameras.sigmas), -1.0)))
    median = float(np.median(sigmas[known]))
    yield (
        f"The median standard deviation of a position is {median:.2g} units, "
        f"{100.0 * median / drawing.extent:.2g}% of the extent of {drawing.extent:.4g} units; the largest is "
        f"{drawing.cameras.sigmas[worst]:.2g}, of {shorten(drawing.cameras.names[worst])}."
    )


def _delivered(facts: dict[str, Any]) -> Iterator[str]:
    """Yield what is certified and what is delivered, which earlier outputs lack."""
    if "delivered" in facts:
        yield f"The certificate: {facts['delivered']['statement']}."


def _intrinsics(facts: dict[str, Any]) -> Iterator[str]:
    """Yield what became of intrinsics in doubt, which earlier outputs lack."""
    lines = describe_intrinsics(facts.get("intrinsics", []))
    if lines:
        yield f"Intrinsics: {'; '.join(lines)}."


def _left_out(drawing: Drawing) -> Iterator[Hint]:
    rows = np.flatnonzero(~drawing.cameras.placed).tolist()
    for row in rows[:_SHOWN]:
        name, reason = drawing.cameras.names[row], drawing.cameras.reasons[row]
        yield Hint(text=f"{shorten(name)} is not placed: {shorten(reason)}", camera=row)
    if len(rows) > _SHOWN:
        yield Hint(text=f"{len(rows) - _SHOWN:,} more are not placed; the table of cameras says why")


def _least_trusted(drawing: Drawing) -> Iterator[Hint]:
    trust = np.where(drawing.cameras.placed, drawing.cameras.trust, np.nan)
    low = np.flatnonzero(trust < _LOW_TRUST)
    for row in low[np.argsort(trust[low], kind="stable")][:_SHOWN].tolist():
        reason = shorten(drawing.cameras.reasons[row] or "its pairs speak against it")
        yield Hint(
            text=f"{shorten(drawing.cameras.names[row])} has trust {trust[row]:.2f}: {reason}", camera=row
        )


def _contradictions(drawing: Drawing) -> Iterator[Hint]:
    """Yield the contradicting pairs with most matches: repeated structure, or wrong rotations.

    Those that are off by little, if by more than the others, come together in a sentence.
    """
    pairs = drawing.pairs
    against = np.flatnonzero(pairs.classes == PairClass.CONTRADICTS)
    far = pairs.residuals_deg[against] >= _FAR_DEG
    if len(against) and not far.any():
        yield Hint(
            text=f"{len(against):,} of the pairs contradict the solution, but by "
            f"{pairs.residuals_deg[against].max():.2g} degrees at most"
        )
    against = against[far]
    order = np.lexsort((-pairs.residuals_deg[against], -pairs.support[against]))
    for row in against[order][:_SHOWN].tolist():
        first, second = (shorten(drawing.cameras.names[k], 60) for k in pairs.cameras[row].tolist())
        matches = f" with {pairs.support[row]:,} matches" if pairs.support[row] else ""
        yield Hint(
            text=f"{first} to {second}{matches} contradicts the solution "
            f"by {pairs.residuals_deg[row]:.3g} degrees",
            pair=row,
        )


def _loose(facts: dict[str, Any]) -> Iterator[Hint]:
    for group in facts["loose_groups"][:_SHOWN]:
        names = ", ".join(shorten(name, 40) for name in group["cameras"][:_SHOWN])
        more = f" and {len(group['cameras']) - _SHOWN:,} more" if len(group["cameras"]) > _SHOWN else ""
        yield Hint(text=f"{names}{more}: loose, {shorten(group['cause'])}")


def _unchecked(drawing: Drawing) -> Iterator[Hint]:
    count = int(np.sum(drawing.pairs.classes == PairClass.UNDETERMINED))
    if count:
        what = "1 pair" if count == 1 else f"{count:,} pairs"
        yield Hint(text=f"{what} cannot be judged: unchecked by others, or in a piece that is not solved")
