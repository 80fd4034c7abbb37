"""What is adjusted: poses, lenses, points and the pixels at which cameras saw them, as plain arrays.

A frame is a body with a pose of its own: a camera, or a rig of several. A camera belongs to a frame and looks
through a lens, which it may share. A point X of the world has, in a camera of frame f, the coordinates

    x = R_s R_f (X - C_f) + t_s,        (R_s, t_s) = sensor_from_rig, the identity without a rig.

Where a sensor is free, its center -R_s^T t_s and its rotation in the rig are unknowns that all its images
share.

Lens models and the order of their parameters are COLMAP's; which there are stands in `scene.lens`, their
projections there and in `scene.wide_lenses`. Focal lengths may be free, and the first four coefficients.

An observation through any other lens is given undistorted: undo the distortion once, and pass focal length
times ray as the pixel of a PINHOLE lens with that focal length and principal point 0. Its residuals are then
those of an ideal camera, not exactly pixels of the image.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IndexArray, IntArray, distinct
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.scene.known_positions import KnownPositions
from sfm_shapefit.scene.lens import NUM_VALUES, Lens

_OBSERVED = ("cameras_seeing", "points_seen")
_ORTHONORMAL = 1e-6  # largest entry of R R^T - I; six printed digits leave less


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rig:
    """Cameras that move together: which frame each belongs to and where in it."""

    frame_of_camera: IntArray
    """(c,)"""
    rotations: FloatArray
    """Rotations (c, 3, 3) of sensor_from_rig."""
    translations: FloatArray
    """Translations (c, 3) of sensor_from_rig, in units of the world."""
    free_sensor_of_camera: IntArray
    """(c,) number of the sensor that each camera is, from 0, if its pose in the rig is unknown; -1 if it
    stays, as that of a reference has to."""

    @classmethod
    def of_single_cameras(cls, count: int) -> "Rig":
        """Return frames of one camera each."""
        return cls(
            frame_of_camera=np.arange(count),
            rotations=np.tile(np.eye(3), (count, 1, 1)),
            translations=np.zeros((count, 3)),
            free_sensor_of_camera=np.full(count, -1),
        )

    def resized(self, translations: FloatArray, size: float) -> FloatArray:
        """Return translations (c, 3) of all sensors, those of free ones longer by a factor."""
        return np.where(self.free_sensor_of_camera[:, None] >= 0, size * translations, translations)

    def mean_baseline(self, translations: FloatArray) -> float:
        """Return the free sensors' mean distance from the origins of their rigs, by translations (c, 3)."""
        numbers, chosen = np.unique(self.free_sensor_of_camera, return_index=True)
        return float(np.linalg.norm(translations[chosen[numbers >= 0]], axis=1).mean())

    def sensor_centers(self) -> FloatArray:
        """Return where each camera stands in its rig, (c, 3)."""
        centers: FloatArray = -np.einsum("cba,cb->ca", self.rotations, self.translations)
        return centers


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RotationPrior:
    """Rotations measured otherwise: cost 1/2 noise_px^2 d^T Omega d with d = log(R_f R_prior^T)."""

    rotations: FloatArray
    """(n, 3, 3) cam_from_world (rig_from_world for a rig)."""
    information: FloatArray
    """(n, 3, 3) inverse covariances in rad^-2, in axes of the camera (the rig); 0 where there is no prior."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LensPrior:
    """Intrinsics known otherwise: cost 1/2 noise_px^2 sum_p Omega_p d_p^2 with d = p - p_prior.

    Parameters are the values of a lens, see `scene.lens`; where fx and fy are one, it counts once.
    """

    values: FloatArray
    """(l, 8)"""
    information: FloatArray
    """(l, 8) inverse variances; 0 where there is no prior."""


def isotropic_information(sigmas: FloatArray) -> FloatArray:
    """Return the information (n, 3, 3) of standard deviations (n,) per axis; infinite ones give 0."""
    return np.asarray(sigmas, dtype=np.float64)[:, None, None] ** -2.0 * np.eye(3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AdjustmentProblem:
    """Poses of n frames, k points, and m observations of points by cameras; checked when it is made.

    Raises:
        InputError: if shapes do not fit together, an index leaves its range, a number is not finite, or a
            rotation is none.
    """

    rotations: FloatArray
    """(n, 3, 3) cam_from_world (rig_from_world for a rig)."""
    centers: FloatArray
    """(n, 3) the origin of each frame in the world."""
    points: FloatArray
    """(k, 3)"""
    cameras_seeing: IndexArray
    """(m,) the camera of each observation."""
    points_seen: IndexArray
    """(m,) the point of each observation."""
    pixels: FloatArray
    """(m, 2) where it was seen."""
    lenses: Sequence[Lens]
    """What cameras look through."""
    lens_of_camera: IntArray
    """(c,)"""
    rig: Rig = field(default_factory=lambda: Rig.of_single_cameras(0))
    """Each frame is one camera, c = n, if it has none."""
    fixed: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))
    """(n,) frames whose pose stays what it is, to the last bit; none where it is made without."""
    rotation_prior: RotationPrior | None = None
    """Weighs rotations that are not held."""
    center_prior: KnownPositions | None = None
    """Centers of some frames, measured otherwise: cost 1/2 noise_px^2 chi2."""
    lens_prior: LensPrior | None = None
    """Weighs focal lengths and distortion that are not held."""

    def __post_init__(self) -> None:
        """Bring every array to its type and check it."""
        n = len(self.centers)
        if not len(self.rig.frame_of_camera):
            object.__setattr__(self, "rig", Rig.of_single_cameras(n))
        if not len(self.fixed):
            object.__setattr__(self, "fixed", np.zeros(n, np.bool_))
        self._take("centers", np.float64, (n, 3))
        self._take("rotations", np.float64, (n, 3, 3))
        self._take("points", np.float64, (len(self.points), 3))
        self._take("pixels", np.float64, (len(self.pixels), 2))
        self._take("lens_of_camera", np.int64, (len(self.lens_of_camera),))
        self._take("fixed", np.bool_, (n,))
        for name in _OBSERVED:
            kept = np.int32 if np.asarray(getattr(self, name)).dtype == np.int32 else np.int64
            self._take(name, kept, (len(self.pixels),))
        _check_rotations(self.rotations, "rotation")
        for lens in self.lenses:
            lens.refuse_impossible()
        _check_range(self.points_seen, self.num_points, "point")
        _check_range(self.lens_of_camera, len(self.lenses), "lens")
        self._check_rig()
        _check_range(self.cameras_seeing, self.num_cameras, "camera")
        for name in _OBSERVED:  # as there are very many, and in range
            object.__setattr__(self, name, getattr(self, name).astype(np.int32, copy=False))
        self._check_priors()

    @property
    def num_frames(self) -> int:
        """Number of poses, n."""
        return len(self.centers)

    @property
    def num_cameras(self) -> int:
        """Number of cameras, c."""
        return len(self.lens_of_camera)

    @property
    def num_points(self) -> int:
        """Number of points, k."""
        return len(self.points)

    @property
    def num_observations(self) -> int:
        """Number of observations, m."""
        return len(self.pixels)

    def frames_seeing(self) -> IntArray:
        """Return the frame of each observation, (m,)."""
        return self.rig.frame_of_camera[self.cameras_seeing]

    def priors_of_poses(self) -> Iterator[tuple[IntArray, FloatArray, slice]]:
        """Yield frames, information of their centers or rotations, and its slots among their unknowns."""
        if self.center_prior is not None:
            yield self.center_prior.indices, self.center_prior.information, slice(0, 3)
        if self.rotation_prior is not None:
            yield np.arange(self.num_frames), self.rotation_prior.information, slice(3, 6)

    def of_points(self, chosen: BoolArray) -> Self:
        """Return the problem of some points (k,) and what sees them; frames and cameras stay."""
        seen = chosen[self.points_seen]
        return replace(
            self,
            points=self.points[chosen],
            cameras_seeing=self.cameras_seeing[seen],
            points_seen=(np.cumsum(chosen) - 1)[self.points_seen[seen]],
            pixels=self.pixels[seen],
        )

    def _take(self, name: str, dtype: type, shape: tuple[int, ...]) -> None:
        """Store a field as a contiguous array of its type, or refuse it."""
        array: npt.NDArray[Any] = np.ascontiguousarray(getattr(self, name), dtype=dtype)
        if array.shape != shape:
            raise InputError(f"AdjustmentProblem.{name} has shape {array.shape}, it must be {shape}")
        if not np.isfinite(array).all():
            raise InputError(f"AdjustmentProblem.{name} holds a number that is not finite")
        object.__setattr__(self, name, array)

    def _check_rig(self) -> None:
        c = self.num_cameras
        shapes = tuple(np.shape(getattr(self.rig, one.name)) for one in fields(self.rig))
        if shapes != ((c,), (c, 3, 3), (c, 3), (c,)):
            raise InputError(
                f"the rig's arrays have shapes {shapes}, they must be ({c},), ({c}, 3, 3), ({c}, 3), ({c},)"
            )
        _check_range(self.rig.frame_of_camera, self.num_frames, "frame")
        _check_rotations(self.rig.rotations, "rotation of a sensor in its rig")
        if not np.isfinite(self.rig.translations).all():
            raise InputError("a translation of a sensor in its rig is not finite")

    def _check_priors(self) -> None:
        n = self.num_frames
        if self.rotation_prior is not None:
            if self.rotation_prior.rotations.shape != (n, 3, 3):
                raise InputError(f"the rotation prior must have {n} rotations")
            _check_rotations(self.rotation_prior.rotations, "rotation of the prior")
            _check_information(self.rotation_prior.information, n, "rotation")
        if self.center_prior is not None:
            frames, centers, information = self.center_prior
            k = len(frames)
            _check_range(frames, n, "frame of the center prior's")
            if len(distinct(frames)) < k or centers.shape != (k, 3) or not np.isfinite(centers).all():
                raise InputError(f"the center prior must have {k} finite centers, each of its own frame")
            _check_information(information, k, "center")
        if self.lens_prior is not None:
            shape = (len(self.lenses), NUM_VALUES)
            values, information = self.lens_prior.values, self.lens_prior.information
            sound = values.shape == information.shape == shape and np.isfinite([values, information]).all()
            if not sound or (information < 0.0).any():
                raise InputError(
                    f"the lens prior must have {shape[0]} x {shape[1]} finite values and information >= 0"
                )


def _check_range(indices: IndexArray, size: int, what: str) -> None:
    if indices.size and (indices.min() < 0 or indices.max() >= size):
        raise InputError(f"a {what} index leaves 0..{size - 1}")


def _check_rotations(rotations: FloatArray, what: str) -> None:
    gram = rotations @ rotations.transpose(0, 2, 1)
    right = (
        np.abs(gram - np.eye(3)).max(initial=0.0) <= _ORTHONORMAL and (np.linalg.det(rotations) > 0.0).all()
    )
    if not right:  # NaN fails too
        raise InputError(f"a {what} is not orthonormal with determinant 1")


def _check_information(information: FloatArray, n: int, what: str) -> None:
    if information.shape != (n, 3, 3) or not np.isfinite(information).all():
        raise InputError(f"the information of the {what} prior must be {n} finite 3 x 3 matrices")
    scale = np.abs(information).max(axis=(1, 2))
    uneven = np.abs(information - information.transpose(0, 2, 1)).max(axis=(1, 2))
    if (uneven > 1e-9 * scale).any() or (np.linalg.eigvalsh(information)[:, 0] < -1e-9 * scale).any():
        raise InputError(f"the information of the {what} prior must be symmetric and positive semidefinite")
