"""Relative rotations of image pairs, how well each is known, and which of them to believe."""

from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import rotation_angles_deg

SOUND = 2.0
"""Least W ln n of a pair that is believed; W its mean robust weight, n its number of matches."""
_LEAST_WEIGHT_SHARE = 0.4  # W, a share; below it no number of matches makes a pair sound


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RelativeRotations:
    """The relative rotations of k pairs, each pair once, i < j."""

    pairs: IntArray
    """(k, 2) images (i, j)."""
    rotations: FloatArray
    """(k, 3, 3) cam_j_from_cam_i."""
    information: FloatArray
    """(k, 3, 3) inverse covariances in rad^-2 of w, where exp(w) times the true rotation is this one: w is in
    axes of camera j. The translation's share is eliminated."""
    num_matches: IntArray
    """(k,) n, the inlier matches of the database."""
    weight_shares: FloatArray
    """(k,) W, the mean robust weight of a pair's matches, in (0, 1]: how well one pose explains them."""
    translations: FloatArray | None = None
    """(k, 3) unit vectors in axes of camera j, with which the rotations were found; None where none was."""

    def subset(self, rows: IntArray | BoolArray) -> Self:
        """Return the given pairs, in that order; these themselves if all are chosen, for memory."""
        if rows.dtype == np.bool_ and rows.all():
            return self
        columns: dict[str, Any] = {
            field.name: getattr(self, field.name) for field in fields(RelativeRotations)
        }
        return replace(self, **{name: column[rows] for name, column in columns.items() if column is not None})

    def residuals_deg(self, rotations: FloatArray) -> FloatArray:
        """Return the angle between each pair's rotation and that of absolute rotations (n, 3, 3), (k,)."""
        i, j = self.pairs.T
        predicted = rotations[j] @ rotations[i].transpose(0, 2, 1)
        return rotation_angles_deg(self.rotations.transpose(0, 2, 1) @ predicted)

    def are_sound(self, least: float = SOUND) -> BoolArray:
        """Return which pairs to believe, (k,): W ln n >= least, and W >= 0.4."""
        soundness = self.weight_shares * np.log(np.maximum(self.num_matches, 1))
        return np.asarray((soundness >= least) & (self.weight_shares >= _LEAST_WEIGHT_SHARE))


AGREEMENT_DEG = 5.0
"""Degrees up to which a pair agrees with averaged rotations; right pairs are mostly within one."""
