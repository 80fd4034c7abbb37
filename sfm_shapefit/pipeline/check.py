"""`check MODEL`: the verdict on a COLMAP model as it stands; nothing is placed.

A pair contradicts the model if the direction that its matches say is off the model's baseline by more than a
degree, and by more than six times what is usual. A camera is weak if it sees fewer than 30 points, if its
reprojection error is above 0.75 px and above twice what is usual, if its points cover less than 15 % of the
picture, or if more than a third of its pairs contradict it, and more than twice the usual share.

A model is not to be used if its pairs say nothing of where its cameras stand, if they are typically off by
more than 5 degrees, or if less than a quarter of them agree; else its weak cameras are to be looked at.

These limits are set by the bundled scenes (courtyard, photographed, ring8, facade9) and twelve models of
COLMAP: fountain-P11, Herz-Jesus-P8 and P25, castle-P19 and P30, lego, liberty, a street of KITTI, a beach
from a drone, a park by a rig of fisheyes (twice), a hall with robots. In all of them, sound as they are:

    reprojection error     at most 1.74 times the usual; at most 0.67 px where twice the usual is below
                           0.75 px (exact matches: 1e-11 px, 72 times the usual)
    points, coverage       40 or more and 17 % or more, but in the park: from 11 and from 5 %
    pairs that contradict  at most a third of a camera's; at courtyard, where a quarter of all pairs is
                           wrong, 23 % in the median and 54 % at most; in the park 25 % in the median,
                           70 % at most; lego has four cameras above a third, of five that are wrong

Where a tenth of the cameras was moved by 0.2 % of the scene's extent, or turned by 0.2 degrees, their errors
were 2.4 times the usual or more, but for one at facade9 and one at liberty (2.0 and 1.9) and for the park,
whose wide lenses show it little. If a camera is moved by 1 %, 35 % or more of its pairs contradict it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import sfm_shapefit.pipeline.write  # noqa: F401  so that results have reports
from sfm_shapefit import __version__
from sfm_shapefit.base.display import Reported
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import SIGMA_PER_MEDIAN, angle_between_deg, normalized
from sfm_shapefit.facts.evidence import tell_evidence
from sfm_shapefit.facts.model import CheckedFacts
from sfm_shapefit.facts.placed import KeyFigures
from sfm_shapefit.facts.tables import CameraRow, Column, PairRow, TableName, table_of
from sfm_shapefit.files.colmap.model import ColmapModel, ModelSource, read_model
from sfm_shapefit.files.colmap.points import ModelPictures, points2d_of, points_of
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.grade import (
    LEAST_PAIRS,
    MOST_LEVEL_DEG,
    Against,
    Grade,
    ModelVerdict,
    weigh_evidence,
)
from sfm_shapefit.judgement.image_quality import ImageQuality, image_quality
from sfm_shapefit.judgement.verdicts import Verdict
from sfm_shapefit.pairs.options import DirectionOptions
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.pipeline.clock import Clock, Progress
from sfm_shapefit.pipeline.evidence import gather_evidence, question_pairs
from sfm_shapefit.pipeline.inputs import MatchSource, choose_inputs, open_source
from sfm_shapefit.pipeline.measure import measure
from sfm_shapefit.scene.images import Images
from sfm_shapefit.solver.options import SolverOptions

if TYPE_CHECKING:
    from sfm_shapefit.report.drawing import Drawing

# The header says what set these limits.
_FAR_DEG, _FAR_LEVELS = 1.0, 6.0  # degrees and usual levels; a pair that is off by both contradicts the model
_FEWEST_POINTS = 30  # points; an image that sees fewer is weak
_LARGE_PX, _LARGE_OF_USUAL = 0.75, 2.0  # pixels and usual errors; an image whose error is above both is weak
_LEAST_COVERAGE = 0.15  # share of the picture with points; an image with less is weak
_ROUNDING = 1e-9  # share of the largest coordinate; cameras no farther apart stand at the same place
_FEWEST_PAIRS = 3  # pairs with a direction; the share of fewer that contradict says nothing
_LARGE_SHARE, _SHARE_OF_USUAL = 1 / 3, 2.0  # pairs and usual shares; a camera that more contradict is weak


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class CheckResult(Reported):
    """The verdict on a model, with the evidence for it."""

    model: ColmapModel
    """The model as read."""
    cameras: list[CameraRow]
    """One row per image, those with a pose first; the reason says what is weak about a camera."""
    pairs: list[PairRow]
    """One row per pair that was looked at."""
    quality: ImageQuality
    facts: CheckedFacts
    """The figures, as `check --json` prints them."""

    @property
    def verdict(self) -> ModelVerdict:
        """Whether the model can be used, and why."""
        return self.facts.verdict

    def table(self, name: TableName) -> dict[str, Column]:
        """Return "cameras" or "pairs" as columns, arrays by their names in the CSV; pandas takes them."""
        return table_of(self, name, 3)

    @cached_property
    def drawing(self) -> "Drawing":
        """The scene, with what the page shows of each image."""
        from sfm_shapefit.report.results import draw_checked

        return draw_checked(self.model, self.cameras, self.pairs, self.quality)

    def _headline(self) -> str:
        return f"{self.facts.num_placed} of {self.facts.num_images} images, {self.verdict.statement}"


def check(
    model: ModelSource,
    database: Path | str | None = None,
    *,
    progress: Progress | None = None,
) -> CheckResult:
    """Judge a COLMAP model as it stands, whatever program made it; the model is not changed.

    Args:
        model: a reconstruction, a result or a model folder, as for `locate`.
        database: as for `locate`; without one, the pairs are those that share points of the model, which
            agree with it more easily.
        progress: called as stages advance.

    Raises:
        InputError: if the model or the database cannot be used.
    """
    clock = Clock.of(progress, SolverOptions())
    with clock("read"):
        posed = read_model(model)
        inputs = choose_inputs(model, database)
    with open_source(posed, inputs) as matches:
        return check_source(posed, matches, DirectionOptions(), clock)


def check_source(
    model: ColmapModel, matches: MatchSource, options: DirectionOptions, clock: Clock
) -> CheckResult:
    """Judge a model whose matches are open: measure, judge and grade it.

    Args:
        model: not changed.
        matches: of its images.
        options: how directions are measured.
        clock: what it takes is added to its seconds.
    """
    quality, directions = _measure(model, matches, options, clock)
    pairs, level_deg = _judge_pairs(model.images, directions)
    cameras = _judge_cameras(model, quality, pairs)
    evidence = _question(model, matches, directions, clock)
    verdict = _grade(model, cameras, pairs, level_deg, weigh_evidence(evidence, model.images))
    told = tell_evidence(evidence, model.images)
    facts = _tell(model, matches, verdict, cameras, pairs, level_deg) | _tell_points(quality)
    facts |= {"timings_s": clock.seconds, "evidence": told, "warnings": told.statements}
    return CheckResult(
        model=model, cameras=cameras, pairs=pairs, quality=quality, facts=CheckedFacts(**facts)
    )


def _measure(
    model: ColmapModel, matches: MatchSource, options: DirectionOptions, clock: Clock
) -> tuple[ImageQuality, PairDirections | None]:
    """Return how well points hold the images, and the directions of pairs; None where no pair shares any."""
    images = model.images
    with clock("points"):
        pictures = ModelPictures(images, points2d_of(model.reconstruction, images))
        quality = image_quality(points_of(model.reconstruction, images), images, pictures)
    with clock("directions"):
        try:
            return quality, measure(matches, options, clock).directions
        except UnsolvableError:
            return quality, None


def _question(
    model: ColmapModel, matches: MatchSource, directions: PairDirections | None, clock: Clock
) -> ModelEvidence:
    """Return the evidence against a model that its fit did not use."""
    images, evidence = model.images, ModelEvidence()
    with clock("evidence"):
        if directions is not None:
            evidence = question_pairs(matches, directions, images.centers, clock.threads)
        points = points_of(model.reconstruction, images)
        pictures = ModelPictures(images, points2d_of(model.reconstruction, images))
        return gather_evidence(images, points, pictures, evidence, clock.threads)


def _judge_pairs(images: Images, directions: PairDirections | None) -> tuple[list[PairRow], float]:
    """Return a row per pair, and the level of the residuals in degrees; NaN where no pair has any."""
    if directions is None:
        return [], np.nan
    i, j = directions.pairs.T
    usable, baselines = directions.usable(), images.centers[i] - images.centers[j]
    usable = usable[np.linalg.norm(baselines[usable], axis=1) > 0.0]
    residuals = np.full(len(i), np.nan)
    residuals[usable] = angle_between_deg(directions.directions[usable], normalized(baselines[usable]))
    level = SIGMA_PER_MEDIAN * float(np.median(residuals[usable])) if len(usable) else np.nan
    limit = max(_FAR_DEG, _FAR_LEVELS * min(np.nan_to_num(level), MOST_LEVEL_DEG))
    rows = []
    for e, status in enumerate(directions.status):
        is_judged = bool(np.isfinite(residuals[e]))
        rows.append(
            PairRow(
                name1=images.names[i[e]],
                name2=images.names[j[e]],
                direction=tuple(directions.directions[e].tolist()) if is_judged else (),
                support=int(directions.num_inliers[e]),
                residual_deg=float(residuals[e]),
                verdict=(Verdict.INLIER if residuals[e] <= limit else Verdict.OUTLIER).value,
                reason="" if is_judged else status.value,
            )
        )
    return rows, level


def _judge_cameras(model: ColmapModel, quality: ImageQuality, pairs: list[PairRow]) -> list[CameraRow]:
    """Return a row per image, those with a pose first."""
    names = model.images.names
    degrees, wrong = dict.fromkeys(names, 0), dict.fromkeys(names, 0)
    for pair in pairs:
        for name in (pair.name1, pair.name2):
            degrees[name] += bool(pair.direction)
            wrong[name] += bool(pair.direction) and pair.verdict == Verdict.OUTLIER.value
    shares = [wrong[name] / degrees[name] for name in names if degrees[name] >= _FEWEST_PAIRS]
    usual = _Usual(_median(quality.errors_px[np.isfinite(quality.errors_px)].tolist()), _median(shares))
    rows = [
        CameraRow(
            name=name,
            placed=True,
            reason="; ".join(_weaknesses(quality, k, usual, (wrong[name], degrees[name]))),
            piece=0,
            center=tuple(model.images.centers[k].tolist()),
            degree=degrees[name],
        )
        for k, name in enumerate(names)
    ]
    others = set(model.image_names) - set(names)
    return rows + [CameraRow(name=name, reason="it has no pose in the model") for name in sorted(others)]


class _Usual(NamedTuple):
    """Medians over the images of a model; NaN where there are no values."""

    error_px: float
    share: float
    """Share of the pairs that contradict an image."""


def _weaknesses(quality: ImageQuality, k: int, usual: _Usual, pairs: tuple[int, int]) -> Iterator[str]:
    """Yield what is weak about an image, in words; `pairs` counts those that contradict it, and all of it."""
    wrong, total = pairs
    if len(quality.point_errors_px) == 0:
        pass  # said of the whole model
    elif quality.num_points[k] < _FEWEST_POINTS:
        yield f"it sees only {quality.num_points[k]} 3D points"
    elif quality.coverage[k] < _LEAST_COVERAGE:
        yield f"its points cover only {quality.coverage[k]:.0%} of the picture"
    if quality.errors_px[k] > max(_LARGE_PX, _LARGE_OF_USUAL * usual.error_px):
        error_px, usual_px = quality.errors_px[k], usual.error_px
        yield f"its reprojection error is {error_px:.1f} px, where {usual_px:.1f} px is usual"
    if total >= _FEWEST_PAIRS and wrong > total * max(_LARGE_SHARE, _SHARE_OF_USUAL * usual.share):
        yield f"{wrong} of its {total} pairs contradict where it stands"


def _grade(
    model: ColmapModel, cameras: list[CameraRow], pairs: list[PairRow], level_deg: float, against: Against
) -> ModelVerdict:
    """Return the verdict on a model as it stands."""
    weak = (row.name for row in cameras if row.placed and row.reason)
    named = tuple(dict.fromkeys([*against.cameras, *weak]))
    if bad := (*_reasons_against(model.images, pairs, level_deg), *against.reasons):
        return ModelVerdict(grade=Grade.DO_NOT_USE, cameras=named, reasons=bad)
    pointless = model.reconstruction.num_points3D() == 0
    reasons = ("it has no 3D points, so that only matches say where its cameras stand",) if pointless else ()
    reasons = (*reasons, *against.suspicions)
    return ModelVerdict(grade=Grade.LOOK if named or reasons else Grade.GOOD, cameras=named, reasons=reasons)


def _reasons_against(images: Images, pairs: list[PairRow], level_deg: float) -> Iterator[str]:
    """Yield why a model should not be used, a clause each."""
    agrees = [pair.verdict == Verdict.INLIER.value for pair in pairs if pair.direction]
    if np.ptp(images.centers, axis=0).max() <= _ROUNDING * np.abs(images.centers).max():
        yield "all its cameras stand at the same place; place them with sfm-shapefit locate"
    elif not agrees:
        yield "no two of its images have matches that say in which direction they stand from each other"
    elif level_deg > MOST_LEVEL_DEG:
        yield f"its positions are typically {level_deg:.0f} degrees off the directions that the matches say"
    elif np.mean(agrees) < LEAST_PAIRS:
        yield f"only {np.mean(agrees):.0%} of the pairs agree with its positions"


def _tell(
    model: ColmapModel,
    matches: MatchSource,
    verdict: ModelVerdict,
    cameras: list[CameraRow],
    pairs: list[PairRow],
    level_deg: float,
) -> dict[str, Any]:
    """Return what is told of a model beside its points, by the fields of `CheckedFacts`."""
    error_deg = _median([pair.residual_deg for pair in pairs if pair.direction])
    measures = (float(np.median(model.images.focal_lengths_px)), "of the model's units")
    return {
        "inputs": matches.inputs.facts,
        "options": {},
        "verdict": verdict,
        "num_images": len(cameras),
        "num_placed": model.images.num_images,
        "num_pairs": len(pairs),
        "num_points": model.reconstruction.num_points3D(),
        "figures": KeyFigures.of_cameras(cameras, error_deg, *measures),
        "sigma_of": "",
        "residual_level_deg": level_deg,
        "scale": "input: those of the model",
        "pieces": [],
        "loose_groups": [],
        "versions": {"sfm_shapefit": __version__, "pycolmap": version("pycolmap")},
    }


def _tell_points(quality: ImageQuality) -> dict[str, float]:
    """Return what is told of the model's points."""
    errors_px = quality.point_errors_px[np.isfinite(quality.point_errors_px)]
    return {
        "mean_reprojection_error_px": float(errors_px.mean()) if len(errors_px) else np.nan,
        "median_track_length": _median(quality.point_track_lengths.tolist()),
    }


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else np.nan
