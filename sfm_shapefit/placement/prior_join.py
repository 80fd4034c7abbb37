"""Two models joined by position priors that cameras of both have.

From a robust fit of each model to its priors comes the similarity between their worlds; its standard
deviations are those of a jackknife, which leaves out one prior after the other:

    variance = (m - 1) / m sum_i (theta_i - theta)^2        (Efron, Stein 1981, "The jackknife")
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import (
    Similarity,
    compose,
    fit_similarity,
    invert,
    median_spread,
    rotation_angles_deg,
)
from sfm_shapefit.base.wording import counted
from sfm_shapefit.placement.gauge import fit_to_priors, prior_gauge
from sfm_shapefit.placement.join import FEWEST_PAIRS, UNTIED, PieceJoin, uncertainty
from sfm_shapefit.scene.given import PositionPriors

_MOST_FITS = 12  # groups by which priors are left out; each is a fit of its own


class PlacedByPriors(NamedTuple):
    """A model on the position priors of its cameras, and how well it stands there."""

    centers: FloatArray
    """(n, 3) centers of its cameras, in its world."""
    priors_from_model: Similarity
    parts: tuple[Similarity, ...]
    """The same without some of the priors in turn."""
    num_priors: int


def place_by_priors(centers: FloatArray, priors: PositionPriors) -> PlacedByPriors:
    """Return a model, cameras at `centers` (n, 3), on their position priors, for `join_by_priors`.

    UnsolvableError, whose message is the reason, a clause, if they are few, lie on a line, or do not fit.
    """
    if len(priors) <= FEWEST_PAIRS:
        raise UnsolvableError(
            f"one of them has {counted(len(priors), 'position prior')}, and a join needs "
            f"{FEWEST_PAIRS + 1} in each"
        )
    try:
        gauge = prior_gauge(centers, priors, axes_known=False)
    except InputError as error:
        raise UnsolvableError(str(error)) from error
    if gauge.warning or gauge.axes is None:
        raise UnsolvableError(gauge.warning)
    source, target = centers[priors.known.indices], priors.known.positions
    best, weights, _ = fit_to_priors(source, priors)
    every = np.arange(len(target))
    count = min(len(target), _MOST_FITS)
    parts = [fit_similarity(source, target, weights * (every % count != k)) for k in range(count)]
    return PlacedByPriors(centers, best, tuple(parts), len(priors))


def join_by_priors(first: tuple[int, PlacedByPriors], second: tuple[int, PlacedByPriors]) -> PieceJoin:
    """Return the join of a second piece, by its number, to a first one, by position priors of both.

    UnsolvableError, the reason, if it is too uncertain.
    """
    (to, one), (piece, other) = first, second
    best = _chain(one.priors_from_model, other.priors_from_model)
    scale, turn, place = 0.0, 0.0, np.zeros(len(other.centers))
    for parts in (
        [_chain(part, other.priors_from_model) for part in one.parts],
        [_chain(one.priors_from_model, part) for part in other.parts],
    ):
        share = (len(parts) - 1) / len(parts)
        for fit in parts:
            scale += share * np.log(fit.scale / best.scale) ** 2
            turn += share * float(rotation_angles_deg(fit.rotation @ best.rotation.T)) ** 2
            place += share * np.sum((fit.apply(other.centers) - best.apply(other.centers)) ** 2, axis=1)
    center_sigma = float(np.sqrt(np.median(place)))
    sigmas = float(np.sqrt(scale)), float(np.sqrt(turn))
    if reason := uncertainty(*sigmas, center_sigma / (best.scale * median_spread(other.centers))):
        raise UnsolvableError(reason)
    return PieceJoin(
        piece=piece,
        to=to,
        to_from_piece=best,
        scale_sigma=sigmas[0],
        turn_sigma_deg=sigmas[1],
        center_sigma=center_sigma,
        evidence=f"position priors of {one.num_priors} and {other.num_priors} cameras",
    )


def _chain(priors_from_first: Similarity, priors_from_second: Similarity) -> Similarity:
    return compose(invert(priors_from_first), priors_from_second)


def try_priors(centers: FloatArray, priors: PositionPriors | None) -> PlacedByPriors | str:
    """Return a piece on the position priors of its cameras, or why it is not placed by them."""
    try:
        return UNTIED if priors is None else place_by_priors(centers, priors)
    except UnsolvableError as error:
        return str(error)


def join_to_earlier(number: int, placed: Sequence[PlacedByPriors | str]) -> PieceJoin | str:
    """Return the join of a piece to the first of the earlier ones that priors allow, or why there is none."""
    piece, reasons = placed[number], list[str]()
    for to, other in enumerate(placed[:number]):
        if isinstance(piece, str) or isinstance(other, str):
            reasons.append(piece if isinstance(piece, str) else str(other))
            continue
        try:
            return join_by_priors((to, other), (number, piece))
        except UnsolvableError as error:
            reasons.append(str(error))
    return next((reason for reason in reasons if reason != UNTIED), UNTIED)
