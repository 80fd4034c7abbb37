"""From matches to the problem that is solved: directions, the view graph with its points, the evidence."""

from concurrent.futures import Executor
from dataclasses import replace
from functools import partial

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import SIGMA_PER_MEDIAN
from sfm_shapefit.files.colmap.model import PosedModel
from sfm_shapefit.graph.measured import Evidence, MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.correlated_errors import NUM_SAMPLES, sample_direction_errors
from sfm_shapefit.pairs.estimate import estimate_directions
from sfm_shapefit.pairs.options import DirectionOptions
from sfm_shapefit.pairs.pair_directions import DirectionStatus, PairDirections, concatenate
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.pipeline.execution import PairWork, measure_with_workers
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.pipeline.memory import Workload
from sfm_shapefit.tracks.node_tracks import build_tracks, covering_set, join_points
from sfm_shapefit.tracks.options import NodeOptions

_CHECK_ROTATIONS = "check that the rotations and intrinsics belong to these matches"
# Beyond so many pairs standard deviations take the pairs as independent.
_MAX_SAMPLED_PAIRS = 100_000
_ADVICE = {
    DirectionStatus.TOO_FEW_MATCHES: "match more, or lower min_inliers",
    DirectionStatus.FEW_INLIERS: "match more, or lower min_inliers",
    DirectionStatus.NO_PARALLAX: "cameras that only turn cannot be placed; use images from different places",
}
"""What to do where no pair has a direction, by the most frequent reason."""


def measure_directions(
    source: MatchSource, options: DirectionOptions, clock: Clock, executor: Executor | None = None
) -> PairDirections:
    """Return the direction of every pair that the source has; an executor shares them out, if it can."""
    model = source.model
    if executor is not None and source.database is not None:
        work = PairWork(estimate=partial(estimate_directions, options=options))
        parts = measure_with_workers(source.database, model, work, executor, clock.advance)
    else:
        batches = source.counted(source.batches(), clock.advance)
        parts = [estimate_directions(batch, options, clock.threads) for batch in batches]
    if not parts:
        raise UnsolvableError(
            "no two posed images share matches; match the images, or give the database that has their matches"
        )
    return concatenate(parts)


def view_graph(model: PosedModel, directions: PairDirections) -> ViewGraph:
    """Return the graph of the usable directions; it has at least one edge."""
    usable = directions.usable()
    if len(usable) == 0:
        counts = directions.counts()
        reasons = ", ".join(f"{status.value}: {count}" for status, count in counts.items())
        raise UnsolvableError(
            f"none of the {len(directions.pairs)} pairs has a usable direction ({reasons}); "
            f"{_ADVICE.get(next(iter(counts)), _CHECK_ROTATIONS)}"
        )
    return ViewGraph(
        model.num_images,
        directions.pairs[usable],
        directions.directions[usable],
        directions.weights()[usable],
        names=model.names,
    )


def build_graph(
    source: MatchSource, directions: PairDirections, nodes: NodeOptions, inlier_threshold_px: float
) -> MeasuredGraph:
    """Return the measured graph, with 3D points as further nodes if the options want them."""
    model = source.model
    graph, covariance = view_graph(model, directions), directions.covariance[directions.usable()]
    if not (nodes.uses_points(model.num_images) and source.economy.points):
        return MeasuredGraph(graph, covariance=covariance)
    tracks = build_tracks(source.batches(), directions, inlier_threshold_px, source.num_keypoints())
    chosen = tracks.subset(covering_set(tracks, model.num_images))
    return join_points(graph, covariance, chosen, 1.0 / model.focal_lengths_px)


def samples_errors(source: MatchSource, directions: PairDirections) -> bool:
    """Return whether the errors of the directions are sampled together."""
    return source.economy.samples and len(directions.usable()) <= _MAX_SAMPLED_PAIRS


def count_work(source: MatchSource, directions: PairDirections) -> Workload:
    """Return what there is to do, as far as it is known once the directions are measured."""
    return replace(
        source.workload(),
        num_pairs=len(directions.pairs),
        num_matches=int(directions.num_matches.sum()),
        num_sampled=len(directions.usable()) if samples_errors(source, directions) else 0,
    )


def sample_errors(
    source: MatchSource, directions: PairDirections, inlier_threshold_px: float
) -> FloatArray | None:
    """Return samples of the usable directions' errors, which share keypoints; None if not known."""
    if not samples_errors(source, directions):
        return None
    row_of = {tuple(pair): k for k, pair in enumerate(directions.pairs.tolist())}
    usable = directions.usable()
    place = np.full(len(directions.pairs), -1)
    place[usable] = np.arange(len(usable))
    errors = np.zeros((len(usable), NUM_SAMPLES, 2))
    for batch in source.batches():
        rows = np.array([row_of[tuple(pair)] for pair in batch.pairs.tolist()], dtype=np.int64)
        found = sample_direction_errors(
            batch,
            directions.directions[rows],
            directions.covariance[rows],
            SIGMA_PER_MEDIAN * directions.median_residual_px[rows],
            inlier_threshold_px,
        )
        kept = place[rows] >= 0
        errors[place[rows[kept]]] = found[kept]
    return errors


def collect_evidence(directions: PairDirections, errors: FloatArray | None = None) -> Evidence:
    """Return what the matches say of the cameras beyond the usable directions."""
    usable = directions.usable()
    against = directions.contradicting()
    return Evidence(
        support=directions.num_matches[usable],
        contradicting=directions.pairs[against],
        contradicting_support=directions.num_matches[against],
        errors=errors,
    )


def add_evidence(
    measured: MeasuredGraph, source: MatchSource, directions: PairDirections, inlier_threshold_px: float
) -> MeasuredGraph:
    """Return the measured graph with what the matches say; a direction to a point has one match.

    The errors of directions to points are independent draws of their own covariance.
    """
    evidence = collect_evidence(directions, sample_errors(source, directions, inlier_threshold_px))
    assert measured.covariance is not None
    own = measured.covariance[len(evidence.support) :]
    support = np.concatenate([evidence.support, np.ones(len(own), dtype=np.int64)])
    errors = evidence.errors
    if errors is not None:
        sampled, errors = errors, np.empty((len(errors) + len(own), *errors.shape[1:]))
        errors[: len(sampled)] = sampled
        drawn = errors[len(sampled) :]  # in place: these are the largest arrays of a placement
        np.random.default_rng(0).standard_normal(out=drawn)
        drawn *= np.sqrt(np.diagonal(own, axis1=1, axis2=2))[:, None, :]
    return replace(measured, evidence=replace(evidence, support=support, errors=errors))
