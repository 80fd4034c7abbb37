"""The verdict on a COLMAP model as it stands, whose matches are open; nothing is placed.

    read_structure            the model's points, and which images they hold weakly
    fit_directions            directions of all pairs, against where the cameras stand
    gather_evidence_against   `evidence`: the same as of a model that `locate` has made
    compare_with_other        a second opinion
    grade_model               the verdict
    finish_check              the result

Which pairs contradict the model `judgement.evidence` says, and which images are weak
`judgement.image_quality`. A model cannot be judged if it has two cameras only, or if its pairs say nothing of
where its cameras stand. It is not to be used for the evidence of `judgement.grade`; else its weak cameras are
to be looked at.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any

import numpy as np

from sfm_shapefit import __version__
from sfm_shapefit.adjustment.sources import collect_tracks
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.facts.check_result import CheckResult, OtherModel, checked_camera_rows, checked_pair_rows
from sfm_shapefit.facts.model import CheckedFacts
from sfm_shapefit.facts.placed import KeyFigures
from sfm_shapefit.facts.tables import contradicting, model_options
from sfm_shapefit.files.colmap.model import ColmapModel
from sfm_shapefit.files.colmap.points import structure_of
from sfm_shapefit.judgement.check_reasons import CheckedModel, of_alike_pictures, reasons_against
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.image_quality import ImageQuality, find_weak_images, image_quality
from sfm_shapefit.judgement.pair_fits import PairFits, fit_pairs
from sfm_shapefit.judgement.reasons import Kind, ModelVerdict, Reason, of_model
from sfm_shapefit.judgement.resolutions import recognize_resolution
from sfm_shapefit.judgement.second_opinion import compare_models
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.pipeline.bundle import points_of_pictures
from sfm_shapefit.pipeline.conventions import ask_convention
from sfm_shapefit.pipeline.examination import ask_pixels, ask_shape, gather_evidence, with_lens_evidence
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.pipeline.measure import measure
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.structure import Structure

_LATER: Any = None
"""In place of what a later stage finds out."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CheckState:
    """A model as it stands between two stages of its check, which replace what they find out."""

    model: ColmapModel
    source: MatchSource
    options: DirectionOptions
    other: OtherModel | None = None
    structure: Structure = _LATER
    """The points of the model, or those that the matches of its pictures make."""
    quality: ImageQuality = _LATER
    fits: PairFits | None = None
    """How pairs fit; None if no pair has a match."""
    evidence: ModelEvidence = _LATER
    weak: tuple[Reason, ...] = ()
    """What is weak about how points hold images."""
    reasons: tuple[Reason, ...] = ()
    """What speaks against the model."""
    verdict: ModelVerdict = _LATER

    @property
    def images(self) -> Images:
        """The images of the model."""
        return self.model.images


def check_source(
    model: ColmapModel,
    source: MatchSource,
    options: DirectionOptions,
    clock: Clock,
    other: OtherModel | None = None,
) -> CheckResult:
    """Judge a model whose matches are open, by the stages of the module's header."""
    state = CheckState(model=model, source=source, options=options, other=other)
    state = read_structure(state, clock)
    state = fit_directions(state, clock)
    with clock("evidence"):
        state = compare_with_other(gather_evidence_against(state, clock))
    return finish_check(grade_model(state, clock), clock)


def read_structure(state: CheckState, clock: Clock) -> CheckState:
    """Read the points of a model, and how well they hold each image."""
    with clock("points"):
        images = state.images
        structure = structure_of(state.model.arrays, images)
        quality = image_quality(structure)
        weak = tuple(find_weak_images(state.images, quality))
        return replace(state, structure=structure, quality=quality, weak=weak)


def fit_directions(state: CheckState, clock: Clock) -> CheckState:
    """Measure the directions of pairs, and compare them with where the cameras stand."""
    source, fits, structure = state.source, None, state.structure
    with clock("directions"), suppress(UnsolvableError):  # no pair may share matches
        fits = fit_pairs(state.images.centers, measure(source, state.options, clock).directions)
        if source.inputs.is_made:
            structure = points_of_pictures(source, fits)
    return replace(state, fits=fits, structure=structure)


def gather_evidence_against(state: CheckState, clock: Clock) -> CheckState:
    """Gather the evidence as `locate` does, with the open shape where nothing else has measured lenses."""
    source, structure = state.source, state.structure
    evidence = gather_evidence(source, state.fits, structure, clock.threads)
    evidence = with_lens_evidence(evidence, source, structure, clock.threads)
    if source.inputs.is_made or not source.has_database:
        tracks = collect_tracks(state.images, structure.pictures, structure.points)
        rows = np.arange(state.images.num_images)
        evidence = replace(evidence, shape=ask_shape(state.images, rows, tracks, clock.threads))
    return replace(state, evidence=evidence)


def compare_with_other(state: CheckState) -> CheckState:
    """Add to the evidence how the other model compares, if there is one.

    A single camera that stands elsewhere there does not count if the pixels confirm it here.
    """
    fits, other, images = state.fits, state.other, state.structure.images
    if fits is None or other is None:
        return state
    second = compare_models(images, fits, other.images, other.fits, other.doubted)
    if second is None:
        return state
    grade = other.source.models[other.number].verdict.grade
    second = replace(second, grade=grade, folder=str(other.number))
    elsewhere = [*second.wrong, *second.undecided]
    # Several that are wrong together see false points together.
    if len(elsewhere) == 1 and ask_pixels(state.source, state.structure, elsewhere):
        second = replace(second, wrong=(), undecided=())
    names, (_, against) = state.images.names, fits.sides
    contradicting = [(names[i], names[j]) for i, j in against.tolist()]
    return replace(state, evidence=state.evidence.beside(second, contradicting))


def grade_model(state: CheckState, clock: Clock) -> CheckState:
    """Weigh what speaks against the model; an input in another convention or resolution explains the rest."""
    source = state.source
    known = CheckedModel(
        images=state.images,
        fits=state.fits,
        evidence=state.evidence,
        weak=state.weak,
        has_points=bool(state.model.num_points or state.structure.points.num_points),
        has_database=source.has_database,
        is_matched_here=source.inputs.is_made,
        num_missing=len(source.matches.missing_names),
    )
    reasons = tuple(reasons_against(known))
    verdict = ModelVerdict.weigh(reasons)
    if verdict.is_bad and (far := source.inputs.far):
        near = check_source(state.model, source.without(far), state.options, clock.anew()).verdict
        verdict = verdict if near.is_bad else ModelVerdict.weigh(of_alike_pictures(verdict.findings))
    recognized, fault = recognize_resolution(state.structure), None
    if verdict.is_bad and recognized is None:
        fault = verdict.fault_of_input(state.images.num_images)
        recognized = None if fault else ask_convention(source, clock.threads)
    verdict = verdict.led_by(fault or (recognized and of_model(Kind.INPUT, recognized.sentence)))
    return replace(state, reasons=reasons, verdict=verdict)


def finish_check(state: CheckState, clock: Clock) -> CheckResult:
    """Return the result: tables of cameras and pairs, and the figures."""
    model, source, fits, quality = state.model, state.source, state.fits, state.quality
    pairs = checked_pair_rows(state.images, fits)
    named = [one for one in state.reasons if one.of_each and one.kind is not Kind.SECOND_OPINION]
    cameras = checked_camera_rows(
        model, fits, [*state.weak, *(one for one in named if one not in state.weak)]
    )
    residuals_deg = pairs.columns["residual_deg"]
    error_deg = _median(residuals_deg[np.isfinite(residuals_deg) & ~contradicting(pairs)].tolist())
    errors_px = quality.point_errors_px[np.isfinite(quality.point_errors_px)]
    facts = CheckedFacts(
        inputs=source.inputs.facts,
        images=str(source.inputs.images) if source.inputs.images else None,
        options=model_options(source.inputs.folder),
        verdict=state.verdict,
        num_images=len(cameras),
        num_placed=state.images.num_images,
        num_pairs=len(pairs),
        num_points=model.num_points,
        figures=KeyFigures.of_cameras(
            cameras, error_deg, float(np.median(state.images.focal_lengths_px)), "of the model's units"
        ),
        sigma_of="",
        scale="input: those of the model",
        pieces=[],
        loose_groups=[],
        versions={"sfm_shapefit": __version__, "pycolmap": version("pycolmap")},
        mean_reprojection_error_px=float(errors_px.mean()) if len(errors_px) else np.nan,
        num_lenses=len(np.unique(state.images.lens_of)),
        median_track_length=_median(quality.point_track_lengths.tolist()),
        residual_level_deg=np.nan if fits is None else fits.level_deg,
        timings_s=clock.seconds,
        evidence=state.evidence,
        warnings=[*model.notes, *source.matches.notes, *state.evidence.statements],
    )
    return CheckResult(
        model=model,
        cameras=cameras,
        pairs=pairs,
        quality=quality,
        facts=facts,
        second_opinion=state.other and state.other.source,
    )


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else np.nan
