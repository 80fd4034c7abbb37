"""From rotations to models: what `locate` and `map` have in common, stage after stage, piece by piece.

    measure   directions of all pairs, and the view graph of the usable ones
    place     rigid pieces: the convex starts, refined; or, after a first placement, the certificate near it
    pull      position priors that pull, whose gauge then stays
    adjust    centers, points and doubtful rotations, by the pixels; directions are measured again there
    judge     pairs, cameras and lenses, once
    seed      the COLMAP model: points triangulated, cameras without support left out
    gauge     scale, origin and axes of what is left

Each rigid piece goes through all that follows `place`. A further piece has a unit of its own: nothing that is
told of positions says how large it is, and where.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.free_sensors import SensorSigma
from sfm_shapefit.adjustment.freedom import Freedom
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import median_spread
from sfm_shapefit.facts.intrinsics import NO_DOUBTS, DoubtedIntrinsics, intrinsics_warnings
from sfm_shapefit.facts.options import PlacingOptions
from sfm_shapefit.facts.result import Inputs, LocateResult
from sfm_shapefit.facts.rigs import refined_rigs
from sfm_shapefit.facts.warnings import (
    ambiguity_warnings,
    focal_warnings,
    match_warnings,
    prior_warnings,
    quality_warnings,
    support_warnings,
    trust_warnings,
)
from sfm_shapefit.files.colmap.seed import build_seed
from sfm_shapefit.files.colmap.template import Template
from sfm_shapefit.judgement.judged import Judged, judge
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.pipeline.adjustment import (
    adjust_placed,
    pull_cameras,
    turned_deg,
    with_uncertainty,
)
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.pipeline.control_points import bring_to_control_points
from sfm_shapefit.pipeline.doubts import ask_pairs, doubt_cameras, question_focal_lengths
from sfm_shapefit.pipeline.first_placement import FirstPlacement
from sfm_shapefit.pipeline.gauge_choice import SETS_SCALE, GaugeRule
from sfm_shapefit.pipeline.gravity import turn_model_upright
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.pipeline.measure import (
    Wanted,
    add_evidence,
    build_graph,
    count_work,
    measure,
    wants_points,
)
from sfm_shapefit.pipeline.memory import describe_work, keep_within_memory
from sfm_shapefit.pipeline.rigs import Rigid, place_cameras
from sfm_shapefit.pipeline.seed import Located, seed_points, select_trusted
from sfm_shapefit.placement.gauge import Gauge, tell_scale
from sfm_shapefit.placement.options import KnownDistance, Scale
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.placement.prior_pairs import compare_with_priors
from sfm_shapefit.refinement.options import PlacementOptions
from sfm_shapefit.scene.freedom import RigFreedom
from sfm_shapefit.scene.given import ControlPoints, Gravity, PositionPriors
from sfm_shapefit.scene.images import Images

_SMALLEST_ADJUSTED = 8
"""Cameras of a further piece that is adjusted; smaller ones are placed and seeded only, for their seconds."""


class Told(NamedTuple):
    """What is known of the images beside their matches and the options."""

    template: Template
    """What the images were read from."""
    given: Images
    """The images as they were read."""
    inputs: Inputs
    rigid: Rigid
    pull_rad: float | None
    """How an adjustment treats the rotations, see `Freedom`; None: as the matches say."""
    scale: Scale = "unit"
    """Where nothing that is known sets it."""
    distances: tuple[KnownDistance, ...] = ()
    priors: PositionPriors | None = None
    control: ControlPoints | None = None
    gravity: Gravity | None = None
    """Turns the model upright."""
    intrinsics: DoubtedIntrinsics = NO_DOUBTS
    """Which intrinsics are in doubt, and what became of them so far."""
    near: FirstPlacement | None = None
    """Where an adjustment has the images already; None if there was none."""

    def of_further_piece(self) -> "Told":
        """Return what is told of a further rigid piece: nothing of positions."""
        free = self.rigid._replace(fixed=np.zeros_like(self.rigid.fixed), groups=None, fixed_group=None)
        return self._replace(
            rigid=free, scale="unit", distances=(), priors=None, control=None, gravity=None, near=None
        )

    def frees_rigs(self, asked: RigFreedom) -> bool:
        """Return whether the adjustments change where sensors stand in their rigs, if there are any."""
        return asked == "free" and self.rigid.groups is not None

    @property
    def believes_rotations(self) -> bool:
        """Whether the given rotations are not to be doubted."""
        return self.pull_rad == 0.0


class Stand(NamedTuple):
    """Where the cameras of one rigid piece stand, and by what."""

    source: MatchSource
    """The matches, at the rotations that the piece has now."""
    directions: PairDirections
    located: Located
    intrinsics: DoubtedIntrinsics
    estimate: Estimate | None = None
    """Of the last adjustment; None if there was none."""
    scale: float = 1.0
    """From the solver's units to those of the estimate."""
    adjustment: Estimate | None = None
    """How this placement was adjusted; None if it was not."""


def settle(opened: MatchSource, told: Told, options: PlacingOptions, clock: Clock) -> LocateResult:
    """Place the cameras of an open source, and make the seeded models of its rigid pieces, the largest first.

    Args:
        opened: the images, at their rotations, and their matches.
        told: of the images.
        options: settings.
        clock: of the run.
    """
    with clock("directions"):
        wanted = Wanted(tracks=wants_points(opened, options.nodes), errors=opened.economy.samples)
        measured = measure(opened, options.directions, clock, wanted)
    directions = measured.directions
    with clock("solve"):
        graph = told.rigid.apply(build_graph(opened.images, measured))
        work = count_work(opened, directions)
        describe = partial(describe_work, work=work, placement=options.placement, freedom=options.freedom)
        economy, graph = keep_within_memory(graph, describe, options.memory.max_memory_mb, opened.economy)
        source = opened.at(opened.images, economy)
        graph = add_evidence(graph, measured if economy.samples else replace(measured, errors=None))
        del measured
        near = None if told.near is None else told.near.stand
        pieces = list(place_cameras(graph, economy.limit(options.placement), options.nodes, clock, near))
        del graph
    models = []
    while pieces:  # a piece is given up when it is finished: its samples of errors are large
        piece = pieces.pop(0)
        own = told if piece.piece == 0 else told.of_further_piece()
        models.append(finish_piece(source, directions, piece, own, options, clock))
    return replace(models[0], further=tuple(models[1:]))


def finish_piece(
    source: MatchSource,
    directions: PairDirections,
    placement: Placement,
    told: Told,
    options: PlacingOptions,
    clock: Clock,
) -> LocateResult:
    """Take one rigid piece from its placement to its model.

    Args:
        source: the images and their matches, at the rotations that were placed with.
        directions: of all pairs.
        placement: of the piece.
        told: of its images.
        options: settings.
        clock: of the run.
    """
    before = source.images
    started = _start(source, directions, placement, told, options)
    stand = _adjust(started, told, options, clock)
    with clock("trust"):
        # Adjusted rotations have made up for a part of what a wrong focal length does to the given ones.
        asked = stand if told.intrinsics.free.doubts else started
        is_main = placement.piece == 0  # the lenses of a further piece are asked with those of all
        focal_doubts = (
            question_focal_lengths(asked.source, asked.directions, clock.threads) if is_main else ()
        )
        judged = _judge(stand, told, options, before, clock)
        located = _choose(stand.located, judged, options.trust.min_trust)
    del started, placement  # with their samples of errors
    seeded = seed_points(stand.source, located, options, clock)
    moves = located.placement.unit is None and not told.rigid.fixed.any()
    seeded, control_points, of_control = bring_to_control_points(
        seeded, told.control, options.structure, moves=moves
    )
    seeded, of_gravity = turn_model_upright(seeded, told.gravity)
    intrinsics = stand.intrinsics
    if seeded.adjusted is not None:
        scale = located.gauge.similarity.scale
        judged = with_uncertainty(judged, before, seeded.adjusted, scale)
        intrinsics = intrinsics.after(seeded.adjusted.lenses, seeded.adjusted.freedom.lenses)
    sensors = _refined_sensors(stand, told, seeded.adjusted)
    focal_doubts = tuple(doubt for doubt in focal_doubts if doubt.camera not in intrinsics.refined.sigmas)
    gauge = tell_scale(seeded.gauge, judged.scale_sigma)
    images, directions = seeded.images, stand.directions
    unsupported = [images.names[k] for k in np.flatnonzero(seeded.unsupported).tolist()]
    centers = images.centers
    with clock("model"):
        keypoints = stand.source.view.keypoints if stand.source.has_database else None
        reconstruction = build_seed(told.template, images, seeded.points, keypoints)
    prior_angles = None
    if told.priors is not None and gauge.scale == "prior" and gauge.axes is not None:
        prior_angles = compare_with_priors(
            directions.pairs, directions.directions, told.priors, gauge, centers
        )
    return LocateResult(
        reconstruction=reconstruction,
        inputs=told.inputs,
        options=options,
        images=stand.source.images,
        placed=images,
        image_names=told.template.image_names,
        directions=directions,
        placement=judged,
        kept=located.kept & images.is_posed[judged.cameras],
        num_seen=seeded.num_seen,
        unsupported=seeded.unsupported,
        agreeing_observations=seeded.observations.agreeing,
        contradicting_observations=seeded.observations.contradicting,
        gauge=gauge,
        adjusted=seeded.adjusted,
        adjustment=stand.adjustment,
        turned_deg=None
        if stand.adjustment is None
        else turned_deg(before.rotations, stand.source.images.rotations),
        timings_s=clock.seconds,
        warnings=(
            *focal_warnings(stand.source.images, focal_doubts, intrinsics.refined.undetermined),
            *intrinsics_warnings(intrinsics, intrinsics.rows(images)),
            *_collect_warnings(stand, judged, located, seeded.points.num_points),
            *prior_warnings(prior_angles, directions.pairs, images.names),
            *_gauge_warnings(located, gauge, centers, options.gauge.scale),
            *of_control,
            *of_gravity,
            *support_warnings(unsupported, is_kept=options.trust.min_trust == 0.0),
        ),
        fixed=told.rigid.fixed,
        distances=told.distances,
        prior_angles=prior_angles,
        focal_doubts=focal_doubts,
        intrinsics=intrinsics,
        rigs=refined_rigs(told.given, images, sensors),
        control_points=tuple(control_points),
    )


def _start(
    source: MatchSource, directions: PairDirections, placement: Placement, told: Told, options: PlacingOptions
) -> Stand:
    """Return where the cameras of a piece stand before they are adjusted, in the frame that is worked in.

    That frame is the gauge of all placed cameras, or that of priors that pull, which then stays.
    """
    rule = GaugeRule(told.given, told.rigid, told.scale, told.priors, told.distances)
    everyone = np.ones(len(placement.cameras), dtype=np.bool_)
    gauge = rule.choose(placement.cameras, placement.locations, placement.unit)
    freedom = Freedom(lenses=told.intrinsics.free, has_sensors=told.frees_rigs(options.freedom.rigs))
    located = Located(placement, everyone, gauge, told.rigid.fixed, rule, freedom=freedom)
    located = _pull(source.images, located, told, source.economy.limit(options.placement))
    stand = Stand(source, directions, located, told.intrinsics)
    if told.near is None:
        return stand
    centers = told.near.stand.locations[placement.cameras]
    scale = median_spread(centers) / median_spread(placement.locations)
    return stand._replace(estimate=told.near.adjusted, scale=scale)


def _pull(images: Images, located: Located, told: Told, options: PlacementOptions) -> Located:
    """Return the cameras pulled by the priors that have set the gauge, each by its standard deviation.

    Priors without one do not pull, nor do those whose axes are not known.
    """
    if told.priors is None or told.control is not None or located.gauge.scale != "prior":
        return located
    priors = told.priors.with_sigmas()
    if not len(priors.of(located.placement.cameras)) or located.gauge.axes is None:
        return located
    with suppress(UnsolvableError):  # too large a factor
        return pull_cameras(images, located, priors, options)
    return located


def _adjust(stand: Stand, told: Told, options: PlacingOptions, clock: Clock) -> Stand:
    """Adjust the placed cameras, if that is wanted and was not done before."""
    located = stand.located
    num_cameras, is_pulled = len(located.placement.cameras), located.given.centers is not None
    is_small = located.placement.piece > 0 and num_cameras < _SMALLEST_ADJUSTED
    adjusts = options.placement.refines and options.freedom.adjusts_cameras(num_cameras)
    adjusts = adjusts and stand.source.economy.adjustment
    if is_small or (told.near is not None and not is_pulled) or not adjusts:
        return stand
    with clock("adjustment"), suppress(UnsolvableError):  # without points there is nothing to adjust
        after = adjust_placed(stand.source, stand.directions, located, options, clock, told.pull_rad)
        frames, freedom = stand.source.images.frames, after.adjusted.freedom
        intrinsics = stand.intrinsics.after(after.adjusted.lenses, freedom.lenses)
        given = located.given._replace(rotations=frames.rotations)
        freedom = freedom.among(after.part.frames, len(frames.ids))
        return Stand(
            source=after.source,
            directions=after.directions,
            located=located._replace(placement=after.placement, given=given, freedom=freedom),
            intrinsics=intrinsics,
            estimate=after.adjusted,
            scale=located.gauge.similarity.scale,
            adjustment=after.adjusted,
        )
    return stand


def _judge(stand: Stand, told: Told, options: PlacingOptions, before: Images, clock: Clock) -> Judged:
    """Return the evidence for a piece where its cameras stand, without the samples of errors that it took."""
    placement, relative = stand.located.placement, None
    if not told.believes_rotations:
        among = placement.cameras if placement.piece else None
        relative = ask_pairs(stand.source, stand.directions, clock.threads, among)
    judged = judge(placement, stand.source.economy.limit(options.placement))
    if stand.estimate is not None:
        judged = with_uncertainty(judged, before, stand.estimate, stand.scale)
    return doubt_cameras(judged.without_error_samples(), stand.directions, relative, stand.source.images)


def _choose(located: Located, judged: Judged, min_trust: float) -> Located:
    """Return which of the judged cameras are in the output, in a gauge that is found anew for them.

    Where priors hold the gauge it stays.
    """
    kept = select_trusted(judged, min_trust)
    if located.given.centers is None and located.rule is not None:
        kept |= located.rule.rigid.fixed[judged.cameras]
        gauge = located.rule.choose(judged.cameras[kept], judged.locations[kept], judged.unit)
        located = located._replace(gauge=gauge)
    return located._replace(placement=judged, kept=kept)


def _refined_sensors(stand: Stand, told: Told, adjusted: Estimate | None) -> dict[int, SensorSigma]:
    """Return how well the sensors are known that moved in their rigs, by the last adjustment of each.

    Raises:
        InputError: if they were to move, but nothing was adjusted.
    """
    first = None if told.near is None else told.near.adjusted
    sensors: dict[int, SensorSigma] = {}
    for done in (first, stand.adjustment, adjusted):
        sensors |= {} if done is None else done.sensors
    if stand.located.freedom.has_sensors and not sensors:
        raise InputError("there is nothing to adjust, so that rigs cannot be refined; leave out rigs=free")
    return sensors


def _gauge_warnings(located: Located, gauge: Gauge, centers: FloatArray, asked: Scale) -> Iterator[str]:
    """Yield what else is known of the size of a model and contradicts it, or did not get its way."""
    there = np.flatnonzero(np.isfinite(centers[:, 0]))
    if located.rule is not None:
        yield from located.rule.check(gauge, there, centers[there])
    if asked == "unit" and gauge.scale != "unit":
        yield f"the scale unit was not used, but that of {SETS_SCALE[gauge.scale]}"


def _collect_warnings(stand: Stand, judged: Judged, located: Located, num_points: int) -> Iterator[str]:
    """Yield what the user should know of pairs, cameras, points and the database beyond the tables."""
    yield from match_warnings(stand.directions)
    yield from quality_warnings(judged)
    yield from trust_warnings(judged, located.kept)
    yield from ambiguity_warnings(judged)
    if located.gauge.warning:
        yield located.gauge.warning
    if stand.source.economy.statement:
        yield f"to stay below max_memory_mb, {stand.source.economy.statement}"
    if num_points == 0:
        yield "no 3D point could be triangulated; bundle adjustment has nothing to start from"
    if names := stand.source.matches.missing_names:
        yield f"{len(names)} images of the model are not in the database, {names[0]} for one"
