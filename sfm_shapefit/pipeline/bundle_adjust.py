"""`bundle_adjust`: poses and points of a model adjusted by its own observations; for pipelines."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sfm_shapefit.adjustment.covariance import FrameCovariances, estimate_covariances
from sfm_shapefit.adjustment.freedom import GivenPoses
from sfm_shapefit.adjustment.options import AdjustmentOptions
from sfm_shapefit.adjustment.problem import RotationPrior, isotropic_information
from sfm_shapefit.adjustment.solve import Adjusted, adjust
from sfm_shapefit.adjustment.sources import collect_tracks
from sfm_shapefit.adjustment.views import views_of
from sfm_shapefit.base.display import Displayed
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.files.colmap.images import images_of
from sfm_shapefit.files.colmap.model_arrays import ModelArrays
from sfm_shapefit.files.colmap.points import ModelPictures, points2d_of, points_of
from sfm_shapefit.files.colmap.reconstructions import arrays_of, moved_reconstruction
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.links import ObservedTracks
from sfm_shapefit.tracks.triangulation import TriangulatedPoints

if TYPE_CHECKING:
    import pycolmap

    from sfm_shapefit.files.colmap.model import HoldsModel


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class AdjustedModel(Displayed):
    """A model after bundle adjustment, and how it went."""

    reconstruction: "pycolmap.Reconstruction"
    """A new one: ids, names and tracks are the input's, errors of points are updated."""
    frame_ids: tuple[int, ...]
    """Ids of the frames with a pose, in the order of the problem and of the covariances."""
    adjusted: Adjusted
    """The answer as arrays: costs, iterations, why it ended."""
    covariances: FrameCovariances | None
    """Covariances of the frames' centers and rotations, if they were asked for."""

    def summary(self) -> dict[str, Any]:
        """Return the main figures in plain values."""
        return self.adjusted.summary()

    def _headline(self) -> str:
        return f"{len(self.frame_ids)} frames adjusted"


def bundle_adjust(
    reconstruction: "pycolmap.Reconstruction | HoldsModel",
    options: AdjustmentOptions | None = None,
    *,
    rotation_sigma_deg: float | None = None,
    fixed_frames: Collection[int] = (),
    covariances: bool = False,
    **overrides: Any,
) -> AdjustedModel:
    """Adjust poses and points of a model, from where they are, by the points that its images observe.

        adjusted = bundle_adjust(model)                                  # all free, Cauchy loss of 1 px
        adjusted = bundle_adjust(model, hold_rotations=True)             # rotations that were measured
        adjusted = bundle_adjust(model, rotation_sigma_deg=0.03)         # or pulled to, so far

    Unlike `locate(..., adjust="full")`, nothing is triangulated or filtered here. Rigs hold their
    sensors. Lenses of all models but EQUIRECTANGULAR may be free.

    Args:
        reconstruction: the start, or a result that has it; it is not changed.
        options: settings, see `help(AdjustmentOptions)`; defaults if None.
        rotation_sigma_deg: standard deviation, about each axis, of the rotations that the model has; they
            pull by it. None: they do not.
        fixed_frames: ids of frames whose poses stay what they are to the last bit.
        covariances: whether those of the frames are computed, too.
        **overrides: single options by name.

    Raises:
        InputError: if no posed image observes a point, or a number is impossible.
    """
    options = merge_options(options, AdjustmentOptions, overrides)
    model = reconstruction.reconstruction if hasattr(reconstruction, "reconstruction") else reconstruction
    read, _ = arrays_of(model)
    images, points, tracks = read_bundle(read)
    has_ray = np.isfinite(tracks.on_plane).all(axis=1)
    seen = np.where(has_ray, points.points_seen(), -1)
    triangulated = TriangulatedPoints(
        points=points.xyz, tracks=np.arange(points.num_points), points_seen=seen
    )
    views, given = views_of(images), GivenPoses(fixed=np.isin(images.frames.ids, sorted(fixed_frames)))
    problem = views.problem(images, np.zeros(len(images.lenses), np.bool_), given, tracks, triangulated)
    if rotation_sigma_deg is not None:
        sigmas = np.full(problem.num_frames, np.radians(rotation_sigma_deg))
        prior = RotationPrior(rotations=problem.rotations, information=isotropic_information(sigmas))
        problem = replace(problem, rotation_prior=prior)
    adjusted = adjust(problem, options)
    solved = adjusted.problem
    moved = views.images_of(images, solved), replace(points, xyz=solved.points)
    return AdjustedModel(
        reconstruction=moved_reconstruction(read, *moved),
        frame_ids=tuple(images.frames.ids.tolist()),
        adjusted=adjusted,
        covariances=estimate_covariances(solved, options) if covariances else None,
    )


def read_bundle(model: ModelArrays) -> tuple[Images, Points, ObservedTracks]:
    """Return the posed images of a model in the order of their ids, its points, and the tracks of these."""
    every = images_of(model)
    images = every.part(np.flatnonzero(every.is_posed))
    images = images.part(np.argsort(images.ids))
    points = points_of(model, images)
    return (
        images,
        points,
        collect_tracks(images, ModelPictures(images, points2d_of(model, images)), points),
    )
