"""`map` from matches to models, one of each component, with lenses of the view graph or the database."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.wording import first_of
from sfm_shapefit.facts.result import LocateResult
from sfm_shapefit.judgement.reasons import Kind, Reason, of_model
from sfm_shapefit.judgement.rig_offsets import turn_sensors
from sfm_shapefit.pairs.direction_options import LEAST_MATCHES
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pipeline.components import MapContext
from sfm_shapefit.pipeline.inputs import MatchSource, RunInputs
from sfm_shapefit.pipeline.remedies import at_one_center, has_better_models, make_model, with_database_lenses
from sfm_shapefit.pipeline.starts import adjust_first_placement
from sfm_shapefit.pipeline.state import ModelState
from sfm_shapefit.placement.place import ContradictedOffsetsError
from sfm_shapefit.rotations.arrangements import agreeing_pairs
from sfm_shapefit.rotations.averaged import AveragedRotations
from sfm_shapefit.rotations.components import pairs_among
from sfm_shapefit.rotations.sequences import Loop, Videos
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import FOCAL
from sfm_shapefit.scene.matches import PairNames

_MANY_DOUBTED = 0.25
"""Share of images with doubtful intrinsics from which relative rotations are measured twice; fewer are found
with the poses, which the others hold, and their pairs do not decide the averaging."""
_UNMATCHED = f"no matches: fewer than {LEAST_MATCHES} inliers with every other image"


class Attempt(NamedTuple):
    """What is made from one choice of focal lengths: models, and why frames belong to none."""

    run: MapContext
    relative: RelativeRotations
    videos: Videos
    models: list[LocateResult]
    reasons: dict[int, str]


def make_models(run: MapContext) -> Attempt:
    """Return the models of a run, by the focal lengths of the database if those of the view graph fail."""
    first, old = _make_models(run), run.images.lenses
    new = with_database_lenses(old, run.intrinsics, first.models)
    if new is None:
        return first
    changed = [k for k in range(len(old)) if old[k] != new[k]]
    by_view_graph = run.intrinsics.by_view_graph & ~np.isin(np.arange(len(old)), changed)
    intrinsics = replace(run.intrinsics, by_view_graph=by_view_graph)
    again = _make_models(run._replace(images=run.images.with_lenses(new), intrinsics=intrinsics))
    if not has_better_models(again.models, first.models):
        return first
    focals = [
        f"camera {new[k].id} with {new[k].focal_px:,.0f} px, not {old[k].focal_px:,.0f}" for k in changed
    ]
    run.matches.file.notes.append(
        "images contradict what the focal lengths of the view graph lead to, so all was done again from the "
        f"database's: {first_of(focals)}"
    )
    return again


def _make_models(run: MapContext) -> Attempt:
    run, relative, videos, loops = measure_run(run)
    reasons = dict.fromkeys(range(int(run.frame_of_image.max()) + 1), _UNMATCHED)
    return Attempt(run, relative, videos, locate_components(run, relative, loops, reasons), reasons)


def measure_run(run: MapContext) -> tuple[MapContext, RelativeRotations, Videos, tuple[Loop, ...]]:
    """Return the relative rotations of all pairs that are believed, videos, and their loops.

    The run knows scores of the pairs then, and which ones are refused.
    """
    relative = run.measure()
    doubted = run.intrinsics.parts[run.images.lens_of, FOCAL]
    if run.options.freedom.adjust != "none" and doubted.mean() >= _MANY_DOUBTED:
        known = refine_intrinsics(run, relative)
        if known.differ_in_rays(run.images):
            run = run._replace(images=known)
            relative = run.measure()
    run, videos = follow_turns(run, relative), run.find_videos(relative)
    run, relative, loops = run.judge_loops(videos, relative)
    return run.score_pairs(relative), relative, videos, loops


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
