"""Placed cameras adjusted to the pixels: centers and points, and rotations as far as they are doubtful.

Directions of pairs are placed with the rotations that are given. What is left to gain is joint: all tracks at
once, and rotations that the matches know better than whoever gave them.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment.adjusted import AdjustedPlacement, Uncertainty
from sfm_shapefit.adjustment.bundle_adjustment import adjust_placement
from sfm_shapefit.adjustment.given_rotations import RotationWeight
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import normalized, rotation_angles_deg, tangent_bases
from sfm_shapefit.facts.options import PlacingOptions, Rotations
from sfm_shapefit.files.colmap.model import PosedModel, with_frame_rotations
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.pairs.estimate import estimate_directions
from sfm_shapefit.pairs.options import DirectionOptions
from sfm_shapefit.pairs.pair_directions import PairDirections, concatenate
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.pipeline.rigs import rigid_parts
from sfm_shapefit.pipeline.seed import Located, read_tracks, seed_of
from sfm_shapefit.placement.move import move_cameras
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.placement.prior_refinement import pull_to_priors
from sfm_shapefit.refinement.options import PlacementOptions
from sfm_shapefit.scene.given import PositionPriors
from sfm_shapefit.scene.matches import MatchBatch

_SAID_OF_MATCHES = (
    "num_inliers",
    "num_rivals",
    "cheirality_fraction",
    "median_residual_px",
    "parallax_deg",
)


def weight_of_rotations(rotations: Rotations) -> RotationWeight | None:
    """Return how given rotations are treated; None: as the matches say."""
    if not isinstance(rotations, str):
        return RotationWeight(sigma_rad=math.radians(rotations))
    return {"auto": None, "held": RotationWeight(hold=True), "free": RotationWeight()}[rotations]


def pull_cameras(
    model: PosedModel, located: Located, priors: PositionPriors, options: PlacementOptions
) -> Located:
    """Return the cameras pulled by position priors, which hold the gauge from here on.

    Raises:
        UnsolvableError: if the factor would take more memory than the options allow.
    """
    pulled = pull_to_priors(located.placement, located.gauge, priors, options)
    frame_ids = model.frame_ids[pulled.placement.nodes[pulled.anchors.indices]]
    given = located.given._replace(centers=pulled.anchors._replace(indices=frame_ids))
    return located._replace(placement=pulled.placement, gauge=pulled.gauge, given=given)


class AfterAdjustment(NamedTuple):
    """What an adjustment makes of the placement that it started from."""

    source: MatchSource
    """At the adjusted rotations."""
    directions: PairDirections
    """Measured anew at these, as far as they are usable there too."""
    placement: Placement
    """Moved to the adjusted centers, with those directions."""
    adjusted: AdjustedPlacement
    """How it went."""


def adjust_placed(
    source: MatchSource,
    directions: PairDirections,
    located: Located,
    options: PlacingOptions,
    clock: Clock,
    weight: RotationWeight | None,
) -> AfterAdjustment:
    """Adjust all placed cameras, in the gauge that was chosen; `weight` is of their rotations.

    Raises:
        UnsolvableError: if no point can be triangulated.
    """
    model, placement = source.model, located.placement
    fixed = () if located.fixed is None else model.frame_ids[located.fixed].tolist()
    everyone = located._replace(kept=np.ones(len(placement.cameras), dtype=np.bool_))
    seed = seed_of(source, everyone)
    tracks = read_tracks(source, everyone, seed, clock.advance)
    adjusted = adjust_placement(
        seed, tracks, options.structure, weight, fixed_frames=fixed, given=located.given
    )
    images = [adjusted.reconstruction.image(i) for i in model.image_ids[placement.cameras].tolist()]
    centers = np.array([image.projection_center() for image in images])
    similarity = located.gauge.similarity
    locations = (centers - similarity.translation) / similarity.scale
    if not adjusted.weight.hold or adjusted.lenses.sigmas or adjusted.sensors:
        source = source.turned(with_frame_rotations(model, adjusted.reconstruction))
        corrected = np.array(adjusted.frame_ids)[adjusted.weight.singled_out(len(adjusted.frame_ids))]
        anew = np.isin(model.frame_ids, corrected)
        directions = _measure_again(source, directions, anew, options.directions, clock)
        turns = source.model.rotations.transpose(0, 2, 1) @ model.rotations
        measured = _turn(placement.measured, directions, turns)
        if adjusted.sensors:  # which stand elsewhere in their frames now
            measured = rigid_parts(source.model, located.fixed_images(model)).apply(measured)
        placement = replace(placement, measured=measured)
    return AfterAdjustment(source, directions, move_cameras(placement, locations), adjusted)


def with_uncertainty(placement: Judged, model: PosedModel, uncertainty: Uncertainty, scale: float) -> Judged:
    """Return the placement with what an adjustment knows of its errors, `scale` to the solver's unit."""
    covariances = uncertainty.covariances
    if not covariances:
        return placement
    unknown = np.full((3, 3), np.nan)
    ids = model.image_ids[placement.cameras].tolist()
    own = np.array([covariances.get(i, unknown) for i in ids]) / scale**2
    return replace(placement, adjusted_covariances=own, scale_sigma=uncertainty.scale_sigma)


def _measure_again(
    source: MatchSource,
    before: PairDirections,
    corrected: BoolArray,
    options: DirectionOptions,
    clock: Clock,
) -> PairDirections:
    """Return the usable directions as they are at other rotations; the others, and what is said, stay.

    Of images whose rotations were clearly wrong, and are `corrected`, it is what their matches say now.
    """
    usable = before.usable()
    others = np.delete(before.pairs, usable, axis=0)
    batches = _without_pairs(source.counted(source.batches(), clock.advance), others)
    again = concatenate([estimate_directions(batch, options, clock.threads) for batch in batches])
    rows = again.usable()
    is_anew = corrected[again.pairs[rows]].any(axis=1)
    taken = {"directions": rows, **dict.fromkeys(_SAID_OF_MATCHES, rows[is_anew])}
    merged = {name: getattr(before, name).copy() for name in taken}
    for name, chosen in taken.items():
        merged[name][usable[chosen]] = getattr(again, name)[chosen]
    return replace(before, **merged)


def _without_pairs(batches: Iterator[MatchBatch], pairs: IntArray) -> Iterator[MatchBatch]:
    """Yield the batches without some pairs (k, 2); those that have no others are left out."""
    unwanted = {(min(i, j), max(i, j)) for i, j in pairs.tolist()}
    for batch in batches:
        dropped: BoolArray = np.array(
            [tuple(pair) in unwanted for pair in batch.pairs.tolist()], dtype=np.bool_
        )
        if dropped.all():
            continue
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


def _turn(measured: MeasuredGraph, directions: PairDirections, turns: FloatArray) -> MeasuredGraph:
    """Return the measured graph with other directions; rays to points turn with their cameras (n, 3, 3).

    Covariances and samples of errors are those of before, in the bases of the new directions.
    """
    graph = measured.graph
    rays = np.flatnonzero(~measured.is_pair)
    new = graph.directions.copy()
    new[measured.pairs] = directions.directions[directions.usable()]
    new[rays] = np.einsum("kab,kb->ka", turns[graph.edges[rays, 0]], graph.directions[rays])
    bases = tangent_bases(new).transpose(0, 2, 1) @ tangent_bases(graph.directions)
    covariance, evidence = measured.covariance, measured.evidence
    if covariance is not None:
        covariance = bases @ covariance @ bases.transpose(0, 2, 1)
    if evidence is not None and evidence.errors is not None:
        evidence = replace(evidence, errors=evidence.errors @ bases.transpose(0, 2, 1))
    turned = ViewGraph(graph.num_nodes, graph.edges, normalized(new), graph.weights, graph.names)
    return replace(measured, graph=turned, covariance=covariance, evidence=evidence)


def turned_deg(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return by how many degrees rotations (n, 3, 3) turned, exactly 0 where they kept their bits."""
    same = (before == after).all(axis=(1, 2))
    return np.where(same, 0.0, rotation_angles_deg(after.transpose(0, 2, 1) @ before))
