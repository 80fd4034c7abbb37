"""From placed cameras to seeded models: poses, points, colors, and bundle adjustment if asked for."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sfm_shapefit.adjustment.bundle_adjustment import adjust_seed
from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.freedom import Freedom, GivenPoses
from sfm_shapefit.adjustment.sources import Links, collect_matches, collect_tracks
from sfm_shapefit.adjustment.structure import triangulate
from sfm_shapefit.base.arrays import BoolArray, IntArray, hand_back_memory
from sfm_shapefit.base.executors import Advance
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.facts.options import PlacingOptions
from sfm_shapefit.files.colmap.model import PosedModel
from sfm_shapefit.files.colmap.own_tracks import TrackRules, triangulate_own_tracks
from sfm_shapefit.files.colmap.point_colors import PointColors, color_points
from sfm_shapefit.files.colmap.points import ModelPictures, add_points, points_of
from sfm_shapefit.files.colmap.seed import build_seed, transform_model, turn_model
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.judgement.support import (
    ObservationShares,
    count_observations,
    images_of_few_points,
    images_without_support,
)
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.pipeline.gauge_choice import GaugeRule, restore_axes
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.placement.gauge import Gauge, unit_gauge
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.placement.prior_refinement import PULLED
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.filter import filter_points
from sfm_shapefit.tracks.links import MatchedKeypoints

if TYPE_CHECKING:
    import pycolmap

# Fewer trusted cameras are no result.
_FEWEST_KEPT = 3


class Located(NamedTuple):
    """The cameras of a model that are in the output, and where."""

    placement: Placement
    kept: BoolArray
    """(k,) which of the placement's cameras are in the output."""
    gauge: Gauge
    """The map from the placement's locations to the output's units and axes."""
    fixed: BoolArray | None = None
    """(n,) the images that keep their poses to the last bit; none if None."""
    rule: GaugeRule | None = None
    """What sets the gauge, and again after bundle adjustment; "unit" if None."""
    given: GivenPoses = GivenPoses()
    """What is known of the frames of the model: the rotations of the input, and position priors that pull at
    the cameras and hold the gauge by that."""
    freedom: Freedom = Freedom()
    """Of the frames of the model."""

    @property
    def cameras(self) -> IntArray:
        """The images that are in the output, ascending."""
        return self.placement.cameras[self.kept]

    def fixed_images(self, model: PosedModel) -> BoolArray:
        """Return which images of the model (n,) keep their poses."""
        return np.zeros(model.num_images, np.bool_) if self.fixed is None else self.fixed

    def given_of(self, posed: "PosedPart", model: PosedModel) -> GivenPoses:
        """Return what is known of the frames of some posed images of the model."""
        return self.given._replace(fixed=self.fixed_frames(model)).of(posed.frames)

    def fixed_frames(self, model: PosedModel) -> BoolArray:
        """Return which frames of the model keep their poses, (f,)."""
        fixed = np.zeros(len(model.images.frames.ids), dtype=np.bool_)
        if self.fixed is not None:
            fixed[model.images.frame_of[self.fixed]] = True
        return fixed


class Seeded(NamedTuple):
    """A seeded model."""

    reconstruction: "pycolmap.Reconstruction"
    gauge: Gauge
    """From the solver's units to its own."""
    adjusted: Estimate | None
    """How bundle adjustment went, if it was asked for."""
    poor: dict[int, int]
    """By the id of each image that was left out because it sees too few points, or hardly any of those that
    its matches could make, their number."""
    unsupported: frozenset[int]
    """The ids of the latter; of least trust 0 they are not left out."""
    observations: ObservationShares
    """What of the keypoints matched in two other images sees a point, and what contradicts the cameras."""

    def moved(self, reconstruction: "pycolmap.Reconstruction", gauge: Gauge) -> "Seeded":
        """Return the same model in another gauge."""
        return self._replace(reconstruction=reconstruction, gauge=gauge)


def select_trusted(placement: Judged, min_trust: float) -> BoolArray:
    """Return which of the placed cameras are trusted enough; all, if hardly any is."""
    kept: BoolArray = placement.assessment.trust >= min_trust
    return kept if np.sum(kept) >= _FEWEST_KEPT else np.ones_like(kept)


def build_seeded_model(
    source: MatchSource,
    located: Located,
    options: PlacingOptions,
    clock: Clock,
    colors: PointColors | None = None,
) -> Seeded:
    """Move the cameras, triangulate points, and adjust both if asked for.

    Bundle adjustment is free to scale, shift and turn everything; the gauge is set again after it. Points
    from matches take the colors of the input's, if it had any. An executor shares out the tracks that are
    triangulated where nothing is adjusted.
    """
    model, gauge, view = source.model, located.gauge, source.view
    images, points, adjusted = _make_points(source, located, options, clock)
    hand_back_memory()  # of the links, before their matches are read again
    fixed = located.fixed_frames(model)
    seen = images_of_few_points(points, images, options.structure.min_points_per_image, fixed)
    images, points = _leave_out(seen >= 0, images, points)
    unsupported, shares = np.zeros(len(seen), dtype=np.bool_), ObservationShares(math.nan, math.nan)
    if source.has_database:
        limit_px = options.structure.max_reprojection_error_px
        counts = count_observations(
            points, images, view.num_keypoints, view.batches(), model.rotations, limit_px
        )
        unsupported = images_without_support(counts, images, fixed)
        if options.trust.min_trust > 0.0:
            seen = np.where(unsupported, points.count_seen(len(seen)), seen)
            images, points = _leave_out(unsupported, images, points)
        shares = counts.shares(images.is_posed)
    with clock("colors"):
        seeded = build_seed(model, images, view.keypoints if source.has_database else None)
        add_points(seeded, images, points, None if source.has_database else model.reconstruction)
        if source.has_database and colors is not None:  # points of own tracks have theirs already
            seeded = color_points(seeded, colors, in_place=True)
    located = located._replace(kept=located.kept & images.is_posed[located.placement.cameras])
    if (adjusted is not None or (seen >= 0).any()) and located.given.centers is None:
        seeded, gauge = _set_gauge(seeded, model, located)
    elif gauge.axes is not None:
        seeded = turn_model(seeded, gauge.axes)
    poor = {int(images.ids[k]): int(seen[k]) for k in np.flatnonzero(seen >= 0)}
    return Seeded(seeded, gauge, adjusted, poor, frozenset(images.ids[unsupported].tolist()), shares)


def _make_points(
    source: MatchSource, located: Located, options: PlacingOptions, clock: Clock
) -> tuple[Images, Points, Estimate | None]:
    """Return the images of the model with points, filtered, and how bundle adjustment went, if asked for."""
    model, adjusted, links, advance = source.model, None, None, clock.advance
    images = pose_images(model, located)
    posed = posed_part(images)
    own, adjusts = not source.has_database, options.freedom.adjust == "full"
    with clock("structure"):
        if adjusts or not own:
            links = read_links(source, located, posed, advance)
    with clock("bundle adjustment" if adjusts else "triangulation"):
        if adjusts:  # which triangulates at the poses of the start itself
            assert links is not None
            freedom, given = located.freedom.of(posed.frames), located.given_of(posed, model)
            adjusted, points = adjust_seed(posed.images, links, options.structure, freedom, given)
            posed, images = posed._replace(images=adjusted.images), images.updated(adjusted.images)
        elif own:
            limits = options.structure
            rules = TrackRules(
                limits.max_reprojection_error_px, limits.min_triangulation_angle_deg, limits.min_track_length
            )
            points = triangulate_own_tracks(
                model.reconstruction, posed.images, rules, advance, clock.executor
            )
        else:
            assert isinstance(links, MatchedKeypoints)
            points = triangulate(posed.images, links, options.structure, advance, clock.executor)
        del links
        points = filter_points(points, posed.images, pictures_of(source, posed), options.structure)
    if adjusted is not None:
        assert points.errors_px is not None
        adjusted = replace(adjusted, final_error_px=float(points.errors_px.mean()))
    return images, replace(points, images=posed.rows[points.images]), adjusted


def _leave_out(gone: BoolArray, images: Images, points: Points) -> tuple[Images, Points]:
    """Return the images without a pose of some (i,), and the points that the others see."""
    return images.without(gone), points.taken(points.paired(~gone[points.images]))


def _set_gauge(
    adjusted: "pycolmap.Reconstruction", model: PosedModel, located: Located
) -> "tuple[pycolmap.Reconstruction, Gauge]":
    """Return an adjusted model in the gauge that was chosen, found anew for its cameras, and that gauge.

    The axes of the input are those in which the rotations agree best with the input's. What fixed cameras
    hold of the gauge is held already.
    """
    fixed = located.fixed_images(model)
    unit = None if located.placement.unit is None else 1.0
    if fixed.any() and unit is not None:
        return adjusted, located.gauge
    images = [adjusted.image(i) for i in model.image_ids[located.cameras].tolist()]
    centers = np.array([image.projection_center() for image in images])
    turn = np.eye(3)
    if not fixed.any():
        rotations = np.array([image.cam_from_world().rotation.matrix() for image in images])
        turn = restore_axes(model, located.cameras, rotations)
    locations = centers @ turn.T
    if located.rule is None:
        found = unit_gauge(locations)
    else:
        found = located.rule.choose(located.cameras, locations, unit)
    axes = np.eye(3) if found.axes is None else found.axes
    scale, shift = found.similarity.scale, found.similarity.translation
    motion = Similarity(scale=scale, rotation=axes @ turn, translation=axes @ shift)
    answer = transform_model(adjusted, motion, model.frame_ids[fixed].tolist())
    before = located.gauge.similarity
    similarity = replace(
        before, scale=scale * before.scale, translation=scale * turn @ before.translation + shift
    )
    return answer, replace(found, similarity=similarity, statement=_state(located.gauge, found))


def _state(before: Gauge, after: Gauge) -> str:
    """Return the statement of a gauge that was found again, with what pulled the cameras before."""
    _, mark, pulled = before.statement.partition(PULLED)
    return f"{after.statement}{mark}{pulled}"


class PosedPart(NamedTuple):
    """The placed images of a model, in the order of their ids: that of the sums of an adjustment."""

    images: Images
    rows: IntArray
    """(i,) their rows in the model."""
    frames: IntArray
    """(f,) rows of their frames among those of the model."""


def pose_images(model: PosedModel, located: Located) -> Images:
    """Return the images of the model where they are placed, fixed ones as they were; NaN where neither."""
    locations = located.placement.locations[located.kept]
    placed = model.images.placed(located.cameras, located.gauge.similarity.apply(locations))
    fixed, frames = located.fixed_frames(model)[:, None], placed.frames
    return placed.posed(frames.rotations, np.where(fixed, model.images.frames.centers, frames.centers))


def posed_part(images: Images) -> PosedPart:
    """Return those of a model's images that have a pose."""
    rows = np.flatnonzero(images.is_posed)
    rows = rows[np.argsort(images.ids[rows])]
    return PosedPart(images.part(rows), rows, np.unique(images.frame_of[rows]))


def pictures_of(source: MatchSource, posed: PosedPart) -> ModelPictures:
    """Return the keypoints of placed images: those of the database, where it has any, and their lenses."""
    rows, view = posed.rows.tolist(), source.view
    keypoints = (lambda k: view.keypoints(rows[k])) if source.has_database else None
    return ModelPictures(source.model.reconstruction, posed.images, keypoints)


def read_links(source: MatchSource, located: Located, posed: PosedPart, advance: Advance) -> Links:
    """Return what joins the keypoints of placed images; all rays are forgotten.

    From here to the end of a triangulation, or an adjustment, most memory is needed.
    """
    model, placement, view = source.model, located.placement, source.view
    pictures = pictures_of(source, posed)
    # A further piece is small: read no more than it needs.
    among = placement.cameras if placement.piece else None
    links = view.links(without=placement.rejected_pairs, among=among, advance=advance, consume=True)
    if not source.has_database:  # the model has its tracks already
        return collect_tracks(posed.images, pictures, points_of(model.reconstruction, posed.images))
    place = np.full(model.num_images, -1)
    place[posed.rows] = np.arange(len(posed.rows))
    return collect_matches(posed.images, pictures, place, links, view.num_matches)
