"""Two arrangements of the same images, where a scene repeats itself: which one the matches speak for.

Averaged rotations follow most matches. Where a tower has the same side thrice, or a courtyard the same house,
the false pairs between them may be more than the true ones, and agree: the images are folded together. Folded
images that turn by little against one another would share nearly all that they see, and share only the
repeated thing. So with

    share_e      of a pair's overlap that is matched (`missing_matches`)
    usual_e      the 80 % quantile of the shares of the 81 pairs whose relative rotations turn most nearly as
                 much: what a right pair of this scene shares, even where most pairs are false
    evidence_e   (share_e / usual_e - 0.65) / 0.25, from -1 to 1: whether the pair is one of the right ones

the images are averaged over the pairs whose share is more than 0.5, ..., 0.9 of the usual one. An arrangement
has the evidence of all pairs that agree with it. Another one than that of all pairs is taken only if

    it has rotations for all images that the arrangement of all pairs has,
    a third more evidence, and
    half of the largest possible evidence for its own pairs, which are thus nearly all as they should be.

Rendered scenes with sides or houses alike, mean error of the rotations in degrees, cameras beyond 5 degrees:

    scene                           cameras   all pairs   taken       evidence of both
    tower, 3 of 8 sides                48      71, 25     .06, 0         76 -> 257
    tower, 4 of 8                      40      93, 35     6.8, 6         92 -> 160
    tower, 5 of 8                      40      82, 35     none          144 -> 166

Right rotations do not make all centers right: parts of some towers stand .3 to 1.5 m off against one another.
So no model of another arrangement is called good. On fifteen scenes that need none, none is taken. More
scenes: `scripts/results/notes.md#arrangements`.

Sources: missing correspondences as evidence are Zach, Irschara, Bischof's (CVPR 2008); choosing among whole
reconstructions by them, after the fact, is Heinly, Dunn, Frahm, "Correcting for duplicate scene structure in
sparse 3D reconstruction", ECCV 2014. Here it is done for rotations, before anything is placed.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, quantile
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import rotation_angles_deg
from sfm_shapefit.pairs.relative_rotations import AGREEMENT_DEG, RelativeRotations
from sfm_shapefit.rotations.averaged import AveragedRotations

_USUAL_QUANTILE, _NUM_ALIKE = 0.8, 81  # quantile of shares, and pairs that turn nearly as much; see above
_EVEN_SHARE, _SPREAD = 0.65, 0.25  # shares of the usual one; where a pair's evidence is 0, and 1 more
_LEAST_SHARES = (0.7, 0.5, 0.6, 0.8, 0.9)  # shares of the usual one that are tried; the likeliest first
_CLEARLY_MORE = 4.0 / 3.0  # evidence over that of all pairs; chosen on scripts/results/notes.md#arrangements
_LEAST_EVIDENCE = 0.5  # share of the largest evidence; chosen on scripts/results/notes.md#arrangements


class Arrangement(NamedTuple):
    """Rotations that explain some of the pairs."""

    averaged: AveragedRotations
    agree: BoolArray
    """(k,) which pairs do, of all."""
    evidence: float
    """Evidence of the pairs that agree."""

    @property
    def mean_evidence(self) -> float:
        """From -1 to 1."""
        return self.evidence / max(int(self.agree.sum()), 1)


class Chosen(NamedTuple):
    """The arrangement that is taken, and what speaks against it."""

    averaged: AveragedRotations
    refused: BoolArray
    """(k,) pairs that agree with the arrangement of all pairs, and not with this one."""
    rival: BoolArray
    """(k,) pairs that agree with another one that has more evidence than the arrangement taken, but not
    clearly, and not with it."""


def evidence_of(relative: RelativeRotations, shares: FloatArray) -> FloatArray:
    """Return how much the `matched_shares` speak for each pair being right, -1 to 1; 0 where unknown."""
    evidence, finite = np.zeros(len(shares)), np.flatnonzero(np.isfinite(shares))
    if len(finite) == 0:
        return evidence
    usual = _usual_shares(rotation_angles_deg(relative.rotations[finite]), shares[finite])
    compared = shares[finite] / np.maximum(usual, np.finfo(np.float64).tiny)
    evidence[finite] = np.clip((compared - _EVEN_SHARE) / _SPREAD, -1.0, 1.0)
    return evidence


def _usual_shares(angles_deg: FloatArray, shares: FloatArray) -> FloatArray:
    """Return a high quantile of the shares of pairs that turn nearly as much, (k,)."""
    order = np.argsort(angles_deg, kind="stable")
    width = min(_NUM_ALIKE, len(order))
    windows = np.lib.stride_tricks.sliding_window_view(shares[order], width)
    quantiles = quantile(windows.T, _USUAL_QUANTILE)
    first = np.clip(np.arange(len(order)) - width // 2, 0, len(quantiles) - 1)
    usual = np.empty(len(order))
    usual[order] = quantiles[first]
    return usual


def choose_arrangement(
    relative: RelativeRotations,
    evidence: FloatArray,
    averaged: AveragedRotations,
    average: Callable[[RelativeRotations], AveragedRotations],
) -> Chosen:
    """Return the rotations averaged by k pairs, or others that their evidence (k,) clearly speaks for.

    `average` returns the rotations by some of the pairs.
    """
    plain, best = _arrange(relative, evidence, averaged), None
    for least in _LEAST_SHARES:
        likely = evidence >= (least - _EVEN_SHARE) / _SPREAD
        try:
            other = _arrange(relative, evidence, average(relative.subset(likely)))
        except UnsolvableError:
            continue
        keeps_all = bool(np.all(other.averaged.registered | ~averaged.registered))
        if least == _LEAST_SHARES[0] and keeps_all and np.array_equal(other.agree, plain.agree):
            break  # the likely pairs tell the same as all pairs
        if keeps_all and other.mean_evidence >= _LEAST_EVIDENCE:
            best = other if best is None or other.evidence > best.evidence else best
    nothing = np.zeros(len(evidence), dtype=np.bool_)
    if best is None or best.evidence <= plain.evidence:
        return Chosen(averaged, nothing, nothing)
    if best.evidence >= _CLEARLY_MORE * plain.evidence:
        return Chosen(best.averaged, plain.agree & ~best.agree, nothing)
    return Chosen(averaged, nothing, best.agree & ~plain.agree)


def agreeing_pairs(relative: RelativeRotations, averaged: AveragedRotations) -> BoolArray:
    """Return which pairs agree with averaged rotations within 5 degrees, (k,)."""
    registered = averaged.registered[relative.pairs].all(axis=1)
    return np.asarray(registered & (relative.residuals_deg(averaged.rotations) <= AGREEMENT_DEG))


def _arrange(relative: RelativeRotations, evidence: FloatArray, averaged: AveragedRotations) -> Arrangement:
    """Return which pairs agree with averaged rotations, and what speaks for them."""
    agree = agreeing_pairs(relative, averaged)
    return Arrangement(averaged, agree, float(evidence[agree].sum()))
