"""From placed cameras to seeded models: poses, points, colors, and bundle adjustment if asked for."""

import math
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sfm_shapefit.adjustment.adjusted import Adjusted
from sfm_shapefit.adjustment.bundle_adjustment import bundle_adjust
from sfm_shapefit.adjustment.filter import filter_in_place
from sfm_shapefit.adjustment.run import GivenPoses
from sfm_shapefit.adjustment.sources import TrackSource, collect_matches
from sfm_shapefit.adjustment.structure import triangulate_in_place
from sfm_shapefit.base.arrays import BoolArray, IntArray
from sfm_shapefit.base.executors import Advance
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.base.heap import hand_back_memory
from sfm_shapefit.facts.options import LocateOptions
from sfm_shapefit.facts.result import FurtherPiece
from sfm_shapefit.files.colmap.model import PosedModel
from sfm_shapefit.files.colmap.point_colors import PointColors, color_points
from sfm_shapefit.files.colmap.seed import build_seed, transform_model, turn_model
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
from sfm_shapefit.placement.place import Placement, place_further
from sfm_shapefit.placement.prior_refinement import PULLED

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
    """The rotations of the input, and position priors that pull at the cameras and hold the gauge by that."""

    @property
    def cameras(self) -> IntArray:
        """The images that are in the output, ascending."""
        return self.placement.cameras[self.kept]


class Seeded(NamedTuple):
    """A seeded model."""

    reconstruction: "pycolmap.Reconstruction"
    gauge: Gauge
    """From the solver's units to its own."""
    adjusted: Adjusted | None
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
        adjusted = self.adjusted and replace(self.adjusted, reconstruction=reconstruction)
        return self._replace(reconstruction=reconstruction, gauge=gauge, adjusted=adjusted)


def select_trusted(placement: Placement, min_trust: float) -> BoolArray:
    """Return which of the placed cameras are trusted enough; all, if hardly any is."""
    kept: BoolArray = placement.assessment.trust >= min_trust
    return kept if np.sum(kept) >= _FEWEST_KEPT else np.ones_like(kept)


def build_seeded_model(
    source: MatchSource,
    located: Located,
    options: LocateOptions,
    clock: Clock,
    colors: PointColors | None = None,
    executor: Executor | None = None,
) -> Seeded:
    """Move the cameras, triangulate points, and adjust both if asked for.

    Bundle adjustment is free to scale, shift and turn everything; the gauge is set again after it. Points
    from matches take the colors of the input's, if it had any. An executor shares out the tracks that are
    triangulated where nothing is adjusted.
    """
    adjusted, gauge = None, located.gauge
    frames = () if located.fixed is None else source.model.frame_ids[located.fixed].tolist()
    with clock("structure"):
        seed = seed_of(source, located)
        tracks = read_tracks(source, located, seed, clock.advance)
    if not options.bundle_adjust:
        with clock("triangulation"):
            triangulate_in_place(seed, tracks, options, clock.advance, executor)
            del tracks
            filter_in_place(seed, options)
            seeded = seed
    else:  # which triangulates at the seed's poses itself
        with clock("bundle adjustment"):
            adjusted = bundle_adjust(
                seed,
                tracks,
                options,
                adjuster=options.adjuster,
                fixed_frames=frames,
                given=located.given,
            )
            seeded = adjusted.reconstruction
            del tracks
    hand_back_memory()  # of the tracks, before their matches are read again
    poor = deregister_of_few_points(seeded, options.min_points_per_image, frames)
    shares, unsupported = ObservationShares(math.nan, math.nan), dict[int, int]()
    if source.kind != "tracks":  # points of the model's own tracks have their colors already
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
    is_held = located.given.centers is not None and options.adjuster == "own"
    if (adjusted is not None or poor) and not is_held:
        seeded, gauge = _set_gauge(seeded, source.model, located)
    elif gauge.axes is not None:
        seeded = turn_model(seeded, gauge.axes)
    if adjusted is not None:
        adjusted = replace(adjusted, reconstruction=seeded)
    return Seeded(seeded, gauge, adjusted, poor, frozenset(unsupported), shares)


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


def place_further_pieces(
    source: MatchSource,
    placement: Placement,
    options: LocateOptions,
    judge: Callable[[Placement], Placement],
    colors: PointColors | None = None,
) -> tuple[FurtherPiece, ...]:
    """Return the further rigid pieces with their seeded models, each in the gauge "unit" of its own.

    What is trusted of a piece is what `judge` makes of it, as of the largest one.
    """
    pieces = []
    for further in map(judge, place_further(placement, options)):
        kept = select_trusted(further, options.min_trust)
        gauge = unit_gauge(further.locations[kept])
        seeded = build_seeded_model(source, Located(further, kept, gauge), options, Clock(), colors)
        pieces.append(
            FurtherPiece(
                placement=further.without_error_samples(),
                kept=kept & ~np.isin(source.model.image_ids[further.cameras], list(seeded.poor)),
                gauge=seeded.gauge,
                reconstruction=seeded.reconstruction,
                image_ids=source.model.image_ids[further.cameras],
            )
        )
    return tuple(pieces)


def seed_of(source: MatchSource, located: Located) -> "pycolmap.Reconstruction":
    """Return the model with its cameras moved, without points."""
    model, placement = source.model, located.placement
    is_placed = np.zeros(model.num_images, dtype=np.bool_)
    is_placed[located.cameras] = True
    centers = np.full((model.num_images, 3), np.nan)
    centers[located.cameras] = located.gauge.similarity.apply(placement.locations[located.kept])
    return build_seed(model, is_placed, centers, source.view.keypoints, located.fixed)


def read_tracks(
    source: MatchSource,
    located: Located,
    seed: "pycolmap.Reconstruction",
    advance: Advance,
) -> TrackSource:
    """Return the tracks to triangulate at the poses of a seed; all rays are forgotten.

    From here to the end of a triangulation, or an adjustment, most memory is needed.
    """
    model, placement, view = source.model, located.placement, source.view
    # A further piece is small: read no more than it needs.
    among = placement.cameras if placement.piece else None
    links = view.links(without=placement.rejected_pairs, among=among, advance=advance, consume=True)
    if source.kind == "tracks":  # which are not made of matches
        return model.reconstruction
    return collect_matches(seed, model.image_ids, links, view.num_matches)
