"""The stages from rotations to a model, in the order in which they run; each leads from a state to a state.

    begin_model          `starts`: rotations as given, corrected where rough, made finer where averaged
    measure_directions   directions of all pairs, and what joins points
    place_rigid_pieces   the convex starts, refined; or, after a first placement, the certificate near it
    adjust_cameras       by priors that pull, whose gauge then stays, and by the pixels
    judge_piece          pairs, cameras and lenses, once; who is trusted is in the output
    seed_model           points triangulated, cameras without support left out
    set_gauge            scale, origin and axes of what is left
    examine_model        evidence that the fit did not use
    finish_model         `finish`: the result

Each rigid piece goes through all stages after `place_rigid_pieces`. A further piece has an arbitrary
scale: nothing that is known of positions says how large it is, and where it stands.
"""

from dataclasses import replace

import numpy as np

from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import median_spread
from sfm_shapefit.base.wording import counted, first_of
from sfm_shapefit.facts.result import LocateResult
from sfm_shapefit.judgement.doubted import confirm_cameras
from sfm_shapefit.judgement.judged import Judged, judge
from sfm_shapefit.judgement.measured_pairs import MeasuredPairs
from sfm_shapefit.pipeline.camera_adjustment import adjust_placed, pull_cameras, with_uncertainty
from sfm_shapefit.pipeline.doubts import ask_pairs, doubt_cameras
from sfm_shapefit.pipeline.examination import confirm_by_pixels, open_beyond_noise, question, shape_of
from sfm_shapefit.pipeline.finish import finish_model
from sfm_shapefit.pipeline.gauge_choice import bring_to_gauge, bring_to_known
from sfm_shapefit.pipeline.measure import MeasureRequest, build_graph, measure, wants_points
from sfm_shapefit.pipeline.memory import count_work, keep_within_memory
from sfm_shapefit.pipeline.placing import PlacingSetup, may_be_checked, place_measured
from sfm_shapefit.pipeline.seed import seed_points, select_trusted
from sfm_shapefit.pipeline.state import ModelState
from sfm_shapefit.placement.fixed_and_rigged import FixedAndRigged
from sfm_shapefit.placement.gauge import tell_scale
from sfm_shapefit.placement.place import Placement

_SMALLEST_ADJUSTED = 8
"""Cameras of a further piece that is adjusted; smaller ones are placed and seeded only, for their seconds."""


def run_stages(state: ModelState, clock: Clock) -> LocateResult:
    """Lead a state that was begun to the models of its rigid pieces, the largest first."""
    pieces, results = place_rigid_pieces(measure_directions(state, clock), clock), list[LocateResult]()
    while pieces:  # a piece is given up when it is finished: its samples of errors are large
        state = adjust_cameras(pieces.pop(0), clock)
        state = judge_piece(state, clock)
        state = seed_model(state, clock)
        state = set_gauge(state)
        state = examine_model(state, clock)
        results.append(finish_model(state, clock))
    return replace(results[0], further=tuple(results[1:]))


def measure_directions(state: ModelState, clock: Clock) -> ModelState:
    """Measure the directions of all pairs, and what else one pass over the matches yields."""
    source, options = state.source, state.inputs.options
    with clock("directions"):
        checked = state.first is None and not state.rigid.has_scale  # offsets do what points do
        tracks, samples = wants_points(source, options.nodes), source.memory_plan.samples
        wanted = MeasureRequest(tracks, checked, samples, facts=True)
        return replace(state, measured=measure(source, options.directions, clock, wanted))


def place_rigid_pieces(state: ModelState, clock: Clock) -> list[ModelState]:
    """Place the rigid pieces of the view graph, the largest first; what was measured is given up for that.

    UnsolvableError: if the directions determine nothing.
    """
    images, options, measured = state.source.images, state.inputs.options, state.measured
    with clock("solve"):
        graph = state.rigid.apply(build_graph(images, measured, options.nodes))
        work = count_work(state.source, measured.directions, options)
        if state.first is not None and state.inputs.known.priors is None:  # see `adjust_cameras`
            work = replace(work, adjusts=False)
        plan, graph = keep_within_memory(graph, work, options, state.source.memory_plan)
        measured = measured if plan.samples else replace(measured, errors=None)
        limited = plan.limit(options.placement)
        setup = PlacingSetup(images, limited, options.nodes, clock, state.near)
        if not (measured.checks and may_be_checked(graph)):
            measured = replace(measured, tracks=None)  # which are large
        directions = MeasuredPairs(directions=measured.directions)
        state = replace(state, source=state.source.at(images, plan), measured=directions)
        placements = place_measured(setup, graph, measured)
    return [_begin_piece(state, placement) for placement in placements]


def _begin_piece(state: ModelState, placement: Placement) -> ModelState:
    if placement.piece:
        free = np.zeros_like(state.inputs.fixed)
        inputs = replace(state.inputs.without_positions(), fixed=free)
        state = replace(
            state, inputs=inputs, rigid=FixedAndRigged(free, None, None), near=None, first=None, warnings=()
        )
    plan, priors = state.source.memory_plan.statement, state.inputs.known.priors
    if priors is not None:
        state = state.warned(*priors.notes)
    if plan:
        limit = f"max_memory_mb={state.inputs.options.memory.max_memory_mb}"
        state = state.warned(f"to stay below {limit}, {plan}")
    if names := state.source.matches.missing_names:
        state = state.warned(
            f"the database lacks {counted(len(names), 'image')} of the model: {first_of(names)}"
        )
    return replace(state, placement=placement).framed()


def adjust_cameras(state: ModelState, clock: Clock) -> ModelState:
    """Adjust the placed cameras by position priors, and by the pixels unless a first placement was."""
    state = pull_cameras(state)
    options, num_cameras = state.inputs.options, len(state.placement.cameras)
    is_small = state.placement.piece > 0 and num_cameras < _SMALLEST_ADJUSTED
    adjusts = options.placement.refines and options.freedom.adjusts_cameras(num_cameras)
    is_done = state.first is not None and state.held is None
    if is_done or is_small or not (adjusts and state.source.memory_plan.adjustment):
        return state
    with clock("adjustment"):
        try:
            return adjust_placed(state, clock)
        except UnsolvableError as error:
            return state.failed(f"its cameras are not adjusted to the pixels: {error}")


def judge_piece(state: ModelState, clock: Clock) -> ModelState:
    """Judge pairs and cameras where they stand, and choose who is in the output."""
    source, relative, fit = state.source, None, state.fit_rotations
    with clock("trust"):
        if state.inputs.pull_rad != 0.0 and not fit.all():  # else the given rotations are believed
            relative = ask_pairs(source, state.directions, clock.threads, state.among)
        judged = judge(state.placement, source.memory_plan.limit(state.inputs.options.placement))
        if not source.has_database:  # its points were made for one placement, and hold no second one
            judged = replace(judged, second_configuration=None)
        judged = _with_known_errors(judged, state).without_error_samples()
        fitting = None if source.has_database else fit[judged.cameras]
        sigma_rad = state.inputs.rough_rad or state.inputs.pull_rad or np.inf
        doubted = doubt_cameras(judged, state.directions, relative, source.images, fitting, sigma_rad)
        return _choose(state, doubted)


def _with_known_errors(judged: Judged, state: ModelState) -> Judged:
    """Return the piece with the errors of the last adjustment, of the first placement if there is no other.

    The first placement knows no errors of a piece of which it has fewer than two cameras, or all at one
    place.
    """
    images = state.source.images
    if state.adjustment is not None:
        return with_uncertainty(judged, images, state.adjustment, state.frame.similarity.scale)
    if state.first is None or state.near is None:
        return judged
    centers = state.near.locations[judged.cameras]
    common = np.isfinite(centers).all(axis=1)
    if common.sum() < 2:
        return judged
    old, new = median_spread(centers[common]), median_spread(judged.locations[common])
    return with_uncertainty(judged, images, state.first, old / new) if min(old, new) > 0.0 else judged


def _choose(state: ModelState, judged: Judged) -> ModelState:
    """Return the state with the cameras that are trusted or fixed, in a frame found anew for them."""
    kept = select_trusted(judged, state.inputs.options.trust.min_trust)
    if state.held is None:
        kept |= state.inputs.fixed[judged.cameras]
    return replace(state, placement=judged, kept=kept).framed()


def seed_model(state: ModelState, clock: Clock) -> ModelState:
    """Give the kept cameras points; once more where the pixels confirm a camera that was left out."""
    seeded = seed_points(state, clock)
    with clock("trust"):
        by_pixels = confirm_by_pixels(seeded)
    if by_pixels.any():
        judged = state.judged
        assessment = confirm_cameras(judged.assessment, by_pixels[judged.cameras])
        confirmed = _choose(state, replace(judged, assessment=assessment))
        if (by_pixels & ~seeded.images.is_posed).any():
            seeded = seed_points(confirmed, clock, by_pixels)
        else:
            seeded = replace(seeded, placement=confirmed.placement, kept=confirmed.kept)
    seeded = replace(seeded, kept=seeded.kept & seeded.images.is_posed[seeded.placement.cameras])
    if seeded.bundle is None:
        return seeded
    lenses = state.source.images.lenses_of(seeded.bundle.images)
    scale = seeded.frame.similarity.scale
    judged = with_uncertainty(seeded.judged, seeded.source.images, seeded.bundle, scale)
    return replace(seeded, placement=judged, intrinsics=state.intrinsics.after(seeded.bundle, lenses))


def set_gauge(state: ModelState) -> ModelState:
    """Bring a model with points to the scale, origin and axes of the output."""
    state = state.warned(state.frame.warning) if state.frame.warning else state
    state = bring_to_known(bring_to_gauge(state))
    return replace(state, gauge=tell_scale(state.gauge, state.judged.scale_sigma))


def examine_model(state: ModelState, clock: Clock) -> ModelState:
    """Ask for evidence that the fit did not use; nothing says where groups stand that hang loose by it."""
    with clock("trust"):
        evidence, shape, judged = question(state, clock), shape_of(state, clock.threads), state.judged
        if shape is not None:
            judged = replace(judged, open_covariances=open_beyond_noise(state, shape))
        for group in (group for group in evidence.untied if group.is_loose):
            judged = judged.loosened(state.images.are_named(group.images)[judged.cameras])
        return replace(state, placement=judged, evidence=replace(evidence, shape=shape))
