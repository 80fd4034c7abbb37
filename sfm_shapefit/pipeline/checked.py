"""The verdict on a COLMAP model as it stands, whose matches are open; nothing is placed.

Which pairs contradict the model `judgement.evidence` says. A camera is weak if it sees fewer than 30 points,
if its reprojection error is above 0.75 px and above twice what is usual, if its points cover less than 15 %
of the picture, or if more than a third of its pairs contradict it, and more than twice the usual share.

A model is not to be used if its pairs say nothing of where its cameras stand, or for the evidence of
`judgement.grade`; else its weak cameras are to be looked at.

The limits are set by the bundled scenes and twelve sound models of COLMAP, see "What `check` calls weak" in
scripts/results/notes.md.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

import sfm_shapefit.pipeline.write  # noqa: F401  so that results have reports
from sfm_shapefit import __version__
from sfm_shapefit.base.arrays import BoolArray
from sfm_shapefit.base.display import Reported
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.wording import counted
from sfm_shapefit.facts.evidence import tell_evidence
from sfm_shapefit.facts.model import CheckedFacts
from sfm_shapefit.facts.placed import KeyFigures
from sfm_shapefit.facts.tables import CameraRow, PairRow, Tabled
from sfm_shapefit.files.colmap.model import ColmapModel
from sfm_shapefit.files.colmap.points import ModelPictures, points2d_of, points_of
from sfm_shapefit.judgement.evidence import ModelEvidence, PairFits, SecondOpinion, fit_pairs
from sfm_shapefit.judgement.grade import (
    ARE_ITS_PICTURES,
    IS_ITS_DATABASE,
    Grade,
    ModelVerdict,
    weigh_evidence,
)
from sfm_shapefit.judgement.image_quality import ImageQuality, image_quality
from sfm_shapefit.judgement.resolutions import recognize_resolution
from sfm_shapefit.judgement.second_opinion import compare_models
from sfm_shapefit.judgement.verdicts import Verdict
from sfm_shapefit.pairs.options import DirectionOptions
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.pipeline.conventions import ask_convention
from sfm_shapefit.pipeline.evidence import Structure, ask_pixels, gather_evidence
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.pipeline.measure import measure
from sfm_shapefit.pipeline.pictures import points_of_pictures
from sfm_shapefit.scene.images import Images

if TYPE_CHECKING:
    import pycolmap

    from sfm_shapefit.report.drawing import Drawing

_FEWEST_POINTS = 30  # points; an image that sees fewer is weak
_LARGE_PX, _LARGE_OF_USUAL = 0.75, 2.0  # pixels and usual errors; an image whose error is above both is weak
_LEAST_COVERAGE = 0.15  # share of the picture with points; an image with less is weak
_ROUNDING = 1e-9  # share of the largest coordinate; cameras no farther apart stand at the same place


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class CheckResult(Reported, Tabled):
    """The verdict on a model, with the evidence for it."""

    model: ColmapModel
    cameras: list[CameraRow]
    """One row per image, those with a pose first; the reason says what is weak about a camera."""
    pairs: list[PairRow]
    """One row per pair that was looked at."""
    quality: ImageQuality
    facts: CheckedFacts
    """The figures, as `check --json` prints them."""

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


OtherModel = tuple[Images, PairFits, BoolArray]
"""Another model of the same matches, to compare with: where it has the images, how pairs fit it, and which
images (n,) may stand elsewhere by their own matches."""


def check_source(
    model: ColmapModel,
    matches: MatchSource,
    options: DirectionOptions,
    clock: Clock,
    other: OtherModel | None = None,
) -> CheckResult:
    """Judge a model whose matches are open: measure, judge and grade it; another is a second opinion."""
    with clock("points"):
        pictures = ModelPictures(model.images, points2d_of(model.reconstruction, model.images))
        structure = Structure(points_of(model.reconstruction, model.images), model.images, pictures)
        quality = image_quality(*structure[:3])
    fits = None
    with clock("directions"), suppress(UnsolvableError):  # no pair may share matches
        fits = fit_pairs(model.images.centers, measure(matches, options, clock).directions)
        if matches.inputs.is_made:
            structure = points_of_pictures(matches, fits)
    pairs, level_deg = ([], np.nan) if fits is None else (_tell_pairs(model.images, fits), fits.level_deg)
    with clock("evidence"):
        evidence = gather_evidence(matches, fits, structure, clock.threads)
        cameras = _judge_cameras(model, quality, pairs, evidence)
        second = None if fits is None or other is None else _compare(matches, fits, structure, other)
        if fits is not None and second is not None:
            evidence = evidence.beside(second, fits.sides[1])
    verdict = _grade(model, structure, matches, cameras, fits, evidence)
    recognized = recognize_resolution(*structure[:3])
    if verdict.is_bad and recognized is None:
        recognized = ask_convention(matches, clock.threads)
    verdict = verdict.led_by(recognized.sentence if recognized else "")
    told = tell_evidence(evidence, model.images)
    facts = _tell(model, matches, cameras, pairs, quality)
    facts |= {"verdict": verdict, "residual_level_deg": level_deg, "timings_s": clock.seconds}
    facts |= {"evidence": told, "warnings": [*model.notes, *matches.matches.notes, *told.statements]}
    return CheckResult(
        model=model, cameras=cameras, pairs=pairs, quality=quality, facts=CheckedFacts(**facts)
    )


def _compare(
    matches: MatchSource, fits: PairFits, structure: Structure, other: OtherModel
) -> SecondOpinion | None:
    """Return how another model compares; a single camera elsewhere is not, if the pixels confirm it here."""
    images = structure.images
    second = compare_models(images, fits, *other)
    elsewhere = [] if second is None else [*second.wrong, *second.undecided]
    if second is None or len(elsewhere) != 1:  # several that are wrong together see false points together
        return second
    sure = ask_pixels(matches, structure, np.isin(np.arange(images.num_images), elsewhere))
    return second._replace(wrong=second.wrong[:0], undecided=second.undecided[:0]) if sure.any() else second


def _tell_pairs(images: Images, fits: PairFits) -> list[PairRow]:
    """Return a row per pair."""
    rows, directions = [], fits.directions
    for e, status in enumerate(directions.status):
        i, j = directions.pairs[e]
        is_judged = bool(np.isfinite(fits.residuals_deg[e]))
        rows.append(
            PairRow(
                name1=images.names[i],
                name2=images.names[j],
                direction=tuple(directions.directions[e].tolist()) if is_judged else (),
                support=int(directions.num_inliers[e]),
                residual_deg=float(fits.residuals_deg[e]),
                verdict=(Verdict.OUTLIER if fits.contradicts[e] else Verdict.INLIER).value,
                reason="" if is_judged else status.value,
            )
        )
    return rows


def _judge_cameras(
    model: ColmapModel, quality: ImageQuality, pairs: list[PairRow], evidence: ModelEvidence
) -> list[CameraRow]:
    """Return a row per image, those with a pose first."""
    names = model.images.names
    degrees = Counter(name for pair in pairs if pair.direction for name in (pair.name1, pair.name2))
    contradicted = {one.camera: one for one in evidence.contradicted}
    rows = []
    for k, (name, weak) in enumerate(zip(names, _weaknesses(model.images, quality), strict=True)):
        if one := contradicted.get(k):
            weak.append(f"{one.num_against} of its {one.num_pairs} pairs contradict where it stands")
        center = tuple(model.images.centers[k].tolist())
        reason = "; ".join(weak)
        rows.append(
            CameraRow(name=name, placed=True, reason=reason, piece=0, center=center, degree=degrees[name])
        )
    others = set(model.image_names) - set(names)
    return rows + [CameraRow(name=name, reason="it has no pose in the model") for name in sorted(others)]


def _weaknesses(images: Images, quality: ImageQuality) -> Iterator[list[str]]:
    """Yield what is weak about how points hold each image, in words; a frame is held by one of its images."""
    usual_px = _median(quality.errors_px[np.isfinite(quality.errors_px)].tolist())
    num_points, coverage = np.zeros((2, len(images.frames.ids)))
    np.maximum.at(num_points, images.frame_of, quality.num_points)
    np.maximum.at(coverage, images.frame_of, quality.coverage)
    for k, frame in enumerate(images.frame_of.tolist()):
        weak = []
        if len(quality.point_errors_px) == 0:
            pass  # said of the whole model
        elif num_points[frame] < _FEWEST_POINTS:
            seen = f"only {quality.num_points[k]}" if quality.num_points[k] else "no"
            weak.append(f"it sees {seen} 3D points")
        elif coverage[frame] < _LEAST_COVERAGE:
            weak.append(f"its points cover only {quality.coverage[k]:.0%} of the picture")
        if quality.errors_px[k] > max(_LARGE_PX, _LARGE_OF_USUAL * usual_px):
            error_px = quality.errors_px[k]
            weak.append(f"its reprojection error is {error_px:.1f} px, where {usual_px:.1f} px is usual")
        yield weak


def _grade(
    model: ColmapModel,
    structure: Structure,
    matches: MatchSource,
    cameras: list[CameraRow],
    fits: PairFits | None,
    evidence: ModelEvidence,
) -> ModelVerdict:
    """Return the verdict on a model; a weak camera that stands where another model has it is right."""
    images, num_missing = model.images, len(matches.matches.missing_names)
    against = weigh_evidence(evidence, images)
    confirmed = [] if evidence.second is None else evidence.second.confirmed.tolist()
    right = {images.names[k] for k in confirmed}
    weak = (row.name for row in cameras if row.placed and row.reason and row.name not in right)
    named = tuple(dict.fromkeys([*against.cameras, *weak]))
    whose = ARE_ITS_PICTURES if matches.inputs.is_made else IS_ITS_DATABASE
    if (
        bad := (*_reasons_against(images, fits),)
        or against.reasons
        or (*_strange_pairs(images, fits, whose),)
    ):
        return ModelVerdict(grade=Grade.DO_NOT_USE, cameras=named, reasons=bad)
    no_points = not (model.reconstruction.num_points3D() or structure.points.num_points)
    reasons = ("it has no 3D points, so that only matches say where its cameras stand",) if no_points else ()
    if num_missing:
        reasons = (*reasons, f"the database lacks {counted(num_missing, 'image')}: {IS_ITS_DATABASE}")
    reasons = (*reasons, *against.suspicions)
    return ModelVerdict(grade=Grade.LOOK if named or reasons else Grade.GOOD, cameras=named, reasons=reasons)


def _reasons_against(images: Images, fits: PairFits | None) -> Iterator[str]:
    """Yield why a model should not be used, a clause each."""
    if np.ptp(images.centers, axis=0).max() <= _ROUNDING * np.abs(images.centers).max():
        yield "all its cameras stand at the same place; place them with sfm-shapefit locate"
    elif fits is None or not (fits.contradicts.any() or np.isfinite(fits.residuals_deg).any()):
        yield "no two of its images have matches that say how they stand to each other"


def _strange_pairs(images: Images, fits: PairFits | None, whose: str) -> Iterator[str]:
    """Yield that pairs contradict, and none agrees, or too few to check one another.

    A model's own points tie it whatever its database is. Where matches are noise, each pair is one more false
    pose: as many agree as join the cameras, and most others contradict.
    """
    if fits is None:
        return
    against, agreeing = (int(side.sum()) for side in (fits.contradicts, fits.agrees))
    if against and not agreeing:
        yield f"{counted(against, 'pair')} contradict it and none agrees: {whose}"
    elif against > agreeing and agreeing < len(np.unique(images.frame_of[images.is_posed])):
        yield f"{counted(against, 'pair')} contradict it, and only {agreeing} agree, too few to check it"


def _tell(
    model: ColmapModel,
    matches: MatchSource,
    cameras: list[CameraRow],
    pairs: list[PairRow],
    quality: ImageQuality,
) -> dict[str, Any]:
    """Return what is told of a model beside its verdict, by the fields of `CheckedFacts`."""
    error_deg = _median([pair.residual_deg for pair in pairs if pair.direction])
    measures = (float(np.median(model.images.focal_lengths_px)), "of the model's units")
    errors_px = quality.point_errors_px[np.isfinite(quality.point_errors_px)]
    return {
        "inputs": matches.inputs.facts,
        "options": {},
        "num_images": len(cameras),
        "num_placed": model.images.num_images,
        "num_pairs": len(pairs),
        "num_points": model.reconstruction.num_points3D(),
        "figures": KeyFigures.of_cameras(cameras, error_deg, *measures),
        "sigma_of": "",
        "scale": "input: those of the model",
        "has_panoramas": any(lens.is_panorama for lens in model.images.lenses),
        "pieces": [],
        "loose_groups": [],
        "versions": {"sfm_shapefit": __version__, "pycolmap": version("pycolmap")},
        "mean_reprojection_error_px": float(errors_px.mean()) if len(errors_px) else np.nan,
        "median_track_length": _median(quality.point_track_lengths.tolist()),
    }


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else np.nan
