"""From matches to the problem that is solved: directions, the view graph with its points, the evidence."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, quantile
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import SIGMA_PER_MEDIAN
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.graph.measured import Evidence, MeasuredGraph
from sfm_shapefit.graph.rigidity import is_parallel_rigid
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.correlated_errors import NUM_SAMPLES, sample_direction_errors
from sfm_shapefit.judgement.measured_pairs import MeasuredPairs
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.pairs.estimate import estimate_directions
from sfm_shapefit.pairs.pair_directions import DirectionStatus, PairDirections, concatenate
from sfm_shapefit.pipeline.execution import measure_with_workers
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.placement.conditioning import direction_spread
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import MatchBatch, is_among, rows_of_pairs
from sfm_shapefit.tracks.node_tracks import TrackJoiner, covering_set, join_points
from sfm_shapefit.tracks.structure_options import NodeOptions, PointNodes

_CHECK_ROTATIONS = (
    "is this the model's database, with right intrinsics? Rotations that are degrees off need rotations=2"
)
_MAX_SAMPLED_PAIRS = 100_000  # pairs; beyond, standard deviations take them as independent, for memory
_MOST_PAIRS = 200_000  # pairs, usable or not; of more, none is sampled to begin with
# Cameras from which points are left out of the graph where pairs hold it: they treble the time of its solve.
_MANY_CAMERAS = 1_000
_FEW_CAMERAS = 0.01  # share of the cameras that may be held worse: the refinement judges each by itself
_MANY_PAIRS = 15  # pairs of a camera; two hold it, and some are wrong
# The `direction_spread` of the pairs of a camera; 0.5 in a plane, and 0.1 on a line with 15 % of pairs wrong.
_WIDELY_SPREAD = 0.2
_ADVICE = {
    DirectionStatus.TOO_FEW_MATCHES: "match more, or be content with fewer by min_inliers=10",
    DirectionStatus.FEW_INLIERS: "match more, or be content with fewer by min_inliers=10",
    DirectionStatus.NO_PARALLAX: "cameras that only turn cannot be placed; use images from different places",
}
"""What to do where no pair has a direction, by the most frequent reason."""


class MeasureRequest(NamedTuple):
    """What a pass over the matches yields beside the directions."""

    tracks: PointNodes = "never"
    """Whether tracks are joined; "auto" joins those of many cameras only where pairs do not hold them."""
    checked: bool = False
    errors: bool = False
    facts: bool = False
    """Whether `MeasuredPairs.facts_per_match` is computed."""


DIRECTIONS_ALONE = MeasureRequest()
"""Nothing beside them."""


def measure(
    source: MatchSource, options: DirectionOptions, clock: Clock, wanted: MeasureRequest = DIRECTIONS_ALONE
) -> MeasuredPairs:
    """Measure the direction of every pair of a source, and what is wanted beside, in one pass.

    Pairs of two fixed images are left out.

    Workers of a cluster estimate the directions of a database's pairs; what is wanted beside takes a second
    pass then.

    Raises:
        UnsolvableError: if no pair has a match.
    """
    beside = SideResults(source, options.inlier_threshold_px, wanted, clock.threads)
    without = source.pairs_of_fixed
    if clock.cluster is not None and source.has_database:
        parts = measure_with_workers(source.view, partial(estimate_directions, options=options), clock)
        if without is not None and parts:
            every = concatenate(parts)
            parts = [every.subset(np.flatnonzero(~is_among(every.pairs, without)))]
        if parts and wanted != DIRECTIONS_ALONE:
            for batch, directions in _again(source, concatenate(parts)):
                beside.add(batch, directions)
    else:
        parts = []

        def estimated(batch: MatchBatch) -> tuple[MatchBatch, PairDirections]:
            return batch, estimate_directions(batch, options, clock.threads)

        batches = source.view.batches(1, without, clock.advance)
        for batch, directions in source.view.measured(batches, estimated, clock.threads):
            parts.append(directions)
            beside.add(batch, directions)
    if not parts and without is not None:
        raise UnsolvableError("no image that is not fixed shares matches with another; match the new images")
    if not parts:
        raise UnsolvableError(
            "no two posed images share matches; match the images, or give the database that has their matches"
            f"{source.matches.lacking and f' ({source.matches.lacking})'}"
        )
    directions, tracks_open = concatenate(parts), beside.joiner is None and wanted.tracks == "auto"
    if tracks_open and not _is_held_by_pairs(view_graph(source.images, directions)):
        beside.joiner = _new_joiner(source, options.inlier_threshold_px)
        for batch, batch_directions in _again(source, directions):
            beside.joiner.add(batch, batch_directions)
    return MeasuredPairs(
        directions=directions,
        tracks=beside.joiner,
        checks=wanted.checked and beside.joiner is not None and beside.joiner.holds_all,
        errors=beside.errors,
        facts_per_match=beside.facts_per_match() if wanted.facts else 1.0,
    )


def _new_joiner(source: MatchSource, threshold_px: float) -> TrackJoiner:
    return TrackJoiner(threshold_px, source.view.num_keypoints, source.view.num_matches)


def _again(source: MatchSource, directions: PairDirections) -> Iterator[tuple[MatchBatch, PairDirections]]:
    """Yield the matches of a source once more, with the directions of their pairs."""
    for batch in source.view.batches(without=source.pairs_of_fixed):
        yield batch, directions.subset(rows_of_pairs(batch.pairs, directions.pairs))


def are_sampled(num_usable: int, num_pairs: int) -> bool:
    """Return whether the errors of so many usable directions, of so many pairs, are sampled."""
    return num_usable <= _MAX_SAMPLED_PAIRS and num_pairs <= _MOST_PAIRS


class SideResults:
    """Tracks, errors and counts that each batch adds to."""

    def __init__(
        self, source: MatchSource, threshold_px: float, wanted: MeasureRequest, threads: int = 1
    ) -> None:
        view, self._threads = source.view, threads
        self._threshold_px, self._num_usable, self._counts_pairs = threshold_px, 0, wanted.facts
        is_sampled = wanted.errors and view.num_pairs <= _MOST_PAIRS
        self.errors: list[FloatArray] | None = [] if is_sampled else None
        self._begins = offsets_of(view.num_keypoints)
        # Pairs of most keypoints are far below the limit of the type, 65,535.
        self._num_pairs_of = np.zeros(self._begins[-1], dtype=np.uint16)
        at_once = wanted.tracks == "always" or source.images.num_images < _MANY_CAMERAS
        joins = wanted.tracks != "never" and at_once
        self.joiner = _new_joiner(source, threshold_px) if joins else None

    def add(self, batch: MatchBatch, directions: PairDirections) -> None:
        """Take a batch and its directions."""
        if self.joiner is not None:
            self.joiner.add(batch, directions)
        usable = directions.usable()
        self._num_usable += len(usable)
        for row in usable.tolist() if self._counts_pairs else ():  # faster than `np.add.at`
            keypoints = batch.keypoints[batch.slice_of(row)]
            self._num_pairs_of[self._begins[batch.pairs[row]] + keypoints] += 1
        if self._num_usable > _MAX_SAMPLED_PAIRS:
            self.errors = None
        if self.errors is not None:
            noise_px = SIGMA_PER_MEDIAN * directions.median_residual_px
            given = batch, directions.directions, directions.covariance, noise_px, self._threshold_px
            self.errors.append(sample_direction_errors(*given, self._threads)[usable])

    def facts_per_match(self) -> float:
        """Return what `Evidence` says: a track of k keypoints, each in k - 1 pairs, gives 2 k - 3 facts."""
        counts, numbers = np.unique(self._num_pairs_of[self._num_pairs_of > 0], return_counts=True)
        counts = counts.astype(np.float64)
        facts = numbers @ ((2.0 * counts - 1.0) / (counts + 1.0))
        return min(1.0, float(facts / max(0.5 * (numbers @ counts), 1.0)))


def view_graph(images: Images, directions: PairDirections) -> ViewGraph:
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
        images.num_images,
        directions.pairs[usable],
        directions.directions[usable],
        directions.weights()[usable],
        names=images.names,
    )


def wants_points(source: MatchSource, options: NodeOptions) -> PointNodes:
    """Return whether 3D points join the view graph, "auto" where that depends on what the pairs hold."""
    is_wanted = options.uses_points(source.images.num_images) and source.memory_plan.points
    return options.points if is_wanted else "never"


def build_graph(
    images: Images, measured: MeasuredPairs, nodes: NodeOptions, *, checked: bool = False
) -> MeasuredGraph:
    """Return the graph of the usable directions, with 3D points as further nodes if there are tracks.

    If `checked`, with those of the checked tracks alone. But many cameras that their pairs hold need none,
    unless they are wanted always.
    """
    directions, joiner = measured.directions, measured.tracks
    graph, covariance = view_graph(images, directions), directions.covariance[directions.usable()]
    if joiner is None or (nodes.points == "auto" and _is_held_by_pairs(graph)):
        return MeasuredGraph(graph, covariance=covariance)
    tracks = joiner.checked_tracks() if checked else joiner.tracks()
    chosen = tracks.subset(covering_set(tracks, images.num_images))
    return join_points(graph, covariance, chosen, 1.0 / images.focal_lengths_px)


def _is_held_by_pairs(graph: ViewGraph) -> bool:
    """Return whether the pairs alone hold many cameras: rigidly, each by many pairs of many directions."""
    if graph.num_nodes < _MANY_CAMERAS or quantile(graph.degrees(), _FEW_CAMERAS) < _MANY_PAIRS:
        return False
    spread = direction_spread(graph.num_nodes, graph.edges, graph.directions)
    is_spread = quantile(spread, _FEW_CAMERAS) >= _WIDELY_SPREAD
    return bool(is_spread) and is_parallel_rigid(graph.num_nodes, graph.edges, graph.dimension)


def add_evidence(graph: MeasuredGraph, measured: MeasuredPairs) -> MeasuredGraph:
    """Return the graph with what the matches say of its cameras.

    The errors of directions to points are independent draws of their own covariance. The samples of
    `measured` are given up part by part, since they are the largest arrays of a placement.
    """
    assert graph.covariance is not None
    directions, usable = measured.directions, measured.directions.usable()
    ray_covariance = graph.covariance[len(usable) :]
    errors = None
    if measured.errors is not None:
        errors = np.empty((graph.graph.num_edges, NUM_SAMPLES, ray_covariance.shape[1]))
        filled = 0
        while measured.errors:
            part = measured.errors.pop(0)
            errors[filled : filled + len(part)] = part
            filled += len(part)
        drawn = errors[filled:]  # in place
        np.random.default_rng(0).standard_normal(out=drawn)
        drawn *= np.sqrt(np.diagonal(ray_covariance, axis1=1, axis2=2))[:, None, :]
    evidence = Evidence(
        contradicting=directions.pairs[directions.contradicting()].reshape(-1, 2),
        errors=errors,
        facts_per_match=measured.facts_per_match,
    )
    return replace(graph, evidence=evidence)
