"""From placed cameras to seeded models: poses, points, colors, and bundle adjustment if asked for."""

import math
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sfm_shapefit.arrays import BoolArray, IntArray
from sfm_shapefit.colmap.bundle_adjustment import Adjusted, bundle_adjust
from sfm_shapefit.colmap.point_support import (
    deregister_of_few_points,
    share_of_agreeing_observations,
)
from sfm_shapefit.colmap.seed import build_seed, turn_model
from sfm_shapefit.colmap.structure import TrackSource, color_points, correspondence_graph, triangulate
from sfm_shapefit.commands.stages.clock import Clock
from sfm_shapefit.commands.stages.inputs import MatchSource
from sfm_shapefit.directions.matches import MatchBatch
from sfm_shapefit.locate_options import LocateOptions
from sfm_shapefit.placement.gauge import Gauge, unit_gauge
from sfm_shapefit.placement.place import Placement, place_further
from sfm_shapefit.results.result import FurtherPiece

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

    @property
    def cameras(self) -> IntArray:
        """The images that are in the output, ascending."""
        return self.placement.cameras[self.kept]


class Seeded(NamedTuple):
    """A seeded model."""

    reconstruction: "pycolmap.Reconstruction"
    adjusted: Adjusted | None
    """How bundle adjustment went, if it was asked for."""
    poor: dict[int, int]
    """By the id of each image that was left out because it sees too few points, their number."""
    agreeing_observations: float
    """Share of the keypoints matched in two other images that see a point; NaN without a database."""


def select_trusted(placement: Placement, min_trust: float) -> BoolArray:
    """Return which of the placed cameras are trusted enough; all, if hardly any is."""
    kept: BoolArray = placement.assessment.trust >= min_trust
    return kept if np.sum(kept) >= _FEWEST_KEPT else np.ones_like(kept)


def build_seeded_model(
    source: MatchSource,
    located: Located,
    options: LocateOptions,
    clock: Clock,
    executor: Executor | None = None,
) -> Seeded:
    """Move the cameras, triangulate points, and adjust both if asked for.

    An executor shares out the model's own tracks.
    """
    adjusted, axes = None, located.gauge.axes
    frames = () if located.fixed is None else source.model.frame_ids[located.fixed].tolist()
    with clock("structure"):
        seed, tracks = seed_and_tracks(source, located, clock.advance)
        if source.database is not None:
            source.database.forget_rays()  # triangulation is where most memory is needed
    if not options.bundle_adjust:
        with clock("triangulation"):
            seeded = triangulate(seed, tracks, options, clock.advance, executor, in_place=True)
    else:  # which triangulates at the seed's poses itself
        with clock("bundle adjustment"):
            adjusted = bundle_adjust(seed, tracks, options, fixed_frames=frames)
            seeded = adjusted.reconstruction
    del tracks  # the graph of all matches is large
    poor = deregister_of_few_points(seeded, options.min_points_per_image, frames)
    agreeing = math.nan
    if source.database is not None:  # points of the model's own tracks have their colors already
        agreeing = share_of_agreeing_observations(seeded, source.model.image_ids, source.batches())
        with clock("colors"):
            seeded = color_points(seeded, source.model.reconstruction, in_place=True)
    return Seeded(seeded if axes is None else turn_model(seeded, axes), adjusted, poor, agreeing)


def place_further_pieces(
    source: MatchSource, placement: Placement, options: LocateOptions
) -> tuple[FurtherPiece, ...]:
    """Return the further rigid pieces with their seeded models, each in the gauge "unit" of its own."""
    pieces = []
    for further in place_further(placement, options):
        kept = select_trusted(further, options.min_trust)
        gauge = unit_gauge(further.locations[kept])
        seeded = build_seeded_model(source, Located(further, kept, gauge), options, Clock())
        pieces.append(
            FurtherPiece(
                placement=further,
                kept=kept & ~np.isin(source.model.image_ids[further.cameras], list(seeded.poor)),
                gauge=gauge,
                reconstruction=seeded.reconstruction,
                image_ids=source.model.image_ids[further.cameras],
            )
        )
    return tuple(pieces)


def seed_and_tracks(
    source: MatchSource, located: Located, advance: Callable[[int, int], None]
) -> "tuple[pycolmap.Reconstruction, TrackSource]":
    """Return the model with its cameras moved, and the tracks to triangulate at their new poses."""
    model, placement, fixed = source.model, located.placement, located.fixed
    is_placed = np.zeros(model.num_images, dtype=np.bool_)
    is_placed[located.cameras] = True
    centers = np.full((model.num_images, 3), np.nan)
    centers[located.cameras] = located.gauge.similarity.apply(placement.locations[located.kept])
    if source.database is None:
        return build_seed(model, is_placed, centers, fixed=fixed), model.reconstruction
    seed = build_seed(model, is_placed, centers, source.database.keypoints, fixed)
    # A further piece is small: read no more than it needs.
    among = placement.cameras if placement.piece else None
    batches = source.counted(_without_pairs(source.batches(among), placement.rejected_pairs), advance)
    return seed, correspondence_graph(seed, model.image_ids, batches)


def _without_pairs(batches: Iterator[MatchBatch], rejected: IntArray) -> Iterator[MatchBatch]:
    """Empty the match lists of the rejected pairs (k, 2): their directions contradict the solution."""
    unwanted = {(min(i, j), max(i, j)) for i, j in rejected.tolist()}
    for batch in batches:
        dropped: BoolArray = np.array(
            [tuple(pair) in unwanted for pair in batch.pairs.tolist()], dtype=np.bool_
        )
        counts = np.diff(batch.offsets)
        kept = np.repeat(~dropped, counts)
        yield MatchBatch(
            pairs=batch.pairs[~dropped],
            offsets=np.concatenate([[0], np.cumsum(counts[~dropped])]),
            keypoints=batch.keypoints[kept],
            rays_i=batch.rays_i[kept],
            rays_j=batch.rays_j[kept],
            pixel_angles=batch.pixel_angles[~dropped],
        )
