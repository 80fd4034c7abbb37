"""Errors of cameras and points that an adjustment has found, as draws, and those of distances between them.

An adjustment gives draws of the errors of its frames (`shared_errors`): noise, rotations and calibration
together, and what two cameras share of these in both of them. A point that these cameras see errs with them:
it goes where its pixels miss least, and by the noise of its own pixels beside. With the derivatives J of the
pixels by the point, and q_s what draw s of the frames does to the pixels,

    draw s of a point = -V^-1 J^T q_s,        by itself noise_px^2 V^-1,        V = J^T J.

A distance d of two places along the unit vector u has the draws u^T (x_2s - x_1s), which do not depend on the
gauge but for the scale: where that is measured, see `Distances.in_scale`.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import mean_rotation_l1, median_spread, normalized, tangent_bases
from sfm_shapefit.scene.images import Images


class ScaleErrors(NamedTuple):
    """Relative errors of a scale."""

    draws: FloatArray
    """(s,) beside the draws of what it is the scale of."""
    sigma: float
    """Standard deviation of the others."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Distances:
    """Vectors from one place to another, and their errors."""

    vectors: FloatArray
    """(m, 3)"""
    draws: FloatArray
    """(m, 3, s) errors of the vectors that others share."""
    own: FloatArray
    """(m, 3, 3) covariances of their other errors."""

    @property
    def lengths(self) -> FloatArray:
        """Distances, (m,)."""
        return np.asarray(np.linalg.norm(self.vectors, axis=1))

    @property
    def length_draws(self) -> FloatArray:
        """Errors of the distances that others share, (m, s)."""
        return np.asarray(np.einsum("ma,mas->ms", normalized(self.vectors), self.draws))

    @property
    def length_variances(self) -> FloatArray:
        """Variances of the other errors of the distances, (m,)."""
        along = normalized(self.vectors)
        return np.asarray(np.einsum("ma,mab,mb->m", along, self.own, along))

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations of the distances, (m,)."""
        return np.asarray(np.sqrt(np.sum(self.length_draws**2, axis=1) + self.length_variances))

    @property
    def covariances(self) -> FloatArray:
        """Covariances of the vectors, (m, 3, 3)."""
        return np.asarray(self.draws @ self.draws.transpose(0, 2, 1) + self.own)

    def in_scale(self, errors: ScaleErrors, scale: float = 1.0) -> "Distances":
        """Return the vectors, some times as long, with the errors of that scale."""
        vectors = scale * self.vectors
        draws = np.concatenate([scale * self.draws, np.zeros((*self.vectors.shape, 1))], axis=2)
        return Distances(
            vectors=vectors,
            draws=draws + vectors[:, :, None] * np.append(errors.draws, errors.sigma),
            own=scale**2 * self.own,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlaceErrors:
    """Places, and their errors."""

    places: FloatArray
    """(k, 3)"""
    draws: FloatArray
    """(k, 3, s) errors of which the sum over s of products is the covariance of any two places."""
    own: FloatArray
    """(k, 3, 3) covariances of what each errs by itself."""

    def apart(self, ends: IntArray) -> Distances:
        """Return the vectors from place to place, by their rows (m, 2)."""
        first, second = ends.T
        return Distances(
            vectors=self.places[second] - self.places[first],
            draws=self.draws[second] - self.draws[first],
            own=self.own[first] + self.own[second],
        )

    def followed_by(self, others: "PlaceErrors") -> "PlaceErrors":
        """Return these places, then others of the same draws."""
        names = ("places", "draws", "own")
        return PlaceErrors(**{x: np.concatenate([getattr(self, x), getattr(others, x)]) for x in names})


def draws_at(estimate: Estimate | None, images: Images) -> FloatArray:
    """Return the draws of an adjustment (f, 6, s) at the frames of images that a similarity has moved since.

    NaN for frames that it does not know; no draws, s = 0, where it knows no errors.
    """
    count = len(images.frames.ids)
    if estimate is None or estimate.draws is None:
        return np.zeros((count, 6, 0))
    before = estimate.images.frames
    _, now, then = np.intersect1d(images.frames.ids, before.ids, return_indices=True)
    draws = np.full((count, *estimate.draws.shape[1:]), np.nan)
    if len(now) < 2 or median_spread(before.centers[then]) == 0.0:
        return draws
    turns = images.frames.rotations[now].transpose(0, 2, 1) @ before.rotations[then]
    scale = median_spread(images.frames.centers[now]) / median_spread(before.centers[then])
    draws[now] = estimate.draws[then]
    draws[now, :3] = scale * mean_rotation_l1(turns) @ estimate.draws[then, :3]
    return draws


def errors_of_images(images: Images, draws: FloatArray) -> PlaceErrors:
    """Return the errors of the centers of images, by the draws of their frames (f, 6, s)."""
    sensors, frames = images.sensors, images.frame_of
    in_rig = -np.einsum("lba,lb->la", sensors.rotations, sensors.translations)[images.lens_of]
    levers = images.frames.rotations[frames].transpose(0, 2, 1) @ _crossing(in_rig)
    return PlaceErrors(
        places=images.centers,
        draws=draws[frames, :3] + levers @ draws[frames, 3:],
        own=np.zeros((images.num_images, 3, 3)),
    )


def errors_of_points(
    images: Images,
    draws: FloatArray,
    points: FloatArray,
    observations: tuple[IntArray, IntArray],
    noise_px: float,
) -> PlaceErrors:
    """Return the errors of points.

    Args:
        images: all posed. draws: of their frames, (f, 6, s).
        points: (k, 3)
        observations: point and image of each, (o,) and (o,).
        noise_px: standard deviation of their pixels along an axis.
    """
    finite: BoolArray = np.asarray(np.isfinite(draws).all(axis=(1, 2)))
    known = finite[images.frame_of[observations[1]]]
    seen, of = (rows[known] for rows in observations)
    by_point, by_turn = _differentiate(images, points[seen], of)
    pulls = by_turn @ draws[images.frame_of[of], 3:] - by_point @ draws[images.frame_of[of], :3]
    information, pulled = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3, draws.shape[2]))
    np.add.at(information, seen, by_point.transpose(0, 2, 1) @ by_point)
    np.add.at(pulled, seen, by_point.transpose(0, 2, 1) @ pulls)
    inverses = np.full_like(information, np.nan)
    enough = np.flatnonzero(np.bincount(seen, minlength=len(points)) > 1)
    inverses[enough] = np.linalg.pinv(information[enough], hermitian=True)
    return PlaceErrors(places=points, draws=-inverses @ pulled, own=noise_px**2 * inverses)


def _differentiate(images: Images, points: FloatArray, of: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of pixels by points (o, 3), and by turns of the frames, (o, 2, 3) each.

    In a plane before a camera, where its lens has one; else on a sphere round it, in pixels per radian.
    """
    rotations, frames = images.rotations[of], images.frame_of[of]
    x = np.einsum("oab,ob->oa", rotations, points - images.centers[of])
    is_plane = np.array([lens.is_plane for lens in images.lenses], dtype=np.bool_)[images.lens_of[of]]
    depths = np.where(is_plane & (x[:, 2] > 0.0), x[:, 2], np.nan)
    onto = np.zeros((len(of), 2, 3))
    onto[:, 0, 0] = onto[:, 1, 1] = 1.0
    onto[:, :, 2] = -x[:, :2] / depths[:, None]
    distances = np.linalg.norm(x, axis=1)
    is_round = np.isnan(depths)
    onto[is_round] = tangent_bases(x[is_round] / distances[is_round, None]).transpose(0, 2, 1)
    onto *= (images.focal_lengths_px[of] / np.where(is_round, distances, depths))[:, None, None]
    from_frame = np.einsum(
        "oab,ob->oa", images.frames.rotations[frames], points - images.frames.centers[frames]
    )
    by_turn = -onto @ images.sensors.rotations[images.lens_of[of]] @ _crossing(from_frame)
    return onto @ rotations, by_turn


def _crossing(vectors: FloatArray) -> FloatArray:
    """Return the matrices (k, 3, 3) that multiply by vectors (k, 3) as the vector product does."""
    return np.asarray(np.cross(vectors[:, None, :], np.eye(3)).transpose(0, 2, 1))
