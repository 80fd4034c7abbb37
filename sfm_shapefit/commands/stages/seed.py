"""From placed cameras to seeded models: poses, points, colours, and bundle adjustment if asked for."""

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from typing import TYPE_CHECKING

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.colmap.adjustment import Adjusted, bundle_adjust
from sfm_shapefit.colmap.seed import build_seed, turn_model
from sfm_shapefit.colmap.structure import TrackSource, color_points, correspondence_graph, triangulate
from sfm_shapefit.commands.stages.clock import Clock
from sfm_shapefit.commands.stages.inputs import MatchSource
from sfm_shapefit.directions.matches import MatchBatch
from sfm_shapefit.directions.tracks import JointGraph
from sfm_shapefit.judgement.trust import Evidence
from sfm_shapefit.options import LocateOptions
from sfm_shapefit.placement.gauge import Gauge, unit_gauge
from sfm_shapefit.placement.place import Placement, place_further
from sfm_shapefit.results import FurtherPiece

if TYPE_CHECKING:
    import pycolmap

_FEWEST_KEPT = 3  # cameras; fewer trusted ones are no result


def trusted(placement: Placement, min_trust: float) -> BoolArray:
    """Return which of the placed cameras are trusted enough; all, if hardly any is."""
    kept: BoolArray = placement.assessment.trust >= min_trust
    return kept if np.sum(kept) >= _FEWEST_KEPT else np.ones_like(kept)


def seeded_model(
    source: MatchSource,
    placement: Placement,
    kept: BoolArray,
    gauge: Gauge,
    options: LocateOptions,
    clock: Clock,
    fixed: BoolArray | None = None,
    executor: Executor | None = None,
) -> "tuple[pycolmap.Reconstruction, Adjusted | None]":
    """Return the model with its cameras moved and points triangulated, and how bundle adjustment went.

    `kept` says which of the placement's cameras are in the model, `gauge` where those are in its units.
    Images that are `fixed` keep their poses to the last bit; an executor shares out the model's own tracks.
    """
    adjusted = None
    located = kept, gauge.similarity.apply(placement.locations[kept])
    with clock("structure"):
        seed, tracks = _seed_and_tracks(source, placement, located, clock.advance, fixed)
    if not options.bundle_adjust:  # which triangulates at the seed's poses itself
        with clock("triangulation"):
            settings = options
            seeded = triangulate(seed, tracks, settings, clock.advance, executor, in_place=True)
    if options.bundle_adjust:
        with clock("bundle adjustment"):
            still = () if fixed is None else source.model.frame_ids[fixed].tolist()
            adjusted = bundle_adjust(seed, tracks, options, fixed_frames=still)
            seeded = adjusted.reconstruction
    del tracks  # the graph of all matches is large
    if source.database is not None:  # points of the model's own tracks have their colours already
        with clock("colours"):
            seeded = color_points(seeded, source.model.reconstruction, in_place=True)
    return seeded if gauge.axes is None else turn_model(seeded, gauge.axes), adjusted


def further_pieces(
    source: MatchSource,
    placement: Placement,
    joint: JointGraph,
    evidence: Evidence,
    options: LocateOptions,
) -> tuple[FurtherPiece, ...]:
    """Return the further rigid pieces with their seeded models, each in the gauge "unit" of its own."""
    found = []
    for placed in place_further(placement, options, joint.covariance, evidence):
        kept = trusted(placed, options.min_trust)
        gauge = unit_gauge(placed.locations[kept])
        seeded, _ = seeded_model(source, placed, kept, gauge, options, Clock())
        found.append(
            FurtherPiece(
                placement=placed,
                kept=kept,
                gauge=gauge,
                reconstruction=seeded,
                image_ids=source.model.image_ids[placed.cameras],
            )
        )
    return tuple(found)


def _seed_and_tracks(
    source: MatchSource,
    placement: Placement,
    located: tuple[BoolArray, FloatArray],
    advance: Callable[[int, int], None],
    fixed: BoolArray | None,
) -> "tuple[pycolmap.Reconstruction, TrackSource]":
    """Return the model with its cameras moved, and the tracks to triangulate at their new poses."""
    model, (kept, centers) = source.model, located
    placed = np.zeros(model.num_images, dtype=np.bool_)
    placed[placement.cameras[kept]] = True
    all_centers = np.full((model.num_images, 3), np.nan)
    all_centers[placement.cameras[kept]] = centers
    if source.database is None:
        return build_seed(model, placed, all_centers, fixed=fixed), model.reconstruction
    seed = build_seed(model, placed, all_centers, source.database.keypoints, fixed)
    # A further piece is small: read no more than it needs.
    among = placement.cameras if placement.piece else None
    batches = source.counted(_without_pairs(source.batches(among), placement.rejected_pairs), advance)
    graph = correspondence_graph(seed, model.image_ids, batches)
    source.database.forget_rays()  # triangulation is where most memory is needed
    return seed, graph


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
        )
