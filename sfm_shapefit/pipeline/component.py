"""From the averaged rotations of each component of a database to its model."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.facts.map_result import MappedModel
from sfm_shapefit.facts.result import Inputs, LocateResult
from sfm_shapefit.facts.scene import Loop
from sfm_shapefit.judgement.reasons import Kind, Reason
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pipeline.acting import act, at_one_center
from sfm_shapefit.pipeline.components import pairs_among
from sfm_shapefit.pipeline.first_placement import adjust_first_placement, start_from_first
from sfm_shapefit.pipeline.given import Given
from sfm_shapefit.pipeline.inputs import MatchSource, see_matches
from sfm_shapefit.pipeline.map_run import MapRun
from sfm_shapefit.pipeline.rigs import find_rigid_parts
from sfm_shapefit.pipeline.settle import settle
from sfm_shapefit.placement.gauge import UselessPriorsError
from sfm_shapefit.placement.place import ContradictedOffsetsError
from sfm_shapefit.rotations.arrangements import agreeing_pairs
from sfm_shapefit.rotations.averaged import AveragedRotations
from sfm_shapefit.rotations.sequences import Visit
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import PairNames


def refine_intrinsics(run: MapRun, relative: RelativeRotations) -> Images:
    """Return the images with the intrinsics that first placements of all components find.

    Relative rotations by a wrong focal length are off by degrees, and the averaging may follow the false
    ones among them; a placement that is wrong in places knows the focal length all the same. Where a
    camera is in several components, the one with most images counts.
    """
    found, is_found = run.images, np.zeros(len(run.images.lenses), dtype=np.bool_)
    for _, members, averaging in run.average_images(relative, {}):
        given = _given(run, run.pose(members, averaging.rotations), run.inputs)
        source = see_matches(run.matches, given.images, run.inputs, run.options)
        with suppress(UnsolvableError):
            find = partial(adjust_first_placement, options=run.options, clock=run.clock, lenses_wanted=True)
            with run.clock("first placement"):
                try:
                    first = find(given, source)
                except ContradictedOffsetsError:  # by directions of lenses that are not known yet
                    first = find(*at_one_center(given, source))
            adjusted, rows = first.adjusted, run.images.lenses_of(first.adjusted.images)
            found = found.with_lenses_of(adjusted.images, adjusted.is_tried & ~is_found[rows])
            is_found[rows] |= adjusted.is_tried
    return found


def locate_components(
    run: MapRun, relative: RelativeRotations, visits: Sequence[Visit], reasons: dict[int, str]
) -> list[MappedModel]:
    """Return a model of each component that can be placed, most cameras first.

    Why a frame belongs to none is written to `reasons`, which starts with one for each.
    """
    models: list[MappedModel] = []
    for frames, members, averaging in run.average_images(relative, reasons):
        try:
            located = _locate_component(run, members, averaging, relative)
        except UnsolvableError as error:
            reasons |= dict.fromkeys(frames.tolist(), f"its component cannot be placed: {error}")
            continue
        names = tuple(run.images.names[k] for k in members.tolist())
        located = replace(located, loops=tuple(_loops_of(visits, run.images.names, set(names))))
        component = MappedModel(located=located, averaging=averaging, names=names)
        models += _rigid_models(component, run.options.averaging.min_model_size)
        for k in frames.tolist():
            del reasons[k]
    return sorted(models, key=lambda model: -int(model.located.kept.sum()))


def _rigid_models(component: MappedModel, least: int) -> Iterator[MappedModel]:
    """Yield the model of a component, and those of its further rigid pieces with so many cameras.

    The pairs between them tell no scale, but a join may, and `locate` of one cannot.
    """
    first = component.located
    large = [piece for piece in first.further if int(piece.kept.sum()) >= least]
    rest = tuple(piece for piece in first.further if piece not in large)
    there = np.any([piece.placed.is_posed for piece in (first, *large)], axis=0)
    first, *large = (replace(one, elsewhere=there & ~one.placed.is_posed) for one in (first, *large))
    yield replace(component, located=replace(first, further=rest))
    for piece in large:
        rows = np.sort(piece.placement.cameras)
        names = tuple(component.names[k] for k in rows.tolist())
        yield MappedModel(located=piece, averaging=component.averaging.subset(rows), names=names)


def _locate_component(
    run: MapRun, members: IntArray, averaging: AveragedRotations, relative: RelativeRotations
) -> LocateResult:
    """Place one component: adjust a first placement, and locate from the rotations of that."""
    images, inputs = run.pose(members, averaging.rotations), run.inputs
    _, among = pairs_among(relative, members)
    if averaging.num_repeated:  # the false pairs have most matches, and would fold the images again
        inputs = replace(inputs, left_out=inputs.left_out | _false_pairs(images, among, averaging))
    source = replace(see_matches(run.matches, images, inputs, run.options), alone=among)
    found = act(partial(_place, run, members), _given(run, images, inputs), source, run.options)
    return replace(
        found,
        scores=run.scores.of(members[found.directions.pairs]),
        suspicions=(*found.suspicions, *_suspicions(averaging)),
    )


def _place(run: MapRun, members: IntArray, given: Given, source: MatchSource) -> LocateResult:
    """Adjust a first placement of some images, and locate them from the rotations of that."""
    first = None
    if run.options.freedom.adjust != "none":
        given, source, first = start_from_first(given, source, run.options, run.clock)
    given = _with_told(run, given, members)
    with run.clock("locate"):
        try:
            return settle(given, source, run.options, run.clock.anew(), first)
        except UselessPriorsError as error:  # which other components need not share
            given = given._replace(known=replace(given.known, priors=None))
            found = settle(given, source, run.options, run.clock.anew(), first)
            warning = f"the scale is not that of position priors: {error}"
            return replace(found, warnings=(*found.warnings, warning))


def _given(run: MapRun, images: Images, inputs: Inputs) -> Given:
    """Return what is known of a component's images before they are placed: nothing that sets a scale."""
    intrinsics = run.intrinsics.part(run.images.lenses_of(images))
    return Given(run.read.template(images), images, intrinsics, inputs, find_rigid_parts(images), np.inf)


def _with_told(run: MapRun, given: Given, members: IntArray) -> Given:
    """Return what is known of a component's images with what the user told of them."""
    names, known = set(given.images.names), run.known.of(members)
    if known.priors is not None:  # without notes: the run says them once
        known = replace(known, priors=replace(known.priors, notes=()) if len(known.priors) else None)
    distances = tuple(one for one in run.options.gauge.known_distance if {*one[:2]} <= names)
    return given._replace(distances=distances, known=known)


def _false_pairs(images: Images, among: RelativeRotations, averaging: AveragedRotations) -> PairNames:
    """Return the pairs of images that their averaged rotations contradict, by name."""
    false = among.pairs[~agreeing_pairs(among, averaging)].tolist()
    names = ((images.names[i], images.names[j]) for i, j in false)
    return frozenset((min(pair), max(pair)) for pair in names)


def _suspicions(averaging: AveragedRotations) -> Iterator[Reason]:
    """Yield why a model is to be looked at, whatever its pairs say: they say the same of a folded scene."""
    if averaging.num_repeated:
        clause = "the scene repeats itself, and pairs that would fold it were not followed"
        yield Reason(kind=Kind.REPEATED, sentence=clause)
    if averaging.num_rivals:
        yield Reason(kind=Kind.REPEATED, sentence="the images can be arranged in another way")


def _loops_of(visits: Iterable[Visit], names: Sequence[str], among: set[str]) -> Iterator[Loop]:
    """Yield the visits that begin among some images, by name."""
    for visit in visits:
        first, second = ((names[a], names[b]) for a, b in (visit.first, visit.second))
        if first[0] in among:
            yield Loop.taken_from(visit, first=first, second=second)
