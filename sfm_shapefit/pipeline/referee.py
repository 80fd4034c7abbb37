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

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sfm_shapefit import __version__
from sfm_shapefit.adjustment.sources import collect_matches, collect_tracks
from sfm_shapefit.adjustment.structure import triangulate
from sfm_shapefit.base.arrays import BoolArray
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.display import Reported
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.wording import counted
from sfm_shapefit.facts.map_result import MapResult
from sfm_shapefit.facts.model import CheckedFacts
from sfm_shapefit.facts.placed import KeyFigures
from sfm_shapefit.facts.scale_bars import MeasuredBars
from sfm_shapefit.facts.tables import CameraRow, PairRow, Stated, Table, contradicting, model_options
from sfm_shapefit.files.colmap.model import ColmapModel
from sfm_shapefit.files.colmap.points import ModelKeypoints, points2d_of, points_of
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.grade import too_few_to_judge, weigh_evidence
from sfm_shapefit.judgement.image_quality import ImageQuality, find_weak_images, image_quality
from sfm_shapefit.judgement.pair_fits import PairFits, fit_pairs
from sfm_shapefit.judgement.reasons import (
    ARE_ITS_PICTURES,
    IS_ITS_DATABASE,
    Grade,
    Kind,
    ModelVerdict,
    Reason,
    of_model,
)
from sfm_shapefit.judgement.resolutions import recognize_resolution
from sfm_shapefit.judgement.second_opinion import compare_models
from sfm_shapefit.judgement.verdicts import Verdict
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.pipeline.conventions import ask_convention
from sfm_shapefit.pipeline.examination import ask_pixels, ask_shape, gather_evidence
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.pipeline.measure import measure
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import is_among
from sfm_shapefit.scene.structure import Structure
from sfm_shapefit.tracks.filter import filter_points
from sfm_shapefit.tracks.structure_options import StructureOptions

if TYPE_CHECKING:
    import pycolmap

    from sfm_shapefit.report.drawing import Drawing

_ROUNDING = 1e-9  # share of the largest coordinate; cameras no farther apart stand at the same place


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class CheckResult(Reported, Stated):
    """The verdict on a model, with the evidence for it."""

    model: ColmapModel
    cameras: Table[CameraRow]
    """One row per image, those with a pose first; the reason says what is weak about a camera."""
    pairs: Table[PairRow]
    """One row per pair that was looked at."""
    quality: ImageQuality
    facts: CheckedFacts
    """The figures, as `check --json` prints them."""
    second_opinion: MapResult | None = None
    """What `map_database` made of the same matches, to compare with."""

    @property
    def reconstruction(self) -> "pycolmap.Reconstruction":
        """The model as read, so that the result serves as a model."""
        return self.model.reconstruction

    @cached_property
    def drawing(self) -> "Drawing":
        """The scene, with what the page shows of each image."""
        from sfm_shapefit.report.results import draw_checked

        return draw_checked(self.model, self.cameras, self.pairs, self.quality)

    def with_bars(self, bars: MeasuredBars | None) -> "CheckResult":
        """Return the same with scale bars that were compared with the model."""
        if bars is None:
            return self
        warnings = [*self.facts.warnings, *bars.warnings()]
        return replace(self, facts=replace(self.facts, scale_bars=bars.rows(), warnings=warnings))

    def _headline(self) -> str:
        return f"{self.facts.num_placed} of {self.facts.num_images} images, {self.verdict.statement}"


class OtherModel(NamedTuple):
    """Another model of the same matches, to compare with."""

    images: Images
    """Where it has the images."""
    fits: PairFits
    """How pairs fit it."""
    doubted: BoolArray
    """(n,) images that may stand elsewhere by their own matches."""
    source: MapResult
    """What it is one of."""
    number: int
    """Which of these it is."""


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
        arrays, images = state.model.arrays, state.images
        pictures = ModelKeypoints(images, points2d_of(arrays, images))
        structure = Structure(points_of(arrays, images), images, pictures)
        quality = image_quality(*structure[:3])
        weak = tuple(find_weak_images(images, quality))
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
    reasons, source = tuple(_reasons(state)), state.source
    verdict = ModelVerdict.weigh(reasons)
    if verdict.is_bad and (far := source.inputs.far):
        near = check_source(state.model, source.without(far), state.options, clock.anew()).verdict
        verdict = verdict if near.is_bad else ModelVerdict.weigh(_of_alike_pictures(verdict.findings))
    recognized = recognize_resolution(*state.structure[:3])
    if verdict.is_bad and recognized is None:
        recognized = ask_convention(source, clock.threads)
    verdict = verdict.led_by(recognized and of_model(Kind.INPUT, recognized.sentence))
    return replace(state, reasons=reasons, verdict=verdict)


def finish_check(state: CheckState, clock: Clock) -> CheckResult:
    """Return the result: tables of cameras and pairs, and the figures."""
    model, source, fits, quality = state.model, state.source, state.fits, state.quality
    pairs = _pair_rows(state.images, fits)
    named = [one for one in state.reasons if one.of_each and one.kind is not Kind.SECOND_OPINION]
    cameras = _camera_rows(model, fits, [*state.weak, *(one for one in named if one not in state.weak)])
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


def _of_alike_pictures(findings: Iterable[Reason]) -> Iterator[Reason]:
    """Yield findings of pairs far apart in pose alone: where sides are alike, a sound model has them, too."""
    clause = (
        "pictures of cameras far apart contradict it, neighbors do not: the scene repeats, or it is folded"
    )
    yield of_model(Kind.REPEATED, clause)
    yield from (replace(one, grade=min(one.grade, Grade.LOOK, key=list(Grade).index)) for one in findings)


def _pair_rows(images: Images, fits: PairFits | None) -> Table[PairRow]:
    if fits is None:
        return Table(PairRow, 3, {"name1": []})
    directions, is_judged = fits.directions, np.isfinite(fits.residuals_deg)
    columns = {
        "name1": images.names_of(directions.pairs[:, 0]),
        "name2": images.names_of(directions.pairs[:, 1]),
        "direction": np.where(is_judged[:, None], directions.directions, np.nan),
        "support": directions.num_inliers,
        "residual_deg": fits.residuals_deg,
        "verdict": np.where(fits.contradicts, Verdict.OUTLIER.value, Verdict.INLIER.value),
        "reason": np.where(is_judged, "", [status.value for status in directions.status]),
    }
    return Table(PairRow, 3, columns)


def _camera_rows(model: ColmapModel, fits: PairFits | None, weak: list[Reason]) -> Table[CameraRow]:
    """Return a row per image, those with a pose first."""
    names, others = model.images.names, sorted(set(model.image_names) - set(model.images.names))
    judged = np.zeros((0, 2), dtype=np.int64)
    if fits is not None:
        judged = fits.directions.pairs[np.isfinite(fits.residuals_deg)]
    clauses: dict[str, list[str]] = {name: [] for name in names}
    for one in weak:
        for name in one.images:
            clauses.setdefault(name, []).append(one.sentence)
    columns = {
        "name": names,
        "placed": [True] * len(names),
        "reason": ["; ".join(clauses[name]) for name in names],
        "piece": [0] * len(names),
        "center": model.images.centers,
        "degree": np.bincount(judged.ravel(), minlength=len(names)),
    }
    reasons = ["it has no pose in the model"] * len(others)
    unposed = Table(CameraRow, 3, {"name": others, "reason": reasons})
    return Table(CameraRow, 3, columns).followed_by(unposed)


def _reasons(state: CheckState) -> Iterator[Reason]:
    """Yield what speaks against a model; a weak camera that stands where another model has it is right."""
    model, structure, source = state.model, state.structure, state.source
    fits, evidence = state.fits, state.evidence
    pointless = not (model.num_points or structure.points.num_points)
    centers = model.images.centers
    if np.ptp(centers, axis=0).max() <= _ROUNDING * np.abs(centers).max():
        clause = "all its cameras are at the same place; place them with sfm-shapefit locate"
        yield of_model(Kind.PLACE, clause, Grade.DO_NOT_USE)
        return
    if fits is None or not (fits.contradicts.any() or np.isfinite(fits.residuals_deg).any()):
        is_bare = pointless and not source.inputs.database
        clause = "no two of its images have matches that say where they are relative to each other"
        clause = "it has no 3D points, and no database was given or found" if is_bare else clause
        yield of_model(Kind.UNCHECKED, clause, Grade.CANNOT_BE_JUDGED)
    yield from too_few_to_judge(model.images.num_images)
    against = list(weigh_evidence(evidence, model.images))
    yield from against
    if fits is not None and not any(one.grade is Grade.DO_NOT_USE for one in against):
        yield from _none_agrees(fits, source)
    yield from (one for one in state.weak if not evidence.opinion.confirmed.issuperset(one.images))
    if pointless:
        clause = "it has no 3D points, so that only matches support where its cameras are"
        yield of_model(Kind.POINTS, clause)
    if num_missing := len(source.matches.missing_names):
        clause = f"the database lacks {counted(num_missing, 'image')}: {IS_ITS_DATABASE}"
        yield of_model(Kind.INPUT, clause)


def _none_agrees(fits: PairFits, source: MatchSource) -> Iterator[Reason]:
    """Yield that pairs contradict and none agrees; a model's own points tie it whatever its database is."""
    if (against := int(fits.contradicts.sum())) and not fits.agrees.any():
        whose = ARE_ITS_PICTURES if source.inputs.is_made else IS_ITS_DATABASE
        question = f": {whose}" * (source.inputs.database is not None)
        pairs = f"{counted(against, 'pair')} contradict{'s' * (against == 1)} it"
        yield of_model(Kind.INPUT, f"{pairs} and none agrees{question}", Grade.DO_NOT_USE)


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else np.nan


def points_of_pictures(source: MatchSource, fits: PairFits) -> Structure:
    """Return the points that matches make where the cameras stand, but for those of contradicting pairs."""
    images, view = source.images, source.view
    pictures = ModelKeypoints(images, view.keypoints, view.num_keypoints)
    links = view.links(chosen=~is_among(view.pairs, fits.sides[1]))
    matches = collect_matches(images, pictures, np.arange(images.num_images), links, view.num_matches)
    options = StructureOptions()
    points = triangulate(images, matches, options)
    return Structure(filter_points(points, images, pictures, options), images, pictures)
