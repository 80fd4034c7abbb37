"""The report in words: what was placed, how certain it is, and what to look at first.

Sentences are plain text. Names in them come from strangers: whoever shows a sentence shows it as text, and
`shortened` keeps a name of any length readable.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sfm_shapefit.report.drawing import PairClass, Scene

MAX_TEXT = 160
"""Characters of a name or sentence that are shown."""
_FAR_DEG = 1.0  # repeated structure and wrong rotations are off by more
_LOW_TRUST = 0.75  # below it, reasons are given
_SHOWN = 3  # items of a kind among the first things to look at


@dataclass(frozen=True, slots=True, kw_only=True)
class Hint:
    """Something to look at, and which row shows it."""

    text: str
    camera: int | None = None
    """A row of the cameras."""
    pair: int | None = None
    """A row of the pairs."""


def shortened(text: str, limit: int = MAX_TEXT) -> str:
    """Return text on one line, of bounded length, without control characters; the end of a name is kept."""
    head, tail = limit * 2 // 3, limit // 3
    if len(text) > limit:
        text = f"{text[:head]} ... {text[-tail:]}"
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def summary_sentences(scene: Scene, facts: dict[str, Any]) -> list[str]:
    """Return what was placed and how certain it is, a sentence each.

    Args:
        scene: what is drawn.
        facts: the contents of locate.json.
    """
    return [
        _placed(scene),
        _pairs(scene, facts),
        *_certainty(scene),
        _optimum(facts["solve"]),
        f"Scale and origin: {shortened(_scale(facts), 2 * MAX_TEXT)}.",
    ]


def first_looks(scene: Scene, facts: dict[str, Any]) -> list[Hint]:
    """Return what deserves a look, the most telling first; empty if nothing does."""
    return [
        *(Hint(text=shortened(text, 2 * MAX_TEXT)) for text in facts["warnings"]),
        *_left_out(scene),
        *_least_trusted(scene),
        *_contradictions(scene),
        *_loose(facts),
        *_unchecked(scene),
    ]


def _noun(scene: Scene) -> str:
    return "images" if np.isfinite(scene.cameras.poses.rotations).any() else "nodes"


def _placed(scene: Scene) -> str:
    placed, total = int(scene.cameras.placed.sum()), len(scene.cameras.names)
    if placed == total:
        return f"All {total:,} {_noun(scene)} were placed."
    elsewhere = int(np.sum(~scene.cameras.placed & (scene.cameras.pieces > 0)))
    note = f" ({elsewhere:,} in smaller pieces)" if elsewhere else ""
    missing = f"{total - placed:,} {'is' if total - placed == 1 else 'are'} not in this model"
    return f"{placed:,} of {total:,} {_noun(scene)} were placed; {missing}{note}."


def _pairs(scene: Scene, facts: dict[str, Any]) -> str:
    counts = np.bincount(scene.pairs.classes, minlength=len(PairClass)).tolist()
    text = (
        f"Of {len(scene.pairs.classes):,} pairs, {counts[PairClass.AGREES]:,} agree with the solution "
        f"(a standard deviation of {facts['residual_level_deg']:.2g} degrees per axis) and "
        f"{counts[PairClass.CONTRADICTS]:,} contradict it"
    )
    if counts[PairClass.UNDETERMINED]:
        text += f"; {counts[PairClass.UNDETERMINED]:,} cannot be judged"
    if counts[PairClass.NO_DIRECTION]:
        has = "has" if counts[PairClass.NO_DIRECTION] == 1 else "have"
        text += f"; {counts[PairClass.NO_DIRECTION]:,} {has} no usable direction"
    return text + "."


def _certainty(scene: Scene) -> Iterator[str]:
    sigmas = scene.cameras.sigmas[scene.cameras.placed]
    known = np.isfinite(sigmas)
    if not known.any() or scene.extent <= 0.0:
        return
    worst = int(np.argmax(np.where(scene.cameras.placed, np.nan_to_num(scene.cameras.sigmas), -1.0)))
    median = float(np.median(sigmas[known]))
    yield (
        f"The median standard deviation of a position is {median:.2g} units, "
        f"{100.0 * median / scene.extent:.2g}% of the extent of {scene.extent:.4g} units; the largest is "
        f"{scene.cameras.sigmas[worst]:.2g}, of {shortened(scene.cameras.names[worst])}."
    )


def _optimum(solve: dict[str, Any]) -> str:
    """Say what the certificate proves."""
    if solve["status"] == "not_solved":
        return f"Nothing certifies these positions as a whole ({solve['method']}: {solve['method_reason']})."
    unique = {
        True: ", and no other placement is as good",
        False: ", but others may be as good",
        None: "",
    }[solve["unique"]]
    certified = "is certified" if solve["status"] == "converged" else "is not certified to the tolerance"
    return (
        f"The convex optimum {certified}: its objective {solve['objective']:.4g} is within "
        f"{max(solve['gap'], 0.0):.1e} of the least possible{unique}."
    )


def _scale(facts: dict[str, Any]) -> str:
    return str(facts.get("scale") or "the solver's own units, the centroid at the origin")


def _left_out(scene: Scene) -> Iterator[Hint]:
    rows = np.flatnonzero(~scene.cameras.placed).tolist()
    for row in rows[:_SHOWN]:
        name, reason = scene.cameras.names[row], scene.cameras.reasons[row]
        yield Hint(text=f"{shortened(name)} is not placed: {shortened(reason)}", camera=row)
    if len(rows) > _SHOWN:
        yield Hint(text=f"{len(rows) - _SHOWN:,} more are not placed; the table of cameras says why")


def _least_trusted(scene: Scene) -> Iterator[Hint]:
    trust = np.where(scene.cameras.placed, scene.cameras.trust, np.nan)
    low = np.flatnonzero(trust < _LOW_TRUST)
    for row in low[np.argsort(trust[low], kind="stable")][:_SHOWN].tolist():
        reason = shortened(scene.cameras.reasons[row] or "its pairs speak against it")
        yield Hint(
            text=f"{shortened(scene.cameras.names[row])} has trust {trust[row]:.2f}: {reason}", camera=row
        )


def _contradictions(scene: Scene) -> Iterator[Hint]:
    """Yield the contradicting pairs with most matches: repeated structure, or wrong rotations.

    Those that are off by little, if by more than the others, come together in a sentence.
    """
    pairs = scene.pairs
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
        first, second = (shortened(scene.cameras.names[k], 60) for k in pairs.cameras[row].tolist())
        matches = f" with {pairs.support[row]:,} matches" if pairs.support[row] else ""
        yield Hint(
            text=f"{first} to {second}{matches} contradicts the solution "
            f"by {pairs.residuals_deg[row]:.3g} degrees",
            pair=row,
        )


def _loose(facts: dict[str, Any]) -> Iterator[Hint]:
    for group in facts["loose_groups"][:_SHOWN]:
        names = ", ".join(shortened(name, 40) for name in group["cameras"][:_SHOWN])
        more = f" and {len(group['cameras']) - _SHOWN:,} more" if len(group["cameras"]) > _SHOWN else ""
        yield Hint(text=f"{names}{more}: loose, {shortened(group['cause'])}")


def _unchecked(scene: Scene) -> Iterator[Hint]:
    count = int(np.sum(scene.pairs.classes == PairClass.UNDETERMINED))
    if count:
        what = "1 pair" if count == 1 else f"{count:,} pairs"
        yield Hint(text=f"{what} cannot be judged: unchecked by others, or in a piece that is not solved")
