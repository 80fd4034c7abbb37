"""From placed cameras to cameras with points, adjusted if asked for, in their gauge."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment.bundle_adjustment import adjust_seed
from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.freedom import Freedom, GivenPoses
from sfm_shapefit.adjustment.sources import Links, collect_matches, collect_tracks
from sfm_shapefit.adjustment.structure import triangulate
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, hand_back_memory
from sfm_shapefit.base.executors import Advance
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.facts.options import PlacingOptions
from sfm_shapefit.files.colmap.points import ModelPictures
from sfm_shapefit.files.colmap.track_matches import TrackMatches
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

    def fixed_images(self, images: Images) -> BoolArray:
        """Return which images of the model (n,) keep their poses."""
        return np.zeros(images.num_images, np.bool_) if self.fixed is None else self.fixed

    def given_of(self, posed: "PosedPart", images: Images) -> GivenPoses:
        """Return what is known of the frames of some posed images of the model."""
        return self.given._replace(fixed=self.fixed_frames(images)).of(posed.frames)

    def fixed_frames(self, images: Images) -> BoolArray:
        """Return which frames of the model keep their poses, (f,)."""
        fixed = np.zeros(len(images.frames.ids), dtype=np.bool_)
        if self.fixed is not None:
            fixed[images.frame_of[self.fixed]] = True
        return fixed


class Seeded(NamedTuple):
    """Placed cameras with their points."""

    images: Images
    """All of the input, NaN where they are not placed."""
    points: Points
    gauge: Gauge
    """From the solver's units to those of images and points."""
    fixed: BoolArray
    """(f,) frames that no motion moves."""
    adjusted: Estimate | None
    """How bundle adjustment went, if it was asked for."""
    num_seen: IntArray
    """(i,) points that an image saw which was left out because they are too few, or hardly any of those that
    its matches could make; -1 for all others."""
    unsupported: BoolArray
    """(i,) images hardly any of whose matches makes a point; of least trust 0 they are not left out."""
    observations: ObservationShares
    """Shares of keypoints matched in two other images that see a point, and that contradict the cameras."""

    def moved(self, motion: Similarity, gauge: Gauge) -> "Seeded":
        """Return the same after a similarity of the world, in the gauge that it leads to."""
        images, points = self.images.transformed(motion, self.fixed), self.points.transformed(motion)
        return self._replace(images=images, points=points, gauge=gauge)


def turn_about_origin(rotation: FloatArray) -> Similarity:
    """Return the motion that only turns the world."""
    return Similarity(scale=1.0, rotation=rotation, translation=np.zeros(3))


def select_trusted(placement: Judged, min_trust: float) -> BoolArray:
    """Return which of the placed cameras are trusted enough; all, if hardly any is."""
    kept: BoolArray = placement.assessment.trust >= min_trust
    return kept if np.sum(kept) >= _FEWEST_KEPT else np.ones_like(kept)


def seed_points(source: MatchSource, located: Located, options: PlacingOptions, clock: Clock) -> Seeded:
    """Move the cameras, triangulate points, and adjust both if asked for.

    Bundle adjustment is free to scale, shift and turn everything; the gauge is set again after it. An
    executor shares out the tracks that are triangulated where nothing is adjusted.
    """
    view = source.view
    images, points, adjusted = _make_points(source, located, options, clock)
    hand_back_memory()  # of the links, before their matches are read again
    fixed = located.fixed_frames(images)
    seen = images_of_few_points(points, images, options.structure.min_points_per_image, fixed)
    images, points = _leave_out(seen >= 0, images, points)
    unsupported, shares = np.zeros(len(seen), dtype=np.bool_), ObservationShares(math.nan, math.nan)
    if source.has_database:
        limit_px, rotations = options.structure.max_reprojection_error_px, source.images.rotations
        counts = count_observations(points, images, view.num_keypoints, view.batches(), rotations, limit_px)
        unsupported = images_without_support(counts, images, fixed)
        if options.trust.min_trust > 0.0:
            seen = np.where(unsupported, points.count_seen(len(seen)), seen)
            images, points = _leave_out(unsupported, images, points)
        shares = counts.shares(images.is_posed)
    seeded = Seeded(images, points, located.gauge, fixed, adjusted, seen, unsupported, shares)
    if (adjusted is not None or (seen >= 0).any()) and located.given.centers is None:
        return _set_gauge(seeded, source.images, located)
    axes = located.gauge.axes
    return seeded if axes is None else seeded.moved(turn_about_origin(axes), located.gauge)


def _make_points(
    source: MatchSource, located: Located, options: PlacingOptions, clock: Clock
) -> tuple[Images, Points, Estimate | None]:
    """Return the images with points, filtered, and how bundle adjustment went, if asked for."""
    adjusted, advance = None, clock.advance
    images = pose_images(source.images, located)
    posed = posed_part(images)
    adjusts = options.freedom.adjust == "full"
    with clock("structure"):
        links = read_links(source, located, posed, advance)
    with clock("bundle adjustment" if adjusts else "triangulation"):
        if adjusts:  # which triangulates at the poses of the start itself
            freedom, given = located.freedom.of(posed.frames), located.given_of(posed, source.images)
            adjusted, points = adjust_seed(posed.images, links, options.structure, freedom, given)
            posed, images = posed._replace(images=adjusted.images), images.updated(adjusted.images)
        else:
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


def _set_gauge(seeded: Seeded, given: Images, located: Located) -> Seeded:
    """Return an adjusted model in the gauge that was chosen, found anew for its cameras.

    The axes of the input are those in which the rotations agree best with the input's. What fixed cameras
    hold of the gauge is held already.
    """
    cameras = located.cameras[seeded.images.is_posed[located.cameras]]
    unit, fixed = None if located.placement.unit is None else 1.0, seeded.fixed
    if fixed.any() and unit is not None:
        return seeded
    turn = np.eye(3) if fixed.any() else restore_axes(given, seeded.images, cameras)
    locations = seeded.images.centers[cameras] @ turn.T
    rule = located.rule
    found = unit_gauge(locations) if rule is None else rule.choose(cameras, locations, unit)
    axes = np.eye(3) if found.axes is None else found.axes
    scale, shift = found.similarity.scale, found.similarity.translation
    motion = Similarity(scale=scale, rotation=axes @ turn, translation=axes @ shift)
    before = seeded.gauge.similarity
    similarity = replace(
        before, scale=scale * before.scale, translation=scale * turn @ before.translation + shift
    )
    gauge = replace(found, similarity=similarity, statement=_state(seeded.gauge, found))
    return seeded.moved(motion, gauge)


def _state(before: Gauge, after: Gauge) -> str:
    """Return the statement of a gauge that was found again, with what pulled the cameras before."""
    _, mark, pulled = before.statement.partition(PULLED)
    return f"{after.statement}{mark}{pulled}"


class PosedPart(NamedTuple):
    """The placed images of all, in the order of their ids: that of the sums of an adjustment."""

    images: Images
    rows: IntArray
    """(i,) their rows among all."""
    frames: IntArray
    """(f,) rows of their frames among all."""


def pose_images(images: Images, located: Located) -> Images:
    """Return images where they are placed, fixed ones as they were; NaN where neither."""
    locations = located.placement.locations[located.kept]
    placed = images.placed(located.cameras, located.gauge.similarity.apply(locations))
    fixed, frames = located.fixed_frames(images)[:, None], placed.frames
    return placed.posed(frames.rotations, np.where(fixed, images.frames.centers, frames.centers))


def posed_part(images: Images) -> PosedPart:
    """Return those of some images that have a pose."""
    rows = np.flatnonzero(images.is_posed)
    rows = rows[np.argsort(images.ids[rows])]
    return PosedPart(images.part(rows), rows, np.unique(images.frame_of[rows]))


def pictures_of(source: MatchSource, posed: PosedPart) -> ModelPictures:
    """Return the keypoints of placed images and their lenses."""
    rows, view = posed.rows.tolist(), source.view
    return ModelPictures(posed.images, lambda k: view.keypoints(rows[k]))


def read_links(source: MatchSource, located: Located, posed: PosedPart, advance: Advance) -> Links:
    """Return what joins the keypoints of placed images; all rays are forgotten.

    From here to the end of a triangulation, or an adjustment, most memory is needed.
    """
    placement, view, pictures = located.placement, source.view, pictures_of(source, posed)
    if isinstance(source.matches, TrackMatches):  # the model has its tracks already
        return collect_tracks(posed.images, pictures, source.matches.points_of(posed.images))
    # A further piece is small: read no more than it needs.
    among = placement.cameras if placement.piece else None
    links = view.links(without=placement.rejected_pairs, among=among, advance=advance, consume=True)
    place = np.full(source.images.num_images, -1)
    place[posed.rows] = np.arange(len(posed.rows))
    return collect_matches(posed.images, pictures, place, links, view.num_matches)
