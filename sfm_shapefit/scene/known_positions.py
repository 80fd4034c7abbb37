"""Where cameras are by another measurement, such as GPS: one type for every stage that is told of it."""

from typing import NamedTuple, Self

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, rows_taken


class KnownPositions(NamedTuple):
    """Measured positions of some of the cameras, nodes or frames that a stage works on."""

    indices: IntArray
    """(k,) whose they are, ascending without repetition: places among all, or ids of COLMAP."""
    positions: FloatArray
    """(k, d)"""
    information: FloatArray
    """(k, d, d) inverse covariances; NaN where they are not known."""

    @classmethod
    def measured(cls, indices: IntArray, positions: FloatArray, covariances: FloatArray) -> Self:
        """Return positions with their covariances (k, d, d), of which those that are none are not known."""
        finite = np.where(np.isfinite(covariances), covariances, 0.0)
        finite = 0.5 * (finite + finite.transpose(0, 2, 1))
        known = np.isfinite(covariances).all(axis=(1, 2))
        known &= np.linalg.eigvalsh(finite)[:, 0] > 0.0
        information = np.full(covariances.shape, np.nan)
        information[known] = np.linalg.inv(finite[known])
        return cls(indices, positions, information)

    def among(self, members: IntArray) -> Self:
        """Return those of some members (n,), ascending, numbered by their place among these."""
        _, rows, places = np.intersect1d(self.indices, members, assume_unique=True, return_indices=True)
        return rows_taken(self, rows)._replace(indices=places)

    def sigmas(self) -> FloatArray:
        """Return the standard deviation per axis, (k,), the mean of all axes; NaN where it is not known."""
        variances = np.trace(np.linalg.inv(self.information), axis1=1, axis2=2)
        return np.asarray(np.sqrt(variances / self.positions.shape[1]))

    def off(self, t: FloatArray) -> FloatArray:
        """Return how far the positions of all (n, d) are from those measured, (k, d)."""
        return np.asarray(t[self.indices] - self.positions)

    def chi2(self, t: FloatArray) -> FloatArray:
        """Return the same in standard deviations, squared, (k,)."""
        off = self.off(t)
        return np.asarray(np.einsum("ka,kab,kb->k", off, self.information, off))
