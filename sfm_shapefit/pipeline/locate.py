"""`locate`: from known rotations and matches to a seeded COLMAP model, the path of the data in one page.

Each stage is one function from values to a new value; the input is never changed.
"""

from collections.abc import Collection, Iterator, Mapping
from concurrent.futures import Executor
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import sfm_shapefit.pipeline.notebook_page  # noqa: F401  so that results show their report in notebooks
from sfm_shapefit.adjustment.adjusted import AdjustedPlacement, Uncertainty
from sfm_shapefit.adjustment.free_sensors import NO_SENSORS, SensorSigma
from sfm_shapefit.adjustment.given_rotations import RotationWeight
from sfm_shapefit.adjustment.run import GivenPoses
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import median_spread
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.facts.intrinsics import NO_DOUBTS, Intrinsics, intrinsics_warnings
from sfm_shapefit.facts.options import LocateOptions
from sfm_shapefit.facts.result import LocateResult
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
from sfm_shapefit.files.colmap.model import PosedModel, read_model, sensors_of
from sfm_shapefit.files.colmap.point_colors import PointColors
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.pipeline.adjustment import (
    adjust_placed,
    pull_cameras,
    turned_deg,
    weight_of_rotations,
    with_uncertainty,
)
from sfm_shapefit.pipeline.clock import Clock, Progress
from sfm_shapefit.pipeline.control_points import bring_to_control_points, read_control
from sfm_shapefit.pipeline.doubts import ask_pairs, doubt_cameras, question_focal_lengths
from sfm_shapefit.pipeline.gauge_choice import GaugeRule, read_priors
from sfm_shapefit.pipeline.gravity import turn_model_upright
from sfm_shapefit.pipeline.inputs import (
    MatchSource,
    choose_inputs,
    open_matches,
    read_left_out,
    see_matches,
    without_structure,
)
from sfm_shapefit.pipeline.intrinsics import settle_intrinsics
from sfm_shapefit.pipeline.measure import add_evidence, build_graph, count_work, measure_directions
from sfm_shapefit.pipeline.memory import keep_within_memory
from sfm_shapefit.pipeline.rigs import Rigid, find_rigid_parts, place_cameras
from sfm_shapefit.pipeline.seed import (
    Located,
    build_seeded_model,
    place_further_pieces,
    select_trusted,
)
from sfm_shapefit.placement.gauge import Gauge, tell_scale
from sfm_shapefit.placement.move import bring_to_scale, move_cameras
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.placement.prior_pairs import PriorAngles, compare_with_priors
from sfm_shapefit.placement.tied_groups import measure_unit
from sfm_shapefit.scene.given import ControlPoints, Gravity, PositionPriors

if TYPE_CHECKING:
    import pycolmap


def locate(
    reconstruction: "pycolmap.Reconstruction | Path | str",
    database: Path | str | None = None,
    *,
    options: LocateOptions | None = None,
    progress: Progress | None = None,
    priors: Path | str | None = None,
    executor: Executor | None = None,
    **overrides: Any,
) -> LocateResult:
    """Place the cameras of a model whose rotations and intrinsics are known.

        rotations = pycolmap.Reconstruction("sparse/0")
        found = sfm_shapefit.locate(rotations, "database.db")
        pycolmap.bundle_adjustment(found.reconstruction)        # a new model; the input is untouched
        sfm_shapefit.write_result(found, "out")                 # the model, tables, and report.html

    Args:
        reconstruction: a pycolmap.Reconstruction or a model folder, or a model file of Bundler, openMVG or
            OpenSfM; nothing of it is changed, and its camera centers never place a camera.
        database: the COLMAP database with the inlier matches. Without it, `database.db` is looked for in
            the model's folder, its parent and its grandparent; failing that the model's tracks serve.
        options: settings, see `help(LocateOptions)`; defaults if None.
        **overrides: single options by name: `locate(model, min_trust=0.0)`.
        progress: called as stages advance, with the stage, the work done and the work in all.
        priors: a table of position priors, see `files.colmap.priors`, or the folder of the images, whose
            EXIF data have them; the database's own pose priors
            serve if the scale is "prior" and there is no table.
        executor: shares out pairs and tracks among its workers, which must see the file of the database, with
            the same answer to the bit; it is not shut down. None: all is done here.

    Returns:
        `reconstruction`, the seeded model: cameras placed, points triangulated, all else unregistered;
        `cameras` and `pairs`, a row each with trust, standard deviation, residual and verdict; `certified`,
        the optimum with its certificate; `warnings`, a sentence each; `gauge`, `further` pieces, `timings_s`.

    Raises:
        InputError: if the model or the database cannot be used; the message says what to do.
        UnsolvableError: if no pair has a usable direction, or the directions determine nothing.
        WorkerError: if a worker died and the executor does not replace it.

    Source of the program: Hand, Lee, Voroninski (2015), arXiv 1506.01437.
    """
    options = merge_options(options, LocateOptions, overrides)
    clock = Clock(progress) if progress else Clock()
    with ExitStack() as stack:
        with clock("read"):
            model = read_model(reconstruction)
            inputs = choose_inputs(reconstruction, database, options.directions)
            inputs = read_left_out(inputs, model.names, options)
            matches = stack.enter_context(closing(open_matches(model, inputs)))
            model, intrinsics = settle_intrinsics(model, matches.file, options, inputs.left_out)
            priors_known = read_priors(model, matches.file, options, priors)
            control = read_control(model, options)
            rigid = find_rigid_parts(model, options, has_priors=priors_known is not None)
            model, colors = without_structure(model, matches)
            source = see_matches(matches, model, inputs, options)
        known = Locating(rigid, priors_known, executor, intrinsics=intrinsics, control=control, colors=colors)
        return locate_source(source, known, options, clock)


class Locating(NamedTuple):
    """What a run of `locate` knows beside its matches and options."""

    rigid: Rigid
    priors: PositionPriors | None = None
    executor: Executor | None = None
    centers: FloatArray | None = None
    """(n, 3) where an adjustment has the images, in any scale and from any origin; NaN for those it lacks.
    None if there was no adjustment."""
    uncertainty: Uncertainty = Uncertainty()
    """Of these centers, in their units."""
    intrinsics: Intrinsics = NO_DOUBTS
    """Which of the images' are in doubt, and what became of them so far."""
    sensors: Mapping[int, SensorSigma] = NO_SENSORS
    """Those that an adjustment has moved in their rigs so far, and how well it knows them."""
    rigs: Mapping[int, Any] | None = None
    """The sensors' poses as they were given, by the ids of cameras; None: those of the model."""
    control: ControlPoints | None = None
    """Ground control points of the images."""
    gravity: Gravity | None = None
    """Of the images, which turns the model upright."""
    colors: PointColors | None = None
    """Of the points that the input had; none if None."""


def locate_source(opened: MatchSource, known: Locating, options: LocateOptions, clock: Clock) -> LocateResult:
    """Place the cameras of an open source, and make the seeded model; see `locate`."""
    model, rigid = opened.model, known.rigid
    with clock("directions"):
        directions = measure_directions(opened, options, clock, known.executor)
    with clock("solve"):
        source, options, located = _place(opened, directions, known, options, clock)
    before = source, directions
    source, directions, located, adjustment, intrinsics = _adjust(
        source, directions, located, known, options, clock
    )
    with clock("trust"):
        relative = ask_pairs(source, directions, options)
        # Adjusted rotations have made up for a part of what a wrong focal length does to the given ones.
        asked = (source, directions) if known.intrinsics.free.doubts else before
        focal_doubts = question_focal_lengths(*asked, options)

        def judge(placement: Placement) -> Placement:
            return doubt_cameras(placement, directions, relative, source.model, options)

        placement = judge(located.placement)
        located = _judge_again(located, placement, options.min_trust)
    with clock("further pieces"):
        further = place_further_pieces(source, placement, options, judge, known.colors)
    placement = placement.without_error_samples()  # all is placed
    located = located._replace(placement=placement)
    seeded = build_seeded_model(source, located, options, clock, known.colors, known.executor)
    seeded, control_points, of_control = bring_to_control_points(seeded, source.model, known.control, options)
    seeded, of_gravity = turn_model_upright(seeded, source.model, known.gravity)
    if seeded.adjusted is not None:
        scale = located.gauge.similarity.scale
        placement = with_uncertainty(placement, model, seeded.adjusted.uncertainty, scale)
        intrinsics = intrinsics.after(seeded.adjusted.lenses)
    sensors = dict(known.sensors)
    for done in (adjustment, seeded.adjusted):
        sensors |= {} if done is None else done.sensors
    if options.refine_rigs and not sensors:
        raise InputError("there is nothing to adjust, so that rigs cannot be refined; leave out refine_rigs")
    focal_doubts = tuple(doubt for doubt in focal_doubts if doubt.camera not in intrinsics.refined.sigmas)
    gauge = tell_scale(seeded.gauge, placement.scale_sigma)
    located = located._replace(placement=placement, gauge=gauge)
    prior_angles = _ask_priors(source.model, directions, known.priors, gauge, seeded.reconstruction)
    warnings = (
        *focal_warnings(source.model, focal_doubts, intrinsics.refined.undetermined),
        *intrinsics_warnings(intrinsics, intrinsics.rows(seeded.reconstruction)),
        *_collect_warnings(source, directions, located, seeded.reconstruction.num_points3D()),
        *prior_warnings(prior_angles, directions.pairs, source.model.names),
        *of_control,
        *of_gravity,
        *support_warnings(_names_of(source.model, seeded.unsupported), is_kept=options.min_trust == 0.0),
    )
    return LocateResult(
        reconstruction=seeded.reconstruction,
        inputs=source.inputs,
        options=options,
        model=source.model,
        directions=directions,
        placement=placement,
        kept=located.kept & ~np.isin(model.image_ids[placement.cameras], list(seeded.poor)),
        poor=seeded.poor,
        unsupported=seeded.unsupported,
        agreeing_observations=seeded.observations.agreeing,
        contradicting_observations=seeded.observations.contradicting,
        gauge=gauge,
        adjusted=seeded.adjusted,
        adjustment=adjustment,
        turned_deg=None if adjustment is None else turned_deg(model.rotations, source.model.rotations),
        timings_s=clock.seconds,
        warnings=warnings,
        further=further,
        fixed=rigid.fixed,
        prior_angles=prior_angles,
        focal_doubts=focal_doubts,
        intrinsics=intrinsics,
        rigs=refined_rigs(
            known.rigs or sensors_of(model.reconstruction), sensors_of(seeded.reconstruction), sensors
        ),
        control_points=tuple(control_points),
    )


def _place(
    opened: MatchSource, directions: PairDirections, known: Locating, options: LocateOptions, clock: Clock
) -> tuple[MatchSource, LocateOptions, Located]:
    """Place the cameras within the memory that there is; what follows takes that source and those options."""
    model, rigid = opened.model, known.rigid
    measured = rigid.apply(build_graph(opened, directions, options))
    work = count_work(opened, directions)
    economy, measured, options = keep_within_memory(work, measured, options, opened.economy)
    source = opened.at(model, economy)
    placement = place_cameras(add_evidence(measured, source, directions, options), options, clock)
    if known.centers is not None:
        placement = _at_known_centers(placement, known, model, options)
    given = GivenPoses(lenses=known.intrinsics.free, free_rigs=options.refine_rigs)
    located = _choose(placement, GaugeRule(model, rigid, options, known.priors))._replace(given=given)
    if known.priors is not None and options.refine_with_priors:
        located = pull_cameras(model, located, known.priors, options)
    return source, options, located


def _names_of(model: PosedModel, image_ids: Collection[int]) -> list[str]:
    """Return the names of some images, in the order of the model."""
    return [model.names[k] for k in np.flatnonzero(np.isin(model.image_ids, list(image_ids))).tolist()]


def _at_known_centers(
    placement: Placement, known: Locating, model: PosedModel, options: LocateOptions
) -> Placement:
    """Return the placement with its cameras where an adjustment had them, and how well it knew that.

    In units of the solver, those of the rigs are then as long as the adjustment has them, not as the
    directions had: all pixels say it better.
    """
    assert known.centers is not None
    centers = known.centers[placement.cameras]
    placed = bring_to_scale(placement, centers)
    there = np.isfinite(centers).all(axis=1)
    scale = median_spread(centers[there]) / median_spread(placed[there])
    moved = move_cameras(placement, placed, options)
    if moved.unit is not None:
        moved = replace(moved, unit=measure_unit(moved.measured_part(), moved.refined.locations))
    return with_uncertainty(moved, model, known.uncertainty, scale)


class _Adjusted(NamedTuple):
    """What an adjustment leaves, or what was there where there is none."""

    source: MatchSource
    directions: PairDirections
    located: Located
    adjustment: AdjustedPlacement | None
    intrinsics: Intrinsics


def _adjust(
    source: MatchSource,
    directions: PairDirections,
    located: Located,
    known: Locating,
    options: LocateOptions,
    clock: Clock,
) -> _Adjusted:
    """Adjust the placed cameras, if that is wanted and was not done before."""
    before = _Adjusted(source, directions, located, None, known.intrinsics)
    is_adjusted = known.centers is not None and located.given.centers is None
    if is_adjusted or not options.adjusts_cameras(len(located.placement.cameras)):
        return before
    weight = weight_of_rotations(options) if known.centers is None else RotationWeight()
    with clock("adjustment"), suppress(UnsolvableError):  # without points there is nothing to adjust
        after = adjust_placed(source, directions, located, options, clock, weight)
        intrinsics = known.intrinsics.after(after.adjusted.lenses)
        given = located.given._replace(
            weight=after.adjusted.weight,
            weight_frames=after.adjusted.frame_ids,
            model=source.model.reconstruction,
            lenses=intrinsics.free,
        )
        moved = located._replace(placement=after.placement, given=given)
        return _Adjusted(after.source, after.directions, moved, after.adjusted, intrinsics)
    return before


def _ask_priors(
    model: PosedModel,
    directions: PairDirections,
    priors: PositionPriors | None,
    gauge: Gauge,
    output: "pycolmap.Reconstruction",
) -> PriorAngles | None:
    """Return how far directions are off the baselines of priors that set the axes, if any do."""
    if priors is None or gauge.scale != "prior" or gauge.axes is None:
        return None
    centers = np.full((model.num_images, 3), np.nan)
    for image, image_id in enumerate(model.image_ids.tolist()):
        if output.image(image_id).has_pose:
            centers[image] = output.image(image_id).projection_center()
    return compare_with_priors(directions.pairs, directions.directions, priors, gauge, centers)


def _choose(placement: Placement, rule: GaugeRule) -> Located:
    """Return which of the placed cameras are in the output, and in which gauge."""
    fixed = rule.rigid.fixed
    kept = select_trusted(placement, rule.options.min_trust) | fixed[placement.cameras]
    gauge = rule.choose(placement.cameras[kept], placement.locations[kept], placement.unit)
    return Located(placement, kept, gauge, fixed, rule)


def _judge_again(located: Located, placement: Placement, min_trust: float) -> Located:
    """Return what is in the output by the trust of another placement, in a gauge that is found anew.

    Where priors hold the gauge it stays.
    """
    if located.given.centers is not None or located.rule is None:
        return located._replace(placement=placement, kept=select_trusted(placement, min_trust))
    return _choose(placement, located.rule)._replace(given=located.given)


def _collect_warnings(
    source: MatchSource, directions: PairDirections, located: Located, num_points: int
) -> Iterator[str]:
    """Yield what the user should know beyond the tables."""
    yield from match_warnings(directions)
    yield from quality_warnings(located.placement)
    yield from trust_warnings(located.placement, located.kept)
    yield from ambiguity_warnings(located.placement)
    if located.gauge.warning:
        yield located.gauge.warning
    if source.economy.statement:
        yield f"to stay below max_memory_mb, {source.economy.statement}"
    if num_points == 0:
        yield "no 3D point could be triangulated; bundle adjustment has nothing to start from"
    if names := source.matches.missing_names:
        yield f"{len(names)} images of the model are not in the database, {names[0]} for one"
