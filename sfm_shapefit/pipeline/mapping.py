"""`map` from averaged rotations to models: one of each component, and those that belong together joined."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.settings import flat_values
from sfm_shapefit.facts.joined_cameras import JoinInputs
from sfm_shapefit.facts.joins import JoinFacts
from sfm_shapefit.facts.map_result import JoinedModel
from sfm_shapefit.facts.result import LocateResult
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.priors import MissingPriorsError, database_priors
from sfm_shapefit.judgement.reasons import Kind, Reason, of_model
from sfm_shapefit.judgement.rig_offsets import turn_sensors
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pipeline.components import MapContext
from sfm_shapefit.pipeline.inputs import MatchSource, RunInputs, see_matches
from sfm_shapefit.pipeline.model_joins import judge_joins, merge_groups, tell_group
from sfm_shapefit.pipeline.pieces import ModelPiece, tie_pieces
from sfm_shapefit.pipeline.remedies import at_one_center, make_model
from sfm_shapefit.pipeline.starts import adjust_first_placement
from sfm_shapefit.pipeline.state import ModelState
from sfm_shapefit.placement.place import ContradictedOffsetsError
from sfm_shapefit.rotations.arrangements import agreeing_pairs
from sfm_shapefit.rotations.averaged import AveragedRotations
from sfm_shapefit.rotations.components import pairs_among
from sfm_shapefit.rotations.sequences import Loop
from sfm_shapefit.scene.given import PositionPriors
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import PairNames


def refine_intrinsics(run: MapContext, relative: RelativeRotations) -> Images:
    """Return the images with the intrinsics that first placements of all components find.

    Relative rotations by a wrong focal length are off by degrees, and the averaging may follow the false
    ones among them; a placement that is wrong in places knows the focal length all the same. Where a
    camera is in several components, the one with most images counts.
    """
    images, is_known = run.images, np.zeros(len(run.images.lenses), dtype=np.bool_)
    for _, members, averaging in run.average_images(relative, {}):
        inputs = _inputs_of(run, members, averaging).without_positions()
        source = run.see(inputs.images, run.inputs)
        with suppress(UnsolvableError):
            try:
                first = _place_first(inputs, source, run.clock)
            except ContradictedOffsetsError:  # by directions of lenses that are not known yet
                first = _place_first(*at_one_center(inputs, source), run.clock)
            rows = run.images.lenses_of(first.images)
            images = images.with_lenses_of(first.images, first.is_tried & ~is_known[rows])
            is_known[rows] |= first.is_tried
    return images


def follow_turns(run: MapContext, relative: RelativeRotations) -> MapContext:
    """Return the run with sensors turned in their rigs, and free, where matches inside frames say so."""
    images, told = turn_sensors(run.images, relative)
    if not told:
        return run
    freedom = run.options.freedom
    if freedom.adjusts_cameras(images.num_images):
        freedom = replace(freedom, rigs="free")
    return run._replace(images=images, options=replace(run.options, freedom=freedom), suspicions=(told,))


def _place_first(inputs: RunInputs, source: MatchSource, clock: Clock) -> Estimate:
    state = adjust_first_placement(ModelState.of(inputs, source), clock, lenses_wanted=True)
    assert state.first is not None
    return state.first


def locate_components(
    run: MapContext, relative: RelativeRotations, loops: Sequence[Loop], reasons: dict[int, str]
) -> list[LocateResult]:
    """Return a model of each component that can be placed, most cameras first.

    Why a frame belongs to none is written to `reasons`, which starts with one for each.
    """
    models: list[LocateResult] = []
    for frames, members, averaging in run.average_images(relative, reasons):
        try:
            located = _locate_component(run, members, averaging, relative)
        except UnsolvableError as error:
            reasons |= dict.fromkeys(frames.tolist(), str(error))
            continue
        names = run.images.names_of(members)
        inside = frozenset(names)
        of_these = tuple(one for one in loops if one.first[0] in inside)
        result = replace(located, loops=of_these, averaging=averaging, averaged_names=names)
        models += _rigid_models(result, run.options.averaging.min_model_size)
        for k in frames.tolist():
            del reasons[k]
    return sorted(models, key=lambda model: -int(model.kept.sum()))


def _rigid_models(first: LocateResult, least: int) -> Iterator[LocateResult]:
    """Yield the model of a component, and those of its further rigid pieces with so many cameras.

    Pairs between two pieces tell no scale; a join of the two models may.
    """
    averaging, names = first.averaging, first.averaged_names
    assert averaging is not None
    large = [piece for piece in first.further if int(piece.kept.sum()) >= least]
    rest = tuple(piece for piece in first.further if piece not in large)
    placed = np.any([piece.placed.is_posed for piece in (first, *large)], axis=0)
    first, *large = (replace(one, elsewhere=placed & ~one.placed.is_posed) for one in (first, *large))
    yield replace(first, further=rest)
    for piece in large:
        rows = np.sort(piece.placement.cameras)
        some = tuple(names[k] for k in rows.tolist())
        yield replace(piece, averaging=averaging.subset(rows), averaged_names=some)


def _locate_component(
    run: MapContext, members: IntArray, averaging: AveragedRotations, relative: RelativeRotations
) -> LocateResult:
    """Place one component: adjust a first placement, and locate from the rotations of that."""
    inputs, read = _inputs_of(run, members, averaging), run.inputs
    _, among = pairs_among(relative, members)
    if averaging.num_repeated:  # the false pairs have most matches, and would fold the images again
        read = replace(read, left_out=read.left_out | _false_pairs(inputs.images, among, averaging))
    source = run.see(inputs.images, read)
    source = replace(source, alone=among)
    result = make_model(inputs, source, run.clock)
    return replace(
        result,
        scores=run.scores.of(members[result.directions.pairs]),
        suspicions=(*result.suspicions, *_suspicions(run, averaging)),
    )


def _inputs_of(run: MapContext, members: IntArray, averaging: AveragedRotations) -> RunInputs:
    images, known = run.pose(members, averaging.rotations), run.known.of(members)
    if known.priors is not None:  # without notes: the run says them once
        known = replace(known, priors=replace(known.priors, notes=()) if len(known.priors) else None)
    names = set(images.names)
    return RunInputs(
        options=run.options,
        template=run.read.template(images),
        images=images,
        intrinsics=run.intrinsics.part(run.images.lenses_of(images)),
        fixed=np.zeros(len(members), dtype=np.bool_),
        pull_rad=np.inf,
        is_component=True,
        distances=tuple(one for one in run.options.gauge.known_distance if {*one[:2]} <= names),
        known=known,
    )


def _false_pairs(images: Images, among: RelativeRotations, averaging: AveragedRotations) -> PairNames:
    """Return the pairs of images that their averaged rotations contradict, by name."""
    false = among.pairs[~agreeing_pairs(among, averaging)].tolist()
    names = ((images.names[i], images.names[j]) for i, j in false)
    return frozenset((min(pair), max(pair)) for pair in names)


def _suspicions(run: MapContext, averaging: AveragedRotations) -> Iterator[Reason]:
    """Yield why a model is to be looked at, whatever its pairs say: they say the same of a folded scene."""
    yield from (of_model(Kind.INPUT, clause) for clause in run.suspicions)
    if averaging.num_repeated:
        clause = "the scene repeats itself, and pairs that would fold it were not followed"
        yield of_model(Kind.REPEATED, clause)
    if averaging.num_rivals:
        yield of_model(Kind.REPEATED, "the images can be arranged in another way")


def join_mapped(
    models: Sequence[LocateResult], run: MapContext
) -> tuple[tuple[JoinFacts, ...], tuple[JoinedModel, ...], tuple[str, ...]]:
    """Join the models of a run, largest first, where that is safe and wanted.

    Returns:
        What came of joining each model but the largest, the models in one world, larger ones first, and what
        was told and could not be used for it, a sentence each.
    """
    if len(models) < 2 or run.options.join == "never":
        return (), (), ()
    located = dict(enumerate(models))
    pieces = [
        ModelPiece(
            label=f"model {number}",
            model=read_model(one.model.arrays()),
            scale_sigma=(one.gauge.scale_sigma or 0.0) if one.images.has_rigs else None,
        )
        for number, one in located.items()
    ]
    warnings: list[str] = []
    priors = list(_priors_of(pieces, run, warnings))
    tied = tie_pieces(pieces, run.matches, run.without)
    joins = list(judge_joins(pieces, tied, priors))
    options, inputs = run.options, run.inputs
    join_inputs = JoinInputs(
        joins, flat_values(options), inputs, options.gauge.known_distance, located=located
    )
    joined = []
    for group in merge_groups(pieces, tied, joins):
        images = read_model(group.reconstruction).images
        rows = np.searchsorted(run.images.names, images.names)
        told = join_inputs._replace(bars=run.known.bars and run.known.bars.of(rows))
        source = see_matches(run.matches, images, inputs)
        joined.append(tell_group(group, told, source, options.directions, run.clock.anew()))
    return tuple(joins), tuple(joined), tuple(warnings)


def _priors_of(
    pieces: Sequence[ModelPiece], run: MapContext, warnings: list[str]
) -> Iterator[PositionPriors | None]:
    """Yield the position priors of the images of each piece, told or those of the database."""
    priors = run.known.priors
    if priors is None:
        try:
            priors = database_priors(run.matches.file, run.images)
        except MissingPriorsError:
            pass
        except InputError as error:
            warnings.append(f"the position priors of the database join no models: {error}")
    for piece in pieces:
        piece_priors = (
            None if priors is None else priors.of(np.searchsorted(run.images.names, piece.model.images.names))
        )
        yield piece_priors if piece_priors else None
