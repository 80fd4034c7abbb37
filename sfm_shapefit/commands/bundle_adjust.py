"""`bundle_adjust`: poses and points of a model adjusted by its own observations; for pipelines."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.covariance import FrameCovariances, estimate_covariances
from sfm_shapefit.adjustment.freedom import GivenPoses
from sfm_shapefit.adjustment.given_rotations import noise_px_of
from sfm_shapefit.adjustment.lengths import estimate_lengths
from sfm_shapefit.adjustment.problem import RotationPrior, isotropic_information
from sfm_shapefit.adjustment.solve import Adjusted, adjust
from sfm_shapefit.adjustment.views import views_of
from sfm_shapefit.base.display import Displayed
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.facts.lengths import WITHIN_95, within_95
from sfm_shapefit.files.colmap.model import ModelSource, read_model
from sfm_shapefit.files.colmap.reconstructions import moved_reconstruction
from sfm_shapefit.pipeline.bundle import read_bundle
from sfm_shapefit.tracks.triangulation import TriangulatedPoints

if TYPE_CHECKING:
    import pycolmap


class Length(NamedTuple):
    """A distance in units of the model."""

    value: float
    sigma: float
    """Its standard deviation."""

    @property
    def half_width(self) -> float:
        """Half the interval that holds the distance with a probability of 95 %."""
        return WITHIN_95 * self.sigma

    def __str__(self) -> str:
        return within_95(self.value, self.half_width)


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
    options: AdjustmentOptions
    """As it was adjusted with."""
    cameras: Mapping[str, int]
    """Camera of the problem that is each posed image, by its name."""
    points: Mapping[int, int]
    """Row of each point of the problem, by its id."""

    def length(self, first: str | int, second: str | int, *, scale_sigma: float = 0.0) -> "Length":
        """Return the distance between two images or points, and how well it is known.

            print(adjusted.length("0001.jpg", "0004.jpg"))          # 2.503 ± 0.004 (95 %)
            print(adjusted.length(17, 402, scale_sigma=0.001))      # between two 3D points

        The noise of the observations is read off their errors; wrong calibration and wrong pairs are not
        covered. Where nothing but the scene itself holds the scale, the distance is known relative to its
        size: `scale_sigma`, as of `found.facts`, is what is to be added.

        Args:
            first, second: names of images, whose centers are meant, or ids of 3D points.
            scale_sigma: relative standard deviation of the scale.

        Raises:
            InputError: if there is no such image or point.
            UnsolvableError: if the observations leave more open than a similarity.
        """
        solved = self.adjusted.problem
        ends = np.array([[self._row_of(first), self._row_of(second)]])
        options = replace(self.options, noise_px=noise_px_of(solved))
        (distance,), (sigma,) = (values.tolist() for values in estimate_lengths(solved, options, ends))
        return Length(distance, float(np.hypot(sigma, scale_sigma * distance)))

    def _row_of(self, end: str | int) -> int:
        known: Mapping[Any, int] = self.cameras if isinstance(end, str) else self.points
        if end not in known:
            what = "posed image" if isinstance(end, str) else "3D point that two images see"
            raise InputError(f"the model has no {what} {end}")
        return known[end] + (0 if isinstance(end, str) else len(self.adjusted.problem.rig.frame_of_camera))

    def summary(self) -> dict[str, Any]:
        """Return the main figures in plain values."""
        return self.adjusted.summary()

    def _headline(self) -> str:
        return f"{len(self.frame_ids)} frames adjusted"


def bundle_adjust(
    reconstruction: ModelSource,
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
        reconstruction: the start, a result that has it, or a model folder; it is not changed.
        options: settings, see `help(AdjustmentOptions)`; defaults if None.
        rotation_sigma_deg: standard deviation, about each axis, of the rotations that the model has; they
            pull by it. None: they do not.
        fixed_frames: ids of frames whose poses stay what they are to the last bit.
        covariances: whether those of the frames are computed, too.
        **overrides: single options by name.

    Raises:
        InputError: if the model cannot be used, no posed image observes a point, or a number is impossible.
    """
    options = merge_options(options, AdjustmentOptions, overrides)
    read = read_model(reconstruction).arrays
    images, points, tracks = read_bundle(read)
    triangulated = TriangulatedPoints.of_tracks(tracks, points.xyz)
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
        options=options,
        cameras={images.names[k]: int(np.searchsorted(views.images, k)) for k in range(len(images.names))},
        points=dict(zip(points.ids.tolist(), range(points.num_points), strict=True)),
    )
