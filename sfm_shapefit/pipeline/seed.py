"""From placed cameras to seeded models: poses, points, colors, and bundle adjustment if asked for."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sfm_shapefit.adjustment.bundle_adjustment import bundle_adjust
from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.run import GivenPoses
from sfm_shapefit.adjustment.sources import Links, collect_matches, collect_tracks
from sfm_shapefit.adjustment.structure import triangulate
from sfm_shapefit.base.arrays import BoolArray, IntArray, hand_back_memory
from sfm_shapefit.base.executors import Advance
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.facts.options import LocateOptions
from sfm_shapefit.files.colmap.filter import PointRules, filter_in_place
from sfm_shapefit.files.colmap.images import put_images
from sfm_shapefit.files.colmap.model import PosedModel
from sfm_shapefit.files.colmap.own_tracks import triangulate_own_tracks
from sfm_shapefit.files.colmap.point_colors import PointColors, color_points
from sfm_shapefit.files.colmap.points import ModelPictures, add_points, points_of
from sfm_shapefit.files.colmap.seed import build_seed, transform_model, turn_model
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.judgement.support import (
    ObservationShares,
    count_observations,
    deregister_of_few_points,
    images_without_support,
)
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.pipeline.gauge_choice import GaugeRule, restore_axes
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.placement.gauge import Gauge, unit_gauge
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.placement.prior_refinement import PULLED
from sfm_shapefit.scene.images import Images
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

    @property
    def cameras(self) -> IntArray:
        """The images that are in the output, ascending."""
        return self.placement.cameras[self.kept]

    def given_of(self, posed: "PosedPart", model: PosedModel) -> GivenPoses:
        """Return what is known of the frames of some posed images of the model."""
        fixed = np.zeros(len(model.images.frames.ids), dtype=np.bool_)
        if self.fixed is not None:
            fixed[model.images.frame_of[self.fixed]] = True
        return self.given._replace(fixed=fixed).of(posed.frames)


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
    options: LocateOptions,
    clock: Clock,
    colors: PointColors | None = None,
) -> Seeded:
    """Move the cameras, triangulate points, and adjust both if asked for.

    Bundle adjustment is free to scale, shift and turn everything; the gauge is set again after it. Points
    from matches take the colors of the input's, if it had any. An executor shares out the tracks that are
    triangulated where nothing is adjusted.
    """
    gauge = located.gauge
    frames = () if located.fixed is None else source.model.frame_ids[located.fixed].tolist()
    seeded, adjusted = _make_points(source, located, options, clock)
    hand_back_memory()  # of the tracks, before their matches are read again
    poor = deregister_of_few_points(seeded, options.min_points_per_image, frames)
    shares, unsupported = ObservationShares(math.nan, math.nan), dict[int, int]()
    if source.has_database:  # points of the model's own tracks have their colors already
        batches = source.view.batches()
        counts = count_observations(seeded, source.model, batches, options.max_reprojection_error_px)
        unsupported = images_without_support(seeded, counts, frames)
        if options.min_trust > 0.0:
            poor |= unsupported
            for frame in {seeded.image(image_id).frame_id for image_id in unsupported}:
                seeded.deregister_frame(frame)
        shares = counts.subset(np.isin(counts.image_ids, list(seeded.reg_image_ids()))).shares()
        with clock("colors"):
            seeded = seeded if colors is None else color_points(seeded, colors, in_place=True)
    if poor:
        lost = np.isin(source.model.image_ids[located.placement.cameras], list(poor))
        located = located._replace(kept=located.kept & ~lost)
    is_held = located.given.centers is not None
    if (adjusted is not None or poor) and not is_held:
        seeded, gauge = _set_gauge(seeded, source.model, located)
    elif gauge.axes is not None:
        seeded = turn_model(seeded, gauge.axes)
    return Seeded(seeded, gauge, adjusted, poor, frozenset(unsupported), shares)


def _make_points(
    source: MatchSource, located: Located, options: LocateOptions, clock: Clock
) -> "tuple[pycolmap.Reconstruction, Estimate | None]":
    """Return the seed with points, filtered, and how bundle adjustment went, if it was asked for."""
    model, adjusted, links = source.model, None, None
    own = None if source.has_database else model.reconstruction
    rules = PointRules(
        options.max_reprojection_error_px, options.min_triangulation_angle_deg, options.min_track_length
    )
    with clock("structure"):
        images = pose_images(model, located)
        seed = build_seed(model, images, source.view.keypoints if source.has_database else None)
        posed = posed_part(images)
        if own is None or options.adjust == "full":
            links = read_links(source, located, posed, clock.advance)
    with clock("bundle adjustment" if options.adjust == "full" else "triangulation"):
        if options.adjust == "full":  # which triangulates at the seed's poses itself
            assert links is not None
            adjusted, points = bundle_adjust(posed.images, links, options, located.given_of(posed, model))
            put_images(seed, adjusted.images)
        elif own is not None:
            points = triangulate_own_tracks(seed, posed.images, own, rules, clock.advance, clock.executor)
        else:
            assert isinstance(links, MatchedKeypoints)
            points = triangulate(posed.images, links, options, clock.advance, clock.executor)
        del links
        add_points(seed, posed.images, points, own)
        filter_in_place(seed, rules)
    if adjusted is not None:
        adjusted = replace(adjusted, final_error_px=seed.compute_mean_reprojection_error())
    return seed, adjusted


def _set_gauge(
    adjusted: "pycolmap.Reconstruction", model: PosedModel, located: Located
) -> "tuple[pycolmap.Reconstruction, Gauge]":
    """Return an adjusted model in the gauge that was chosen, found anew for its cameras, and that gauge.

    The axes of the input are those in which the rotations agree best with the input's. What fixed cameras
    hold of the gauge is held already.
    """
    fixed = np.zeros(model.num_images, np.bool_) if located.fixed is None else located.fixed
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
    if located.fixed is None:
        return placed
    frames, fixed = placed.frames, np.zeros((len(placed.frames.ids), 1), dtype=np.bool_)
    fixed[model.images.frame_of[located.fixed]] = True
    return placed.posed(frames.rotations, np.where(fixed, model.images.frames.centers, frames.centers))


def posed_part(images: Images) -> PosedPart:
    """Return those of a model's images that have a pose."""
    rows = np.flatnonzero(images.is_posed)
    rows = rows[np.argsort(images.ids[rows])]
    return PosedPart(images.part(rows), rows, np.unique(images.frame_of[rows]))


def read_links(source: MatchSource, located: Located, posed: PosedPart, advance: Advance) -> Links:
    """Return what joins the keypoints of placed images; all rays are forgotten.

    From here to the end of a triangulation, or an adjustment, most memory is needed.
    """
    model, placement, view = source.model, located.placement, source.view
    # A further piece is small: read no more than it needs.
    among = placement.cameras if placement.piece else None
    links = view.links(without=placement.rejected_pairs, among=among, advance=advance, consume=True)
    if not source.has_database:  # the model has its tracks already
        pictures = ModelPictures(model.reconstruction, posed.images)
        return collect_tracks(posed.images, pictures, points_of(model.reconstruction, posed.images))
    rows = posed.rows.tolist()
    pictures = ModelPictures(model.reconstruction, posed.images, lambda k: view.keypoints(rows[k]))
    place = np.full(model.num_images, -1)
    place[posed.rows] = np.arange(len(posed.rows))
    return collect_matches(posed.images, pictures, place, links, view.num_matches)
