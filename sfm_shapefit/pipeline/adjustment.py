"""Placed cameras adjusted to the pixels: centers and points, and rotations as far as they are doubtful.

Directions of pairs are placed with the rotations that are given. What is left to gain is joint: all tracks at
once, and rotations that the matches know better than whoever gave them.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment.bundle_adjustment import adjust_placement
from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.geometry import normalized, rotation_angles_deg, tangent_bases
from sfm_shapefit.facts.options import PlacingOptions, Rotations
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.pairs.estimate import estimate_directions
from sfm_shapefit.pairs.options import DirectionOptions
from sfm_shapefit.pairs.pair_directions import PairDirections, concatenate
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.pipeline.rigs import rigid_parts
from sfm_shapefit.pipeline.seed import Located, PosedPart, pose_images, posed_part, read_links
from sfm_shapefit.placement.move import move_cameras
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.placement.prior_refinement import pull_to_priors
from sfm_shapefit.refinement.options import PlacementOptions
from sfm_shapefit.scene.given import PositionPriors
from sfm_shapefit.scene.images import Images

_SAID_OF_MATCHES = (
    "num_inliers",
    "num_rivals",
    "cheirality_fraction",
    "median_residual_px",
    "parallax_deg",
)


def pull_of_rotations(rotations: Rotations) -> float | None:
    """Return by which standard deviation given rotations pull, see `Freedom`; None: as the matches say."""
    if not isinstance(rotations, str):
        return math.radians(rotations)
    return {"auto": None, "held": 0.0, "free": math.inf}[rotations]


def pull_cameras(
    images: Images, located: Located, priors: PositionPriors, options: PlacementOptions
) -> Located:
    """Return the cameras pulled by position priors, which hold the gauge from here on.

    Raises:
        UnsolvableError: if the factor would take more memory than the options allow.
    """
    pulled = pull_to_priors(located.placement, located.gauge, priors, options)
    frames = images.frame_of[pulled.placement.nodes[pulled.anchors.indices]]
    given = located.given._replace(centers=pulled.anchors._replace(indices=frames))
    return located._replace(placement=pulled.placement, gauge=pulled.gauge, given=given)


class AfterAdjustment(NamedTuple):
    """What an adjustment makes of the placement that it started from."""

    source: MatchSource
    """At the adjusted rotations."""
    directions: PairDirections
    """Measured anew at these, as far as they are usable there too."""
    placement: Placement
    """Moved to the adjusted centers, with those directions."""
    adjusted: Estimate
    """How it went."""
    part: PosedPart
    """The images that were adjusted, as they were before."""


def adjust_placed(
    source: MatchSource,
    directions: PairDirections,
    located: Located,
    options: PlacingOptions,
    clock: Clock,
    pull_rad: float | None,
) -> AfterAdjustment:
    """Adjust all placed cameras, in the gauge that was chosen; `pull_rad` is that of their rotations.

    Raises:
        UnsolvableError: if no point can be triangulated.
    """
    images, placement = source.images, located.placement
    everyone = located._replace(kept=np.ones(len(placement.cameras), dtype=np.bool_))
    posed = posed_part(pose_images(images, everyone))
    links = read_links(source, everyone, posed, clock.advance)
    freedom, given = replace(located.freedom, pull_rad=pull_rad), located.given_of(posed, images)
    adjusted = adjust_placement(posed.images, links, options.structure, freedom, given)
    del links
    similarity, centers = located.gauge.similarity, np.empty((images.num_images, 3))
    centers[posed.rows] = adjusted.images.centers
    locations = (centers[placement.cameras] - similarity.translation) / similarity.scale
    if not adjusted.freedom.holds_rotations or adjusted.lenses.sigmas or adjusted.sensors:
        source = source.at(images.turned(adjusted.images))
        corrected = posed.frames[np.broadcast_to(adjusted.freedom.singled_out(), len(posed.frames))]
        is_corrected = np.isin(images.frame_of, corrected)
        directions = _measure_again(source, directions, is_corrected, options.directions, clock)
        turns = source.images.rotations.transpose(0, 2, 1) @ images.rotations
        measured = _turn(placement.measured, directions, turns)
        if adjusted.sensors:  # which stand elsewhere in their frames now
            measured = rigid_parts(source.images, located.fixed_images(images)).apply(measured)
        placement = replace(placement, measured=measured)
    return AfterAdjustment(source, directions, move_cameras(placement, locations), adjusted, posed)


def with_uncertainty(placement: Judged, images: Images, known: Estimate, scale: float) -> Judged:
    """Return the placement with what an adjustment knows of its errors, `scale` to the solver's unit."""
    if known.covariances is None:
        return placement
    own = np.full((len(placement.cameras), 3, 3), np.nan)
    _, rows, there = np.intersect1d(
        images.ids[placement.cameras], known.images.ids, assume_unique=True, return_indices=True
    )
    own[rows] = known.covariances[there] / scale**2
    return replace(placement, adjusted_covariances=own, scale_sigma=known.scale_sigma)


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
    batches = source.view.batches(without=others, advance=clock.advance)
    again = concatenate([estimate_directions(batch, options, clock.threads) for batch in batches])
    rows = again.usable()
    is_anew = corrected[again.pairs[rows]].any(axis=1)
    taken = {"directions": rows, **dict.fromkeys(_SAID_OF_MATCHES, rows[is_anew])}
    merged = {name: getattr(before, name).copy() for name in taken}
    for name, chosen in taken.items():
        merged[name][usable[chosen]] = getattr(again, name)[chosen]
    return replace(before, **merged)


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
