"""`report MODEL`: a COLMAP model as it stands, nothing placed: which cameras are weak, and which pairs wrong.

A pair contradicts the model if the direction that its matches say is off the model's baseline by more than a
degree, and by more than six times what is usual. A camera is weak if it sees fewer than 30 points, if its
reprojection error is above 0.75 px and above twice what is usual, if its points cover less than 15 % of the
picture, or if more than a third of its pairs contradict it, and more than twice the usual share.

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
whose wide lenses hardly tell. Of cameras moved by 1 %, 35 % or more of the pairs contradict.
"""

from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfm_shapefit import __version__
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import SIGMA_PER_MEDIAN, angle_between_deg, normalized
from sfm_shapefit.facts.model import ExaminedFacts
from sfm_shapefit.facts.placed import KeyFigures
from sfm_shapefit.facts.tables import CameraRow, PairRow
from sfm_shapefit.files.colmap.model import ColmapModel, read_model
from sfm_shapefit.files.colmap.points import ModelPictures, points2d_of, points_of
from sfm_shapefit.judgement.grade import Grade, ModelVerdict
from sfm_shapefit.judgement.image_quality import ImageQuality, image_quality
from sfm_shapefit.judgement.verdicts import Verdict
from sfm_shapefit.pairs.options import DirectionOptions
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.pipeline.clock import Clock, Progress
from sfm_shapefit.pipeline.inputs import MatchSource, choose_inputs, open_source
from sfm_shapefit.pipeline.measure import measure
from sfm_shapefit.report.drawing import CameraColumn, Drawing, build_drawing, poses_of
from sfm_shapefit.scene.images import Images
from sfm_shapefit.solver.options import SolverOptions

_FAR_DEG, _FAR_LEVELS = 1.0, 6.0
_FEWEST_POINTS = 30
_LARGE_PX, _LARGE_OF_USUAL = 0.75, 2.0
_LEAST_COVERAGE = 0.15
_FEWEST_PAIRS = 3
_LARGE_SHARE, _SHARE_OF_USUAL = 1.0 / 3.0, 2.0
# Fewer agreeing pairs of all that have a direction, and the model is not to be used.
_LEAST_AGREEING = 0.25


class Examined(NamedTuple):
    """A model that was looked at."""

    cameras: list[CameraRow]
    """Those with a pose first."""
    pairs: list[PairRow]
    facts: ExaminedFacts
    quality: ImageQuality


def examine(
    folder: Path, database: Path | None = None, *, progress: Progress | None = None
) -> tuple[Drawing, ExaminedFacts]:
    """Return the drawing of a model, and what the report says of it.

    Args:
        folder: a COLMAP model, as for `locate`.
        database: as for `locate`; without one, the pairs are those that share points of the model.
        progress: called as stages advance.

    Raises:
        InputError: if the model or the database cannot be used.
    """
    clock = Clock.of(progress, SolverOptions())
    with clock("read"):
        model = read_model(folder)
        inputs = choose_inputs(folder, database)
    with open_source(model, inputs) as matches:
        found = examine_source(model, matches, DirectionOptions(), clock)
    poses = poses_of(model.images, [row.name for row in found.cameras])
    # The input is what is shown; there is nothing to be compared with it.
    poses = replace(poses, centers=np.full_like(poses.centers, np.nan))
    drawing = build_drawing(found.cameras, found.pairs, poses=poses, points=model.reconstruction)
    quality = found.quality
    further = _columns(quality, len(found.cameras))
    points = replace(
        drawing.points, errors_px=quality.point_errors_px, track_lengths=quality.point_track_lengths
    )
    return replace(drawing, further=further, points=points), found.facts


def examine_source(
    model: ColmapModel, matches: MatchSource, options: DirectionOptions, clock: Clock
) -> Examined:
    """Return what can be said of a model whose matches are open.

    Args:
        model: not changed.
        matches: of its images.
        options: how directions are measured.
        clock: what it takes is added to its seconds.
    """
    images = model.images
    with clock("points"):
        points = points_of(model.reconstruction, images)
        pictures = ModelPictures(images, points2d_of(model.reconstruction, images))
        quality = image_quality(points, images, pictures)
    with clock("directions"):
        try:
            directions = measure(matches, options, clock).directions
        except UnsolvableError:  # no pair shares anything
            directions = None
    pairs, level_deg = _pair_rows(images, directions)
    cameras = _camera_rows(model, quality, pairs)
    error_deg = _median([pair.residual_deg for pair in pairs if pair.direction])
    measures = (float(np.median(images.focal_lengths_px)), "of the model's units")
    facts = ExaminedFacts(
        inputs=matches.inputs.facts,
        options={},
        verdict=_judge(cameras, pairs),
        num_images=len(cameras),
        num_placed=images.num_images,
        num_pairs=len(pairs),
        num_points=model.reconstruction.num_points3D(),
        figures=KeyFigures.of_cameras(cameras, error_deg, *measures),
        sigma_of="",
        residual_level_deg=level_deg,
        mean_reprojection_error_px=_mean(quality.point_errors_px),
        median_track_length=_median(quality.point_track_lengths.tolist()),
        scale="input: those of the model",
        pieces=[],
        loose_groups=[],
        timings_s=clock.seconds,
        warnings=[],
        versions={"sfm_shapefit": __version__, "pycolmap": version("pycolmap")},
    )
    return Examined(cameras, pairs, facts, quality)


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else np.nan


def _mean(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else np.nan


def _pair_rows(images: Images, directions: PairDirections | None) -> tuple[list[PairRow], float]:
    """Return a row per pair, and the level of the residuals in degrees."""
    if directions is None:
        return [], np.nan
    i, j = directions.pairs.T
    usable, baselines = directions.usable(), images.centers[i] - images.centers[j]
    usable = usable[np.linalg.norm(baselines[usable], axis=1) > 0.0]
    residuals = np.full(len(i), np.nan)
    residuals[usable] = angle_between_deg(directions.directions[usable], normalized(baselines[usable]))
    level = SIGMA_PER_MEDIAN * float(np.median(residuals[usable])) if len(usable) else np.nan
    limit = max(_FAR_DEG, _FAR_LEVELS * np.nan_to_num(level))
    rows = []
    for e, status in enumerate(directions.status):
        known = bool(np.isfinite(residuals[e]))
        rows.append(
            PairRow(
                name1=images.names[i[e]],
                name2=images.names[j[e]],
                direction=tuple(directions.directions[e].tolist()) if known else (),
                support=int(directions.num_inliers[e]),
                residual_deg=float(residuals[e]),
                verdict=(Verdict.INLIER if residuals[e] <= limit else Verdict.OUTLIER).value,
                reason="" if known else status.value,
            )
        )
    return rows, level


def _camera_rows(model: ColmapModel, quality: ImageQuality, pairs: list[PairRow]) -> list[CameraRow]:
    """Return a row per image, those with a pose first."""
    degrees, wrong = dict.fromkeys(model.images.names, 0), dict.fromkeys(model.images.names, 0)
    for pair in pairs:
        for name in (pair.name1, pair.name2):
            degrees[name] += bool(pair.direction)
            wrong[name] += bool(pair.direction) and pair.verdict == Verdict.OUTLIER.value
    shares = [wrong[name] / degrees[name] for name in model.images.names if degrees[name] >= _FEWEST_PAIRS]
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
        for k, name in enumerate(model.images.names)
    ]
    others = set(model.image_names) - set(model.images.names)
    return rows + [CameraRow(name=name, reason="it has no pose in the model") for name in sorted(others)]


class _Usual(NamedTuple):
    """What is usual in a model: the medians over its images, NaN of none."""

    error_px: float
    share: float
    """Of the pairs that contradict an image."""


def _weaknesses(quality: ImageQuality, k: int, usual: _Usual, pairs: tuple[int, int]) -> list[str]:
    """Return what is weak about an image, in words; `pairs` are those that contradict it, and all of it."""
    found, (wrong, total) = [], pairs
    if quality.num_points[k] < _FEWEST_POINTS:
        found.append(f"it sees only {quality.num_points[k]} 3D points")
    elif quality.coverage[k] < _LEAST_COVERAGE:
        found.append(f"its points cover only {quality.coverage[k]:.0%} of the picture")
    if quality.errors_px[k] > max(_LARGE_PX, _LARGE_OF_USUAL * usual.error_px):
        found.append(
            f"its reprojection error is {quality.errors_px[k]:.1f} px, where {usual.error_px:.1f} px is usual"
        )
    if total >= _FEWEST_PAIRS and wrong > total * max(_LARGE_SHARE, _SHARE_OF_USUAL * usual.share):
        found.append(f"{wrong} of its {total} pairs contradict where it stands")
    return found


def _columns(quality: ImageQuality, num_cameras: int) -> tuple[CameraColumn, ...]:
    """Return what the table of cameras shows beside the usual."""

    def padded(values: FloatArray) -> FloatArray:
        return np.concatenate([values, np.full(num_cameras - len(values), np.nan)])

    return (
        CameraColumn("Points", "3D points that it observes", padded(quality.num_points.astype(np.float64))),
        CameraColumn("Reproj. px", "Mean reprojection error, in pixels", padded(quality.errors_px)),
        CameraColumn("Tracks", "Median number of images that see its points", padded(quality.track_lengths)),
        CameraColumn(
            "Cover %", "Share of the picture in which it sees points", padded(100 * quality.coverage)
        ),
    )


def _judge(cameras: list[CameraRow], pairs: list[PairRow]) -> ModelVerdict:
    """Return the verdict on a model as it stands."""
    usable = [pair for pair in pairs if pair.direction]
    weak = tuple(row.name for row in cameras if row.placed and row.reason)
    share = np.mean([pair.verdict == Verdict.INLIER.value for pair in usable]) if usable else 1.0
    if share < _LEAST_AGREEING:
        reasons = (f"only {share:.0%} of the pairs agree with its positions",)
        return ModelVerdict(grade=Grade.DO_NOT_USE, cameras=weak, reasons=reasons)
    return ModelVerdict(grade=Grade.LOOK if weak else Grade.GOOD, cameras=weak, reasons=())
