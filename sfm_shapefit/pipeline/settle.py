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

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from sfm_shapefit.adjustment.lens_doubts import excess
from sfm_shapefit.base.arrays import BoolArray, IntArray, hand_back_memory
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.executors import nobody
from sfm_shapefit.base.geometry import fit_similarity, fit_similarity_l1, median_spread
from sfm_shapefit.base.wording import counted, first_of
from sfm_shapefit.facts.intrinsics import intrinsics_warnings
from sfm_shapefit.facts.options import PlacingOptions
from sfm_shapefit.facts.result import NO_POINTS, LocateResult
from sfm_shapefit.facts.rigs import refined_rigs
from sfm_shapefit.facts.warnings import (
    ambiguity_warnings,
    match_warnings,
    prior_warnings,
    quality_warnings,
    support_warnings,
    trust_warnings,
)
from sfm_shapefit.files.colmap.points import ModelPictures
from sfm_shapefit.files.colmap.seed import SeededModel
from sfm_shapefit.files.colmap.template import Template
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.judgement.doubted import confirm_cameras
from sfm_shapefit.judgement.evidence import ModelEvidence, OpenShape, fit_pairs
from sfm_shapefit.judgement.judged import Judged, judge
from sfm_shapefit.judgement.limits import RARE
from sfm_shapefit.judgement.reasons import Kind, of_model
from sfm_shapefit.judgement.trust import LOW_TRUST
from sfm_shapefit.judgement.uncertainty import standard_deviations
from sfm_shapefit.pipeline.adjustment import adjust_placed, pull_cameras, turned_deg, with_uncertainty
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.pipeline.doubts import ask_pairs, doubt_cameras
from sfm_shapefit.pipeline.evidence import Structure, ask_pixels, ask_shape, gather_evidence, rigid_strip
from sfm_shapefit.pipeline.first_placement import FirstPlacement
from sfm_shapefit.pipeline.gauge_choice import SETS_SCALE
from sfm_shapefit.pipeline.given import Given
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.pipeline.known import bring_to_known
from sfm_shapefit.pipeline.measure import (
    Measured,
    Wanted,
    add_evidence,
    build_graph,
    count_work,
    measure,
    wants_points,
)
from sfm_shapefit.pipeline.memory import describe_work, keep_within_memory
from sfm_shapefit.pipeline.rigs import may_be_checked, place_by_checked, place_cameras
from sfm_shapefit.pipeline.seed import Seeded, seed_points, select_trusted
from sfm_shapefit.pipeline.stand import Stand, posed_part
from sfm_shapefit.placement.gauge import FEWEST_PRIORS, Gauge, coincide, tell_scale
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.placement.prior_fit import PriorFit, compare_with_priors
from sfm_shapefit.scene.images import Images
from sfm_shapefit.tracks.options import NodeOptions

_OPEN = 1e100  # squared units; larger covariances overflow, and mean that nothing holds a camera
_SMALLEST_ADJUSTED = 8
"""Cameras of a further piece that is adjusted; smaller ones are placed and seeded only, for their seconds."""


def settle(
    given: Given,
    opened: MatchSource,
    options: PlacingOptions,
    clock: Clock,
    first: FirstPlacement | None = None,
) -> LocateResult:
    """Place the cameras of an open source, and make the seeded models of its rigid pieces, the largest first.

    An adjustment may have the images already; `first` says where then.
    """
    with clock("directions"):
        checked = first is None and not given.rigid.has_scale  # offsets do what points do
        wanted = Wanted(wants_points(opened, options.nodes), checked, opened.economy.samples, facts=True)
        measured = measure(opened, options.directions, clock, wanted)
    directions = measured.directions
    with clock("solve"):
        graph = given.rigid.apply(build_graph(opened.images, measured, options.nodes))
        work = count_work(opened, directions, options)
        describe = partial(describe_work, work=work, options=options.placement)
        economy, graph = keep_within_memory(graph, describe, options.memory.max_memory_mb, opened.economy)
        source = opened.at(opened.images, economy)
        measured = measured if economy.samples else replace(measured, errors=None)
        limited, near = economy.limit(options.placement), None if first is None else first.near
        place = partial(place_cameras, options=limited, nodes=options.nodes, clock=clock, near=near)
        if not (measured.checks and may_be_checked(graph)):
            measured = replace(measured, tracks=None)  # which are large
            graph = add_evidence(graph, measured)
            del measured
            pieces = list(place(graph))
        else:
            pieces = _place_with_checked(opened.images, graph, measured, options.nodes, place)
        del graph
    models = []
    while pieces:  # a piece is given up when it is finished: its samples of errors are large
        piece = pieces.pop(0)
        own, start = (given, first) if piece.piece == 0 else (given.of_further_piece(), None)
        models.append(finish_piece(Stand.of(own, source, directions, piece, options), options, clock, start))
    return replace(models[0], further=tuple(models[1:]))


def _place_with_checked(
    images: Images,
    graph: MeasuredGraph,
    measured: Measured,
    nodes: NodeOptions,
    place: Callable[..., Iterator[Placement]],
) -> list[Placement]:
    """Return the pieces of a graph, or of that with checked points where more pairs agree with these."""
    copied = measured if measured.errors is None else replace(measured, errors=list(measured.errors))
    pieces = list(place(add_evidence(graph, copied)))
    checked = partial(build_graph, images, measured, nodes, checked=True)
    better = place_by_checked(pieces[0], checked, partial(place, certified=False))
    return pieces if better is None else list(place(add_evidence(better[0], measured)))


def finish_piece(
    placed: Stand, options: PlacingOptions, clock: Clock, first: FirstPlacement | None = None
) -> LocateResult:
    """Take one rigid piece from its placement to its model.

    Its cameras are placed, and nothing is adjusted yet but, where there was one, a `first` placement.
    """
    given, source, before = placed.given, placed.source, placed.source.images
    started = pull_cameras(_start(placed, first), source.economy.limit(options.placement))
    stand = started if first is not None and started.held is None else _adjust(started, options, clock)
    with clock("trust"):
        judged = _judge(stand, options, before, clock)
        kept, stand = _choose(stand, judged, options.trust.min_trust)
    del placed, started  # with their samples of errors
    seeded = seed_points(stand, kept, options, clock)
    with clock("trust"):
        sure = _ask_pixels(stand, judged, kept, seeded)
        if sure.any():
            judged = replace(judged, assessment=confirm_cameras(judged.assessment, sure[judged.cameras]))
            kept, stand = _choose(stand, judged, options.trust.min_trust)
    if (sure & ~seeded.images.is_posed).any():
        seeded = seed_points(stand, kept, options, clock, sure)
    may = {"moves": not given.rigid.fixed.any(), "resize": judged.unit is None}
    seeded, control, told = bring_to_known(seeded, given.known, options.structure, **may)
    intrinsics = stand.intrinsics
    if seeded.adjusted is not None:
        judged = with_uncertainty(judged, before, seeded.adjusted, stand.gauge.similarity.scale)
        intrinsics = intrinsics.after(seeded.adjusted, before.lenses_of(seeded.adjusted.images))
    adjusted = (None if first is None else first.adjusted, stand.adjustment, seeded.adjusted)
    rigs = refined_rigs(given.images, seeded.images, stand.freedom, [done for done in adjusted if done])
    gauge = tell_scale(seeded.gauge, judged.scale_sigma)
    images, source = seeded.images, stand.source
    kept &= images.is_posed[judged.cameras]
    with clock("trust"):
        evidence = _question(stand, kept, seeded, clock)
        if not source.has_database:
            shape = _ask_shape(stand, images, lenses_held=options.freedom.intrinsics == "held")
            evidence, judged = replace(evidence, shape=shape), _widened(judged, shape, gauge.similarity.scale)
        for group in (group for group in evidence.untied if group.is_loose):
            judged = judged.loosened(np.isin(judged.cameras, group.cameras))
    with clock("model"):
        keypoints = source.view.keypoints if source.has_database else None
        template = _resize_sensors(given, gauge, images)
        seed = SeededModel.of(template, images, seeded.points, keypoints)
        hand_back_memory()  # freed by the judgement; the files of a model take as much
    turned = None if stand.adjustment is None else turned_deg(before.rotations, source.images.rotations)
    found = LocateResult(
        seed=seed,
        inputs=given.inputs,
        options=options,
        images=source.images,
        placed=images,
        image_names=given.template.image_names,
        directions=stand.directions,
        placement=judged,
        kept=kept,
        num_seen=seeded.num_seen,
        unsupported=seeded.unsupported,
        observations=seeded.observations,
        gauge=gauge,
        adjusted=seeded.adjusted,
        adjustment=stand.adjustment,
        turned_deg=turned,
        timings_s=clock.seconds,
        warnings=(),
        fixed=given.rigid.fixed,
        distances=given.distances,
        prior_fit=_compare_with_priors(stand, judged, images, gauge),
        evidence=evidence,
        intrinsics=intrinsics,
        rigs=rigs,
        control_points=control,
        suspicions=tuple(of_model(Kind.FAILED, one) for one in stand.failures),
    )
    return replace(found, warnings=(*_warnings(found, stand), *told))


def _start(stand: Stand, first: FirstPlacement | None) -> Stand:
    """Return where the cameras stand with what an adjustment of a first placement knows of them.

    It knows nothing of a piece fewer than two of whose cameras had places then, or all of them the same.
    """
    if first is None:
        return stand
    centers = first.near.locations[stand.placement.cameras]
    there = np.isfinite(centers).all(axis=1)
    if there.sum() < 2:
        return stand
    before, now = median_spread(centers[there]), median_spread(stand.placement.locations[there])
    if not (before > 0.0 and now > 0.0):
        return stand
    return stand._replace(estimate=first.adjusted, scale=before / now)


def _adjust(stand: Stand, options: PlacingOptions, clock: Clock) -> Stand:
    num_cameras = len(stand.placement.cameras)
    is_small = stand.placement.piece > 0 and num_cameras < _SMALLEST_ADJUSTED
    adjusts = options.placement.refines and options.freedom.adjusts_cameras(num_cameras)
    if is_small or not (adjusts and stand.source.economy.adjustment):
        return stand
    with clock("adjustment"):
        try:
            return adjust_placed(stand, options, clock)
        except UnsolvableError as error:
            return stand.failed(f"its cameras are not adjusted to the pixels: {error}")


def _judge(stand: Stand, options: PlacingOptions, before: Images, clock: Clock) -> Judged:
    """Return the evidence for a piece where its cameras stand, without the samples of errors that it took."""
    placement, source, relative, fit = stand.placement, stand.source, None, stand.fit_rotations
    if not (stand.given.believes_rotations or fit.all()):
        relative = ask_pairs(source, stand.directions, clock.threads, stand.among)
    judged = judge(placement, source.economy.limit(options.placement))
    if not source.has_database:  # its points were made for one placement, and hold no second one
        judged = replace(judged, second_configuration=None)
    if stand.estimate is not None:
        judged = with_uncertainty(judged, before, stand.estimate, stand.scale)
    judged, sure = judged.without_error_samples(), None if source.has_database else fit[judged.cameras]
    return doubt_cameras(judged, stand.directions, relative, source.images, sure)


def _choose(stand: Stand, judged: Judged, min_trust: float) -> tuple[BoolArray, Stand]:
    """Return which of the judged cameras are in the output, and the piece in a gauge found anew for them.

    Where priors hold the gauge it stays.
    """
    kept, gauge = select_trusted(judged, min_trust), stand.gauge
    if stand.held is None:
        kept |= stand.given.rigid.fixed[judged.cameras]
        gauge = stand.given.rule.choose(judged.cameras[kept], judged.locations[kept], judged.unit)
    return kept, stand._replace(placement=judged, gauge=gauge)


def _ask_pixels(stand: Stand, judged: Judged, kept: BoolArray, seeded: Seeded) -> BoolArray:
    """Return the doubted images (i,) that stand where their pixels see the points of the others."""
    source = stand.source
    doubted = np.zeros(source.images.num_images, dtype=np.bool_)
    doubted[judged.cameras] = (judged.assessment.trust < LOW_TRUST) | ~kept
    doubted |= seeded.num_seen >= 0
    doubted &= ~seeded.unsupported  # a wrong lens or so, of which its own points know more
    if not (doubted.any() and source.has_database):
        return np.zeros_like(doubted)
    images = _place_all(stand, seeded.images)
    pictures = ModelPictures(images, source.view.keypoints, source.view.num_keypoints)
    return ask_pixels(source, Structure(seeded.points, images, pictures), doubted)


def _question(stand: Stand, kept: BoolArray, seeded: Seeded, clock: Clock) -> ModelEvidence:
    """Return the evidence against a piece that its fit did not use."""
    placement, source = stand.placement, stand.source
    centers = np.full((source.images.num_images, 3), np.nan)
    centers[placement.cameras[kept]] = placement.locations[kept]
    fits = fit_pairs(centers, stand.directions)
    images, points, among = seeded.images, seeded.points, seeded.images.is_posed
    if placement.piece == 0 and source.has_database:
        images = _place_all(stand, images)
    if (others := images.is_posed & ~among).any():
        points = points.seen_by(others, source.view.num_keypoints, source.view.links())
    pictures = ModelPictures(images, source.view.keypoints, source.view.num_keypoints)
    asked = None if source.fixed is None else ~source.fixed
    structure = Structure(points, images, pictures, among, asked)
    source = replace(source, tied=_tied_by_priors(stand, images))
    return gather_evidence(source, fits, structure, clock.threads)


def _ask_shape(stand: Stand, images: Images, *, lenses_held: bool) -> OpenShape | None:
    """Return what own tracks leave open of the delivered images, where nothing else holds their shape."""
    posed, given = posed_part(images), stand.given
    if stand.held is not None or given.fixed_frames.any():
        return None
    links = stand.read_links(posed, nobody)
    knows_rotations = given.pull_rad is not None and given.pull_rad < np.inf
    return ask_shape(images, posed.rows, links, lenses_held=lenses_held, rotations_held=knows_rotations)


def _widened(judged: Judged, shape: OpenShape | None, scale: float) -> Judged:
    """Return the piece with what its shape leaves open beyond its noise, `scale` from the solver's unit."""
    if shape is None:
        return judged
    left_open = shape.covariances[judged.cameras] / scale**2
    told = np.clip(judged.covariances, -_OPEN, _OPEN)  # a camera that hangs loose has huge ones
    return replace(judged, open_covariances=excess(left_open, told))


def _tied_by_priors(stand: Stand, images: Images) -> IntArray | None:
    """Return pairs (k, 2) of images that priors tie: those whose own is as certain as a camera should be."""
    if stand.held is None:
        return None
    centers = images.centers[images.is_posed]
    most = RARE * float(np.linalg.norm(np.ptp(centers, axis=0)))
    frames = stand.held.indices[stand.held.sigmas() <= most]
    return rigid_strip(images, np.isin(images.frame_of, frames) & images.is_posed)


def _resize_sensors(given: Given, gauge: Gauge, images: Images) -> Template:
    """Return the template with sensors that are no cameras in the scale of the output, if that is another."""
    there = images.is_posed & given.images.is_posed
    before, now = given.images.centers[there], images.centers[there]
    keeps = gauge.scale in ("input", "rig", "fixed") or not given.template.has_open_sensors
    if keeps or len(before) < FEWEST_PRIORS or coincide(before):
        return given.template
    return given.template.resized(fit_similarity_l1(before, now).scale)


def _place_all(stand: Stand, images: Images) -> Images:
    """Return the delivered images, and where they are placed those that were left out."""
    before, now = stand.place().frames.centers, images.frames.centers
    there = np.isfinite(before).all(axis=1) & np.isfinite(now).all(axis=1)
    motion = fit_similarity(before[there], now[there])
    return images.posed(images.frames.rotations, np.where(np.isfinite(now), now, motion.apply(before)))


def _compare_with_priors(stand: Stand, judged: Judged, images: Images, gauge: Gauge) -> PriorFit | None:
    """Return how well position priors fit the delivered images where they set the scale; else None."""
    priors, pairs = stand.given.known.priors, stand.directions
    if priors is None or not gauge.has_priors:
        return None
    directions = pairs.directions if gauge.axes is None else pairs.directions @ gauge.axes.T
    sigmas, own = np.full(images.num_images, np.nan), standard_deviations(judged.covariances)
    sigmas[judged.cameras] = gauge.similarity.scale * own.max(axis=1)
    return compare_with_priors(images.centers, sigmas, priors, pairs.pairs, directions)


def _warnings(found: LocateResult, stand: Stand) -> Iterator[str]:
    """Yield what the user should know of a finished piece beyond the tables."""
    images, rule, gauge = found.placed, stand.given.rule, found.gauge
    yield from found.told_evidence.statements
    yield from intrinsics_warnings(found.intrinsics.rows(images))
    yield from match_warnings(stand.directions, may_repeat=stand.source.has_database)
    yield from quality_warnings(found.placement, found.options.placement)
    yield from trust_warnings(found.placement, found.kept)
    yield from ambiguity_warnings(found.placement)
    yield from stand.failures
    if rule.priors is not None:
        yield from rule.priors.notes
    if stand.gauge.warning:
        yield stand.gauge.warning
    if stand.source.economy.statement:
        limit = f"max_memory_mb={found.options.memory.max_memory_mb}"
        yield f"to stay below {limit}, {stand.source.economy.statement}"
    if found.model.num_points3D() == 0:
        yield f"{NO_POINTS}; bundle adjustment has nothing to start from"
    if names := stand.source.matches.missing_names:
        yield f"the database lacks {counted(len(names), 'image')} of the model: {first_of(names)}"
    yield from prior_warnings(found.prior_fit, images.names)
    there = np.flatnonzero(images.is_posed)
    yield from rule.check(gauge, there, images.centers[there])
    if found.options.gauge.scale == "unit" and gauge.scale != "unit":
        yield f"the scale unit was not used, but that of {SETS_SCALE[gauge.scale]}"
    unsupported = [images.names[k] for k in np.flatnonzero(found.unsupported).tolist()]
    yield from support_warnings(unsupported, is_kept=found.options.trust.min_trust == 0.0)
