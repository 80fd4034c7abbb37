"""What is known of the direction of each pair."""

import enum
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray


class DirectionStatus(enum.Enum):
    """Why a pair has, or has not, a direction; the value is what reports say of it."""

    USABLE = "usable"
    TOO_FEW_MATCHES = "too few matches"
    FEW_INLIERS = "too few inlier matches in front of both cameras"
    LOW_INLIER_RATIO = "most matches contradict the rotations"
    NO_PARALLAX = "no parallax: the matches do not determine the direction"
    TWO_MOTIONS = "the matches agree on two different directions"
    AMBIGUOUS_SIGN = "points are in front of the cameras whichever way the direction points"


# Good rotations leave so much in any direction; matches that promise more are no better.
_FLOOR_DEG = 0.05
# This least weight keeps the program well conditioned; a camera may have nothing better.
_MIN_WEIGHT = 0.02


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairDirections:
    """Directions of k image pairs and the evidence for each; rows without a direction hold NaN."""

    pairs: IntArray
    """(k, 2) camera indices i < j."""
    directions: FloatArray
    """(k, 3) unit directions of C_i - C_j in world axes."""
    status: Sequence[DirectionStatus]
    """k values; only USABLE rows have a direction."""
    num_matches: IntArray
    """(k,) matches the pair came with."""
    num_inliers: IntArray
    """(k,) matches whose Sampson error is below the inlier threshold."""
    num_rivals: IntArray
    """(k,) matches off the direction that agree on another one, in front of both cameras."""
    cheirality_fraction: FloatArray
    """(k,) share of the inliers with parallax whose point lies in front of both cameras."""
    median_residual_px: FloatArray
    """(k,) median Sampson error of the inliers."""
    parallax_deg: FloatArray
    """(k,) median angle between the two rays of an inlier."""
    covariance: FloatArray
    """(k, 2, 2) covariance of the direction in rad^2, in the basis `tangent_bases(directions)`."""

    def subset(self, rows: IntArray) -> "PairDirections":
        """Return some rows, in the order given."""
        columns: dict[str, Any] = {name: getattr(self, name)[rows] for name in _ARRAYS}
        return PairDirections(status=[self.status[row] for row in rows.tolist()], **columns)

    def usable(self) -> IntArray:
        """Return the rows that have a direction."""
        return np.flatnonzero(is_usable(self.status))

    def contradicting(self) -> IntArray:
        """Return the rows whose matches speak against the given rotations."""
        return np.flatnonzero([value is DirectionStatus.LOW_INLIER_RATIO for value in self.status])

    def counts(self) -> dict[DirectionStatus, int]:
        """Return how many pairs have each status, most frequent first."""
        status = list(self.status)
        met = sorted(filter(status.__contains__, DirectionStatus), key=status.index)
        return {one: status.count(one) for one in sorted(met, key=status.count, reverse=True)}

    def sigma_deg(self) -> FloatArray:
        """Return the standard deviation along each direction's least certain axis, shape (k,)."""
        largest = np.linalg.eigvalsh(np.nan_to_num(self.covariance))[:, -1]
        missing = np.isnan(self.covariance).any(axis=(1, 2))
        return np.where(missing, np.nan, np.degrees(np.sqrt(np.maximum(largest, 0.0))))

    def weights(self) -> FloatArray:
        """Return what each pair counts in the program, with median 1 over the usable ones, shape (k,).

        w = ratio^2 / sqrt(1 + (sigma / 0.05 deg)^2), not below 0.02 of the median: ratio is the share of the
        matches that are inliers, sigma the largest standard deviation of the direction. NaN where there is
        no direction.
        """
        usable = self.usable()
        sigmas_deg = self.sigma_deg()[usable]
        ratios = self.num_inliers[usable] / np.maximum(self.num_matches[usable], 1)
        relative = ratios**2 / np.sqrt(1.0 + (sigmas_deg / _FLOOR_DEG) ** 2)
        weights = np.full(len(self.pairs), np.nan)
        if len(usable):
            weights[usable] = np.maximum(relative / np.median(relative), _MIN_WEIGHT)
        return weights


_ARRAYS = tuple(item.name for item in fields(PairDirections) if item.name != "status")


def first_reasons(*rules: tuple[BoolArray, DirectionStatus]) -> list[DirectionStatus]:
    """Return for each pair the status of the first of the rules (k,) that fires, or USABLE."""
    status = np.full(len(rules[0][0]), DirectionStatus.USABLE, dtype=object)
    for fired, reason in reversed(rules):
        status[fired] = reason
    return list(status)


def is_usable(status: Sequence[DirectionStatus]) -> BoolArray:
    """Return which pairs have a direction, (k,)."""
    return np.array([value is DirectionStatus.USABLE for value in status], dtype=np.bool_)


def concatenate(parts: Sequence[PairDirections]) -> PairDirections:
    """Return the rows of all parts, in order; ValueError if there are none."""
    names = (field.name for field in fields(PairDirections))
    columns: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts]) for name in names}
    return PairDirections(**{**columns, "status": list(columns["status"])})
