"""Placed cameras adjusted to the pixels: centers and points, and rotations as far as they are doubtful.

Directions of pairs are placed with the rotations that are given. What is left to gain is joint: all tracks at
once, and rotations that the matches know better than whoever gave them.
"""

from dataclasses import replace
from functools import partial

import numpy as np

from sfm_shapefit.adjustment.bundle_adjustment import adjust_placement
from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.run import begin
from sfm_shapefit.adjustment.sources import links_touching
from sfm_shapefit.base.arrays import BoolArray, FloatArray, distinct
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import normalized, tangent_bases, turned_deg
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.pairs.estimate import estimate_directions
from sfm_shapefit.pairs.pair_directions import PairDirections, concatenate
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.pipeline.state import ModelState
from sfm_shapefit.placement.fixed_and_rigged import find_fixed_and_rigged
from sfm_shapefit.placement.move import move_cameras
from sfm_shapefit.placement.prior_refinement import pull_to_priors
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import is_among

_SAID_OF_MATCHES = ("num_inliers", "num_rivals", "cheirality_fraction", "median_residual_px", "parallax_deg")


def pull_cameras(state: ModelState) -> ModelState:
    """Return the cameras pulled by the priors that have set the gauge, which holds from here on.

    Priors without a standard deviation do not pull, nor do those whose axes are not known.
    """
    known = state.inputs.known
    if known.priors is None or known.sets_scale or state.frame.scale != "prior":
        return state
    priors, options = known.priors.with_sigmas(), state.inputs.options.placement
    limited = state.source.memory_plan.limit(options)
    if not len(priors.of(state.placement.cameras)) or state.frame.axes is None:
        return state
    try:
        pulled = pull_to_priors(state.placement, state.frame, priors, limited)
    except UnsolvableError as error:
        return state.failed(f"the position priors do not pull its cameras: {error}")
    frames = state.source.images.frame_of[pulled.placement.nodes[pulled.anchors.indices]]
    held = pulled.anchors._replace(indices=frames)
    if pulled.vagueness > 1.0:
        state = state.warned(
            f"the position priors are {pulled.vagueness:.2g} times as far off as their standard deviations "
            "say, and count as so vague; give larger ones"
        )
    return replace(state, placement=pulled.placement, frame=pulled.gauge, held=held)


def adjust_placed(state: ModelState, clock: Clock) -> ModelState:
    """Adjust all placed cameras, in the frame that is worked in, and measure their directions again there.

    Raises:
        UnsolvableError: if no point can be triangulated.
    """
    source, placement, options = state.source, state.placement, state.inputs.options
    images, placed = source.images, state.placed()
    rows = placed.posed_rows
    start, links = placed.part(rows), state.read_links(placed, clock.advance, clock.threads)
    if source.fixed is not None:  # points that fixed images alone see move nothing
        links = links_touching(start, links, ~source.fixed[rows])
    freedom = replace(state.freedom_of(rows), pull_rad=state.inputs.pull_rad)
    given, crew = state.given_poses(rows), state.crew_of(clock)
    adjusted = adjust_placement(begin(start, links, options.structure, freedom, given, crew))
    del links
    similarity, centers = state.frame.similarity, np.empty((images.num_images, 3))
    centers[rows] = adjusted.images.centers
    locations = (centers[placement.cameras] - similarity.translation) / similarity.scale
    measured = state.measured
    if not adjusted.freedom.holds_rotations or adjusted.is_refined.any() or adjusted.refines_sensors:
        source = source.at(images.turned(adjusted.images))
        frames = distinct(images.frame_of[rows])
        corrected = frames[np.broadcast_to(adjusted.freedom.singled_out(), len(frames))]
        is_corrected = np.isin(images.frame_of, corrected)
        directions = _measure_again(source, state.directions, is_corrected, options.directions, clock)
        measured = replace(measured, directions=directions)
        turns = source.images.rotations.transpose(0, 2, 1) @ images.rotations
        turned = _turn(placement.measured, directions, turns)
        if adjusted.refines_sensors:  # which stand elsewhere in their frames now
            turned = find_fixed_and_rigged(source.images, state.rigid.fixed).apply(turned)
        placement = replace(placement, measured=turned)
    return replace(
        state,
        source=source,
        measured=measured,
        placement=move_cameras(placement, locations),
        intrinsics=state.intrinsics.after(adjusted, distinct(images.lens_of[rows])),
        adjustment=adjusted,
        turned_deg=turned_deg(images.rotations, source.images.rotations),
    )


def with_uncertainty(placement: Judged, images: Images, known: Estimate, scale: float) -> Judged:
    """Return the placement with what an adjustment knows of its errors, `scale` to the solver's unit."""
    if known.covariances is None:
        return placement
    covariances = np.full((len(placement.cameras), 3, 3), np.nan)
    _, rows, known_rows = np.intersect1d(
        images.ids[placement.cameras], known.images.ids, assume_unique=True, return_indices=True
    )
    covariances[rows] = known.covariances[known_rows] / scale**2
    return replace(
        placement,
        adjusted_covariances=covariances,
        lens_errors=known.lens_errors,
        scale_sigma=placement.scale_sigma if known.scale_sigma is None else known.scale_sigma,
    )


def _measure_again(
    source: MatchSource,
    earlier: PairDirections,
    corrected: BoolArray,
    options: DirectionOptions,
    clock: Clock,
) -> PairDirections:
    """Return directions with the usable ones measured at other rotations; unusable ones stay as they are.

    The other columns stay, too, but for pairs of `corrected` images, whose rotations were clearly wrong.
    """
    usable = earlier.usable()
    used = earlier.pairs[usable]
    others = source.view.pairs[~is_among(source.view.pairs, used)]
    batches = source.view.batches(without=others, advance=clock.advance)
    estimate = partial(estimate_directions, options=options, threads=clock.threads)
    again = concatenate(list(source.view.measured(batches, estimate, clock.threads)))
    rows = again.usable()
    is_anew = corrected[again.pairs[rows]].any(axis=1)
    taken = {"directions": rows, **dict.fromkeys(_SAID_OF_MATCHES, rows[is_anew])}
    merged = {name: getattr(earlier, name).copy() for name in taken}
    for name, chosen in taken.items():
        merged[name][usable[chosen]] = getattr(again, name)[chosen]
    return replace(earlier, **merged)


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
