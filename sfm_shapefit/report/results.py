"""Drawings of what was placed, joined or judged."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from sfm_shapefit.facts.check_result import CheckResult
from sfm_shapefit.facts.command_options import MapOptions
from sfm_shapefit.facts.map_result import JoinedModel
from sfm_shapefit.facts.result import GraphResult, LocateResult
from sfm_shapefit.facts.tables import CameraRow, PairRow, Table
from sfm_shapefit.files.colmap.model import ColmapModel, read_model
from sfm_shapefit.files.colmap.points import structure_of
from sfm_shapefit.files.colmap.seed import pick_points
from sfm_shapefit.judgement.image_quality import ImageQuality
from sfm_shapefit.judgement.lens_residuals import lens_fields
from sfm_shapefit.report.drawing import MAX_POINTS, CameraColumn, Drawing, LensRow, build_drawing, poses_of
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Lens


def draw_result(found: LocateResult | GraphResult) -> Drawing:
    """Return the drawing of a placed model or bare graph."""
    placement, poses, points = found.placement, None, None
    if isinstance(found, LocateResult):
        poses, points = (
            poses_of(found.images, list(found.cameras.columns["name"])),
            pick_points(found.model, MAX_POINTS),
        )
        if isinstance(found.options, MapOptions):  # a database has no positions, or those of sensors in rigs
            poses = replace(poses, centers=np.full_like(poses.centers, np.nan))
        if found.gauge.axes is not None:
            poses = replace(poses, rotations=poses.rotations @ found.gauge.axes.T)
    # NaN stands for the cameras that the certified optimum does not place.
    certified = np.full((len(found.cameras), placement.graph.dimension), np.nan)
    certified[placement.cameras] = placement.certified.locations[: len(placement.cameras)]
    return replace(
        build_drawing(found.cameras, found.pairs, poses=poses, points=points, certified=certified),
        dimension=placement.graph.dimension,
        input_is_aligned=isinstance(found, LocateResult) and found.gauge.scale == "input",
        history=tuple((info.iteration, info.objective, info.dual_bound) for info in placement.history),
        lenses=_lenses(found.images) if isinstance(found, LocateResult) else (),
        fields=found.evidence.fields if isinstance(found, LocateResult) else (),
    )


def draw_joined(found: JoinedModel) -> Drawing:
    """Return the drawing of models that were joined."""
    model = read_model(found.reconstruction)
    fields = lens_fields(structure_of(model.arrays, model.images))
    return replace(_draw_as_it_stands(model, found.cameras, found.pairs), fields=fields)


def draw_checked(found: CheckResult) -> Drawing:
    """Return the drawing of a model that was judged, with how well points hold each of its images."""
    quality, drawing = found.quality, _draw_as_it_stands(found.model, found.cameras, found.pairs)
    points = drawing.points._replace(errors_px=quality.point_errors_px, lengths=quality.point_track_lengths)
    further = tuple(_columns(quality, len(found.cameras)))
    return replace(drawing, further=further, points=points, fields=found.facts.evidence.fields)


def draw_model(model: ColmapModel, trust: Mapping[str, float]) -> Drawing:
    """Return the drawing of a model's posed images and points, without pairs; `trust` is by image name."""
    images = model.images
    told = {"name": images.names, "placed": images.is_posed, "center": images.centers}
    known = {"trust": [trust.get(name, math.nan) for name in images.names]}
    rows, pairs = Table(CameraRow, 3, told | known), Table(PairRow, 3, {"name1": []})
    return build_drawing(
        rows, pairs, poses=poses_of(images, images.names), points=pick_points(model.arrays, MAX_POINTS)
    )


def _draw_as_it_stands(model: ColmapModel, cameras: Table[CameraRow], pairs: Table[PairRow]) -> Drawing:
    """Return the drawing of a model that is the input itself, so that there is nothing to compare it with."""
    poses = poses_of(model.images, list(cameras.columns["name"]))
    poses = replace(poses, centers=np.full_like(poses.centers, np.nan))
    points = pick_points(model.arrays, MAX_POINTS)
    drawing = build_drawing(cameras, pairs, poses=poses, points=points)
    return replace(drawing, lenses=_lenses(model.images))


def _lenses(images: Images) -> tuple[LensRow, ...]:
    """Return the lenses that images were taken through, the most used first."""
    counts = Counter(images.lens_of.tolist())
    return tuple(_lens_row(images.lenses[row], count) for row, count in counts.most_common())


def _lens_row(lens: Lens, num_images: int) -> LensRow:
    focal, point, distortion = lens.split_parameters()
    return LensRow(
        str(lens.id),
        lens.model,
        f"{num_images:,}",
        f"{lens.width} x {lens.height}",
        ", ".join(f"{value:,.1f}" for value in focal),
        ", ".join(f"{value:,.1f}" for value in point),
        ", ".join(f"{value:.4g}" for value in distortion) or "none",
    )


def _columns(quality: ImageQuality, num_cameras: int) -> Iterator[CameraColumn]:
    """Yield what the table of cameras shows beside the usual."""
    columns = (
        ("Points", "3D points that it observes", quality.num_points),
        ("Error (px)", "Mean reprojection error, in pixels", quality.errors_px),
        ("Track length", "Median number of images that see its points", quality.track_lengths),
        ("Coverage (%)", "Share of the picture in which it sees points", 100 * quality.coverage),
    )
    for title, hint, values in columns:
        unposed = np.full(num_cameras - len(values), np.nan)
        yield CameraColumn(title, hint, np.concatenate([values, unposed]))
