"""The verdict on a COLMAP model as it stands, whose matches are open; nothing is placed.

Which pairs contradict the model `judgement.evidence` says. A camera is weak if it sees fewer than 30 points,
if its reprojection error is above 0.75 px and above twice what is usual, or if more than a third of its pairs
contradict it, and more than twice the usual share. How much of the picture its points cover is told, and
decides nothing: on an object before a plain wall they cover little.

A model cannot be judged if it has two cameras only, or if its pairs say nothing of where its cameras stand.
It is not to be used for the evidence of `judgement.grade`; else its weak cameras are to be looked at.

The limits are set by the bundled scenes and twelve sound models of COLMAP, see "What `check` calls weak" in
scripts/results/notes.md.
"""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import sfm_shapefit.pipeline.write  # noqa: F401  so that results show their report in notebooks
from sfm_shapefit import __version__
from sfm_shapefit.adjustment.sources import collect_tracks
from sfm_shapefit.base.arrays import BoolArray
from sfm_shapefit.base.display import Reported
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.wording import counted
from sfm_shapefit.facts.map_result import MapResult
from sfm_shapefit.facts.model import CheckedFacts
from sfm_shapefit.facts.placed import KeyFigures
from sfm_shapefit.facts.tables import CameraRow, PairRow, Table, Tabled
from sfm_shapefit.files.colmap.model import ColmapModel
from sfm_shapefit.files.colmap.points import ModelPictures, points2d_of, points_of
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.grade import too_few_to_judge, weigh_evidence
from sfm_shapefit.judgement.image_quality import ImageQuality, image_quality
from sfm_shapefit.judgement.pair_fits import PairFits, fit_pairs
from sfm_shapefit.judgement.reasons import (
    ARE_ITS_PICTURES,
    IS_ITS_DATABASE,
    Grade,
    Kind,
    ModelVerdict,
    Reason,
    of_each,
    of_model,
)
from sfm_shapefit.judgement.resolutions import recognize_resolution
from sfm_shapefit.judgement.second_opinion import SecondOpinion, compare_models
from sfm_shapefit.judgement.verdicts import Verdict
from sfm_shapefit.pairs.options import DirectionOptions
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.pipeline.conventions import ask_convention
from sfm_shapefit.pipeline.evidence import Structure, ask_pixels, ask_shape, gather_evidence
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.pipeline.measure import measure
from sfm_shapefit.pipeline.pictures import points_of_pictures
from sfm_shapefit.scene.images import Images

if TYPE_CHECKING:
    import pycolmap

    from sfm_shapefit.report.drawing import Drawing

_FEWEST_POINTS = 30  # points; an image that sees fewer is weak
_LARGE_PX, _LARGE_OF_USUAL = 0.75, 2.0  # pixels and usual errors; an image whose error is above both is weak
_ROUNDING = 1e-9  # share of the largest coordinate; cameras no farther apart stand at the same place


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class CheckResult(Reported, Tabled):
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

    @property
    def verdict(self) -> ModelVerdict:
        """Whether the model can be used, and why."""
        return self.facts.verdict

    @cached_property
    def drawing(self) -> "Drawing":
        """The scene, with what the page shows of each image."""
        from sfm_shapefit.report.results import draw_checked

        return draw_checked(self.model, self.cameras, self.pairs, self.quality)

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


def check_source(
    model: ColmapModel,
    matches: MatchSource,
    options: DirectionOptions,
    clock: Clock,
    other: OtherModel | None = None,
) -> CheckResult:
    """Judge a model whose matches are open: measure, judge and grade it; another is a second opinion."""
    with clock("points"):
        pictures = ModelPictures(model.images, points2d_of(model.arrays, model.images))
        structure = Structure(points_of(model.arrays, model.images), model.images, pictures)
        quality = image_quality(*structure[:3])
    fits = None
    with clock("directions"), suppress(UnsolvableError):  # no pair may share matches
        fits = fit_pairs(model.images.centers, measure(matches, options, clock).directions)
        if matches.inputs.is_made:
            structure = points_of_pictures(matches, fits)
    pairs, level_deg = _tell_pairs(model.images, fits), np.nan if fits is None else fits.level_deg
    with clock("evidence"):
        evidence = gather_evidence(matches, fits, structure, clock.threads)
        if matches.inputs.is_made or not matches.has_database:  # nothing else measured lenses
            tracks = collect_tracks(model.images, structure.pictures, structure.points)
            rows = np.arange(model.images.num_images)
            evidence = replace(evidence, shape=ask_shape(model.images, rows, tracks))
        weak = list(_find_weak(model.images, quality))
        second = None if fits is None or other is None else _compare(matches, fits, structure, other)
        if fits is not None and second is not None:
            names, (_, against) = model.images.names, fits.sides
            evidence = evidence.beside(second, [(names[i], names[j]) for i, j in against.tolist()])
    reasons = list(_reasons(model, structure, weak, fits, evidence, matches))
    verdict = ModelVerdict.weigh(reasons)
    if verdict.is_bad and (far := matches.inputs.far):
        near = check_source(model, matches.without(far), options, clock.anew()).verdict
        verdict = verdict if near.is_bad else ModelVerdict.weigh(_of_alike_pictures(verdict.findings))
    recognized = recognize_resolution(*structure[:3])
    if verdict.is_bad and recognized is None:
        recognized = ask_convention(matches, clock.threads)
    verdict = verdict.led_by(recognized and of_model(Kind.INPUT, recognized.sentence))
    more = (one for one in reasons if one.of_each and one not in weak and one.kind is not Kind.SECOND_OPINION)
    cameras = _tell_cameras(model, fits, [*weak, *more])
    facts = _tell(model, matches, cameras, pairs, quality)
    facts |= {"verdict": verdict, "residual_level_deg": level_deg, "timings_s": clock.seconds}
    facts |= {"evidence": evidence, "warnings": [*model.notes, *matches.matches.notes, *evidence.statements]}
    return CheckResult(
        model=model,
        cameras=cameras,
        pairs=pairs,
        quality=quality,
        facts=CheckedFacts(**facts),
        second_opinion=other and other.source,
    )


def _of_alike_pictures(findings: Iterable[Reason]) -> Iterator[Reason]:
    """Yield findings of pairs far apart in pose alone: where sides are alike, a sound model has them, too."""
    clause = (
        "pictures of cameras far apart contradict it, neighbors do not: the scene repeats, or it is folded"
    )
    yield of_model(Kind.REPEATED, clause)
    yield from (replace(one, grade=min(one.grade, Grade.LOOK, key=list(Grade).index)) for one in findings)


def _compare(
    matches: MatchSource, fits: PairFits, structure: Structure, other: OtherModel
) -> SecondOpinion | None:
    """Return how another model compares; a single camera elsewhere is not, if the pixels confirm it here."""
    images = structure.images
    second = compare_models(images, fits, other.images, other.fits, other.doubted)
    if second is None:
        return None
    grade = other.source.models[other.number].located.verdict.grade
    second = replace(second, grade=grade, folder=str(other.number))
    elsewhere = [*second.wrong, *second.undecided]
    if len(elsewhere) != 1:  # several that are wrong together see false points together
        return second
    is_confirmed = ask_pixels(matches, structure, elsewhere)
    return replace(second, wrong=(), undecided=()) if is_confirmed else second


def _tell_pairs(images: Images, fits: PairFits | None) -> Table[PairRow]:
    """Return a row per pair; none without any."""
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


def _tell_cameras(model: ColmapModel, fits: PairFits | None, weak: list[Reason]) -> Table[CameraRow]:
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


def _find_weak(images: Images, quality: ImageQuality) -> Iterator[Reason]:
    """Yield what is weak about how points hold each image; a frame is held by one of its images."""
    usual_px = _median(quality.errors_px[np.isfinite(quality.errors_px)].tolist())
    num_points = np.zeros(len(images.frames.ids))
    np.maximum.at(num_points, images.frame_of, quality.num_points)
    has_points = len(quality.point_errors_px) > 0  # a lack of all is said of the whole model
    for k, frame in enumerate(images.frame_of.tolist()):
        if has_points and num_points[frame] < _FEWEST_POINTS:
            seen = f"only {quality.num_points[k]}" if quality.num_points[k] else "no"
            yield from of_each(Kind.POINTS, images.names[k : k + 1], f"it sees {seen} 3D points")
        if quality.errors_px[k] > max(_LARGE_PX, _LARGE_OF_USUAL * usual_px):
            error_px = quality.errors_px[k]
            clause = f"its reprojection error is {error_px:.1f} px, where {usual_px:.1f} px is usual"
            yield from of_each(Kind.POINTS, images.names[k : k + 1], clause)


def _reasons(
    model: ColmapModel,
    structure: Structure,
    weak: list[Reason],
    fits: PairFits | None,
    evidence: ModelEvidence,
    matches: MatchSource,
) -> Iterator[Reason]:
    """Yield what speaks against a model; a weak camera that stands where another model has it is right."""
    pointless = not (model.num_points or structure.points.num_points)
    centers = model.images.centers
    if np.ptp(centers, axis=0).max() <= _ROUNDING * np.abs(centers).max():
        clause = "all its cameras stand at the same place; place them with sfm-shapefit locate"
        yield of_model(Kind.PLACE, clause, Grade.DO_NOT_USE)
        return
    if fits is None or not (fits.contradicts.any() or np.isfinite(fits.residuals_deg).any()):
        is_bare = pointless and not matches.inputs.database
        clause = "no two of its images have matches that say how they stand to each other"
        clause = "it has no 3D points, and no database was given or found" if is_bare else clause
        yield of_model(Kind.UNCHECKED, clause, Grade.CANNOT_BE_JUDGED)
    yield from too_few_to_judge(model.images.num_images)
    against = list(weigh_evidence(evidence, model.images))
    yield from against
    if fits is not None and not any(one.grade is Grade.DO_NOT_USE for one in against):
        yield from _none_agrees(fits, matches)
    yield from (one for one in weak if not evidence.opinion.confirmed.issuperset(one.images))
    if pointless:
        clause = "it has no 3D points, so that only matches say where its cameras stand"
        yield of_model(Kind.POINTS, clause)
    if num_missing := len(matches.matches.missing_names):
        clause = f"the database lacks {counted(num_missing, 'image')}: {IS_ITS_DATABASE}"
        yield of_model(Kind.INPUT, clause)


def _none_agrees(fits: PairFits, matches: MatchSource) -> Iterator[Reason]:
    """Yield that pairs contradict and none agrees; a model's own points tie it whatever its database is."""
    if (against := int(fits.contradicts.sum())) and not fits.agrees.any():
        whose = ARE_ITS_PICTURES if matches.inputs.is_made else IS_ITS_DATABASE
        asked = f": {whose}" * (matches.inputs.database is not None)
        pairs = f"{counted(against, 'pair')} contradict{'s' * (against == 1)} it"
        yield of_model(Kind.INPUT, f"{pairs} and none agrees{asked}", Grade.DO_NOT_USE)


def _tell(
    model: ColmapModel,
    matches: MatchSource,
    cameras: Table[CameraRow],
    pairs: Table[PairRow],
    quality: ImageQuality,
) -> dict[str, Any]:
    """Return what is told of a model beside its verdict, by the fields of `CheckedFacts`."""
    residuals_deg = pairs.columns["residual_deg"]
    error_deg = _median(residuals_deg[np.isfinite(residuals_deg)].tolist())
    measures = (float(np.median(model.images.focal_lengths_px)), "of the model's units")
    errors_px = quality.point_errors_px[np.isfinite(quality.point_errors_px)]
    return {
        "inputs": matches.inputs.facts,
        "images": matches.inputs.images and str(matches.inputs.images),
        "options": {},
        "num_images": len(cameras),
        "num_placed": model.images.num_images,
        "num_pairs": len(pairs),
        "num_points": model.num_points,
        "figures": KeyFigures.of_cameras(cameras, error_deg, *measures),
        "sigma_of": "",
        "scale": "input: those of the model",
        "pieces": [],
        "loose_groups": [],
        "versions": {"sfm_shapefit": __version__, "pycolmap": version("pycolmap")},
        "mean_reprojection_error_px": float(errors_px.mean()) if len(errors_px) else np.nan,
        "num_lenses": len(np.unique(model.images.lens_of)),
        "median_track_length": _median(quality.point_track_lengths.tolist()),
    }


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else np.nan
