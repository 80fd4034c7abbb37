"""Models made, and once more where evidence against them can be acted on safely.

A lens that is wrong is freed, a camera goes where most pairs put it, and the new model counts only if less
speaks against it. The side of a seam is never guessed: nothing says which of two groups is wrong. Sensors
whose offsets in their rigs are contradicted go where matches inside frames put them; where offsets are too
short to tell the scale, the sensors are taken to share one center.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment.free_sensors import OpenSensorError
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.facts.intrinsics import RefinedIntrinsics, describe_intrinsics
from sfm_shapefit.facts.result import LocateResult
from sfm_shapefit.judgement.limits import OUTNUMBERED
from sfm_shapefit.judgement.reasons import Grade, Kind, of_model
from sfm_shapefit.judgement.rig_offsets import find_contradicted_rigs, measured_offsets
from sfm_shapefit.judgement.wrong_lenses import is_like_others
from sfm_shapefit.pipeline.conventions import ask_resolution
from sfm_shapefit.pipeline.inputs import MatchSource, RunInputs
from sfm_shapefit.pipeline.measure import measure
from sfm_shapefit.pipeline.placing import measure_hold
from sfm_shapefit.pipeline.stages import run_stages
from sfm_shapefit.pipeline.starts import begin_model
from sfm_shapefit.placement.gauge import UselessPriorsError
from sfm_shapefit.placement.place import ContradictedOffsetsError
from sfm_shapefit.scene.freedom import RigFreedom
from sfm_shapefit.scene.lens import FOCAL, Lens, Origin

_OPEN_SCALE = 0.5  # relative standard deviation; with a larger one the offsets may as well be 0
_SHORT = 2e-3  # baselines; an offset as short turns a direction by a tenth of a degree, as its errors do


class Remedy(NamedTuple):
    """What to start from in place of what evidence speaks against."""

    inputs: RunInputs
    source: MatchSource
    freed: dict[int, float]
    """Rows of the lenses that may change now, and start from the focal length that their images ask for; with
    the standard deviation of that, a share, which the roughness of poses widens."""
    moved: tuple[str, ...]
    """Names of cameras whose pairs for this place are left out, as twice as many agree on another."""

    def is_better(self, after: LocateResult, before: LocateResult) -> bool:
        """Return whether less speaks against a result than before, with lenses known and no camera lost."""
        less, images = _count(after) < _count(before), after.images
        open_ = after.intrinsics.undetermined[list(self.freed)].any()
        alike = all(is_like_others(images, k, images.lenses[k].focal_px, s) for k, s in self.freed.items())
        return bool(less and alike and not open_ and after.kept.sum() >= before.kept.sum())

    def applied(self, result: LocateResult) -> LocateResult:
        """Return a result of this remedy, which says so; a freed lens is as uncertain as its images are."""
        sigmas = result.intrinsics.focal_sigmas.copy()
        for row, sigma in self.freed.items():
            sigmas[row] = np.maximum(sigmas[row], sigma)
        result = replace(result, intrinsics=replace(result.intrinsics, focal_sigmas=sigmas))
        ids = {result.placed.lenses[row].id for row in self.freed}
        lenses = [row for row in result.intrinsics.rows(result.placed) if row.camera in ids]
        changed = "; ".join(describe_intrinsics(lenses))
        why = "images contradicted what was given (--intrinsics held keeps that)"
        done = [f"{changed}: {why}"] if lenses else []
        if self.moved:
            done.append(f"{', '.join(self.moved)}: placed without the pairs that twice as many contradict")
        return replace(result, warnings=(*done, *result.warnings))


def make_model(inputs: RunInputs, source: MatchSource, clock: Clock) -> LocateResult:
    """Return what the stages make of a source, by a remedy if that cures what speaks against the result.

    Raises:
        UnsolvableError: if no camera can be placed.
    """
    result, notes = _run_in_scale(inputs, source, clock), tuple[str, ...]()
    if not isinstance(result, LocateResult) or _contradicts_rigs(result, inputs):
        inputs, source, result, notes = _run_with_other_offsets(result, inputs, source, clock)
    for remedy in find_remedies(result, inputs, source):
        again = _run(remedy.inputs, remedy.source, clock)
        if remedy.is_better(again, result):
            result = remedy.applied(again)
            break
    return replace(result, warnings=(*notes, *result.warnings))


def _run(inputs: RunInputs, source: MatchSource, clock: Clock) -> LocateResult:
    """Return what the stages make of a source, that of `map` in a clock of its own after the start."""
    state = begin_model(inputs, source, clock)
    if not inputs.is_component:
        return run_stages(state, clock)
    with clock("locate"):
        try:
            return run_stages(state, clock.anew())
        except UselessPriorsError as error:  # which other components need not share
            known = replace(inputs.known, priors=None)
            state = state.warned(f"the scale is not that of position priors: {error}")
            return run_stages(replace(state, inputs=replace(inputs, known=known)), clock.anew())


def _run_in_scale(
    inputs: RunInputs, source: MatchSource, clock: Clock
) -> LocateResult | ContradictedOffsetsError | OpenSensorError:
    """Return what the stages make of a source, or why its sensors are not where the rigs have them.

    UnsolvableError: as `make_model`.
    """
    try:
        result = _run(inputs, source, clock)
    except (ContradictedOffsetsError, OpenSensorError) as error:
        return error
    longest, sigma = _longest_offset(inputs), result.placement.scale_sigma
    if longest > 0.0 and sigma is not None and sigma > _OPEN_SCALE:
        return ContradictedOffsetsError(0.0, result.placement)
    return result


def _longest_offset(inputs: RunInputs) -> float:
    return float(np.linalg.norm(inputs.images.sensors.translations, axis=1).max(initial=0.0))


def _contradicts_rigs(result: LocateResult, inputs: RunInputs) -> bool:
    """Return whether matches inside frames put a sensor elsewhere in its rig."""
    return inputs.images.has_rigs and any(find_contradicted_rigs(result.images, result.directions))


def _run_with_other_offsets(
    why: LocateResult | ContradictedOffsetsError | OpenSensorError,
    inputs: RunInputs,
    source: MatchSource,
    clock: Clock,
) -> tuple[RunInputs, MatchSource, LocateResult, tuple[str, ...]]:
    """Return what to start from in place of sensors that fail, what comes of it, and a note.

    They stand where matches inside frames put them, as far away as the rig has them, and are free, unless a
    frame is fixed. If these say nothing else, sensors of `map` that are left open are held, and offsets that
    are too short to tell a scale are taken for 0.

    ContradictedOffsetsError, OpenSensorError: if neither is so.
    """
    images, freedom = source.images, inputs.options.freedom
    directions = measure(source, inputs.options.directions, clock).directions
    wrong = [one.statement for one in find_contradicted_rigs(images, directions)]
    offsets = measured_offsets(images, directions)
    least = int(why.kept.sum()) if isinstance(why, LocateResult) else 0
    ways: list[RigFreedom] = ["free", "held"] if freedom.adjusts_cameras(images.num_images) else ["held"]
    is_moved = (offsets != images.sensors.translations).any() and not inputs.fixed.any()
    for rigs in ways if is_moved else ():
        start = with_offsets(_with_rigs(inputs, rigs), source, offsets)
        with suppress(InputError, UnsolvableError):  # the first result, or error, stays
            result = _run_in_scale(*start, clock)
            if isinstance(result, LocateResult) and result.kept.sum() >= least:
                doubt = f"{wrong[0]}, so sensors are placed by these matches, as far away as the rig has them"
                suspicions = (*result.suspicions, of_model(Kind.INPUT, doubt))
                return *start, replace(result, suspicions=suspicions), ()
    if isinstance(why, LocateResult):
        return inputs, source, why, ()
    if isinstance(why, OpenSensorError):
        if not inputs.is_component:
            raise why
        start, note = (_with_rigs(inputs, "held"), source), f"the sensors of rigs are held: {why.reason}"
        return *start, _run(*start, clock), (note,)
    longest, length, placement = _longest_offset(inputs), why.length, why.placement
    if not (longest > 0.0 and (length > -_SHORT or measure_hold(placement).scale_sigma > _OPEN_SCALE)):
        raise ContradictedOffsetsError(length, placement, wrong)
    short = (
        f"the offsets of sensors in their rigs, at most {longest:.2g}, are too short for this scene to tell "
        "its scale"
    )
    start = at_one_center(inputs, source)
    note = f"{next(iter(wrong), short)}, so the sensors of a rig are taken to share one center"
    return *start, _run(*start, clock), (note,)


def _with_rigs(inputs: RunInputs, rigs: RigFreedom) -> RunInputs:
    """Return the same with the poses of sensors held, or free."""
    freedom = replace(inputs.options.freedom, rigs=rigs)
    return replace(inputs, options=replace(inputs.options, freedom=freedom))


def at_one_center(inputs: RunInputs, source: MatchSource) -> tuple[RunInputs, MatchSource]:
    """Return the same where the sensors of a rig share one center, so that nothing tells the scale."""
    return with_offsets(inputs, source, np.zeros_like(inputs.images.sensors.translations))


def with_offsets(
    inputs: RunInputs, source: MatchSource, translations: FloatArray
) -> tuple[RunInputs, MatchSource]:
    """Return the same with other translations (l, 3) of sensors_from_rig."""
    sensors = inputs.images.sensors.rotations, translations
    images = source.images.with_sensors(*sensors)
    return replace(inputs, images=inputs.images.with_sensors(*sensors)), source.at(images)


def find_remedies(result: LocateResult, inputs: RunInputs, source: MatchSource) -> Iterator[Remedy]:
    """Yield what to start from instead, where something can be done about what speaks against a result."""
    images, intrinsics, options = source.images, inputs.intrinsics, inputs.options
    may_free = options.freedom.intrinsics != "held" and options.freedom.adjusts_cameras(images.num_images)
    wrong = {one.camera: one for one in result.evidence.lenses}
    freed = {
        row: wrong[lens.id]
        for row, lens in enumerate(images.lenses)
        if may_free and lens.id in wrong and lens.is_adjustable and not intrinsics.parts[row, FOCAL]
    }
    if freed and ask_resolution(source) is not None:
        freed = {}  # pixels of another resolution ask for another focal length, and are no fault of the lens
    # A camera that is fixed, or held by its rig, cannot go where its pairs are.
    may_move = not (images.has_rigs or inputs.fixed.any())
    places = result.evidence.places if may_move else ()
    moved = [place for place in places if place.num_there >= OUTNUMBERED * place.num_here]
    if not (freed or moved):
        return
    lenses, parts = list(images.lenses), intrinsics.parts.copy()
    for row, asked in freed.items():
        known = lenses[row]
        if known.origin in (None, Origin.CALIBRATION):  # what is contradicted pulls no harder than a guess
            known = replace(known.in_doubt(Origin.GUESS), origin=Origin.CALIBRATION)
        lenses[row] = known.longer(asked.factor)
        parts[row, FOCAL] = True
    pairs = (pair for place in moved for pair in place.pairs_here)
    left_out = source.inputs.left_out | {(min(pair), max(pair)) for pair in pairs}
    read = replace(source.inputs, left_out=left_out)
    view = source.matches.at(images.with_lenses(lenses), left_out, source.memory_plan.reading)
    yield Remedy(
        replace(inputs, intrinsics=replace(intrinsics, parts=parts)),
        replace(source, inputs=read, view=view),
        {row: asked.sigma for row, asked in freed.items()},
        tuple(place.image for place in moved),
    )


def _count(result: LocateResult) -> int:
    """Return the number of lenses and cameras that evidence names, and of cameras that are left out."""
    evidence, left_out = result.evidence, int(np.sum(~result.kept))
    apart = sum(map(len, evidence.apart))
    return len(evidence.lenses) + left_out + len(evidence.places) + apart


def with_database_lenses(
    lenses: Sequence[Lens], intrinsics: RefinedIntrinsics, models: Sequence[LocateResult]
) -> list[Lens] | None:
    """Return lenses as they were given in place of those of the view graph, if models speak against one.

    Fundamental matrices of images whose optical axes meet, as of two lenses side by side, hardly tell focal
    lengths, so that the view graph may be off by a factor of two, and with it relative rotations, averaging
    and placement. A model that is good, whatever its images ask for, says nothing against it.
    """
    grade, named = models[0].verdict.grade if models else Grade.DO_NOT_USE, {lens.id for lens in lenses}
    if grade is not Grade.DO_NOT_USE:
        named = {lens.camera for lens in models[0].evidence.lenses if grade is not Grade.GOOD}
    doubted = [found and lens.is_plane for found, lens in zip(intrinsics.by_view_graph, lenses, strict=True)]
    if not any(doubt and lens.id in named for doubt, lens in zip(doubted, lenses, strict=True)):
        return None
    return [lens.as_given() if doubt else lens for doubt, lens in zip(doubted, lenses, strict=True)]


def has_better_models(models: Sequence[LocateResult], others: Sequence[LocateResult]) -> bool:
    """Return whether less speaks against the largest model, with lenses known and no camera lost."""
    if not (models and others):
        return bool(models)
    own, before = models[0], others[0]
    ranks = [(list(Grade).index(one.verdict.grade), _count(one)) for one in (own, before)]
    known = not own.intrinsics.undetermined.any()
    return bool(ranks[0] < ranks[1] and known and own.kept.sum() >= before.kept.sum())
