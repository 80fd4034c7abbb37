"""Models made, and once more where evidence against them can be acted on safely.

A lens that is wrong is freed, a camera goes where most pairs put it, and the new model counts only if less
speaks against it. The side of a seam is never guessed: nothing says which of two groups is wrong. Sensors
whose offsets in their rigs are too short to tell the scale are taken to share one center.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.clock import Clock
from sfm_shapefit.facts.intrinsics import describe_intrinsics
from sfm_shapefit.facts.result import LocateResult
from sfm_shapefit.judgement.limits import OUTNUMBERED
from sfm_shapefit.judgement.rig_offsets import find_contradicted_rigs
from sfm_shapefit.judgement.wrong_lenses import is_like_others
from sfm_shapefit.pipeline.conventions import ask_resolution
from sfm_shapefit.pipeline.inputs import MatchSource, RunInputs
from sfm_shapefit.pipeline.placing import measure_hold
from sfm_shapefit.pipeline.stages import run_stages
from sfm_shapefit.pipeline.starts import begin_model
from sfm_shapefit.placement.gauge import UselessPriorsError
from sfm_shapefit.placement.place import ContradictedOffsetsError
from sfm_shapefit.scene.lens import FOCAL, Origin

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
    if isinstance(result, str):
        given, why = inputs.images.sensors, result
        inputs, source = at_one_center(inputs, source)
        result = _run(inputs, source, clock)
        images = result.images.with_sensors(given.rotations, given.translations)
        wrong = (one.statement for one in find_contradicted_rigs(images, result.directions))
        notes = (f"{next(wrong, why)}, so the sensors of a rig are taken to share one center",)
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


def _run_in_scale(inputs: RunInputs, source: MatchSource, clock: Clock) -> LocateResult | str:
    """Return what the stages make of a source, or why its scale is not that of the rigs, a sentence.

    UnsolvableError: as `make_model`; that directions contradict offsets means nothing where these are short.
    """
    longest = float(np.linalg.norm(inputs.images.sensors.translations, axis=1).max(initial=0.0))
    try:
        result = _run(inputs, source, clock)
        sigma = result.placement.scale_sigma
    except ContradictedOffsetsError as error:
        sigma = measure_hold(error.placement).scale_sigma
        is_short = error.length > -_SHORT or sigma > _OPEN_SCALE
        if not (longest > 0.0 and is_short):
            raise
        sigma = np.inf
    if longest > 0.0 and sigma is not None and sigma > _OPEN_SCALE:
        return (
            f"the offsets of sensors in their rigs, at most {longest:.2g}, are too short for this scene to "
            "tell its scale"
        )
    return result


def at_one_center(inputs: RunInputs, source: MatchSource) -> tuple[RunInputs, MatchSource]:
    """Return the same where the sensors of a rig share one center, so that nothing tells the scale."""
    sensors = inputs.images.sensors
    at_one = sensors.rotations, np.zeros_like(sensors.translations)
    images = source.images.with_sensors(*at_one)
    return replace(inputs, images=inputs.images.with_sensors(*at_one)), source.at(images)


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
