"""The tutorial's yard as pycolmap's two mappers and `map` see it: cameras and points from above.

Each program gets the bundled database, one thread and one seed. The last line says what `map` says of it.
"""

import argparse
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pycolmap
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import sfm_shapefit
from sfm_shapefit.files.colmap.quiet import quiet_log

SCENE = Path(__file__).parents[2] / "data_synthetic/photographed"
SHOWN_M = 0.5
"""Errors below this, in meters, are too small to be seen in the picture."""
COLORS = {"camera where it was": "seagreen", "camera elsewhere": "crimson", "where that one was": "0.7"}


def run(_args: argparse.Namespace) -> Figure:
    """Return the picture."""
    truth = pycolmap.Reconstruction(SCENE / "truth")
    models = list(map_by_each())
    picture, axes = plt.subplots(1, len(models), figsize=(15.0, 5.2), dpi=72, layout="constrained")
    picture.get_layout_engine().set(h_pad=0.1)
    for axis, (program, model) in zip(axes, models, strict=True):
        worst = _draw(axis, model, truth)
        is_ours = isinstance(model, sfm_shapefit.LocateResult)
        said = f"verdict: {model.verdict.statement}" if is_ours else "(says nothing of it)"
        axis.set_title(f"{program}: {worst}\n{said}", fontsize=13)
        print(f"{program}: {worst}; {said}")
    handles = [plt.Line2D([], [], marker=9, markersize=9, ls="", color=color) for color in COLORS.values()]
    picture.legend(handles, COLORS, loc="outside lower center", ncols=3, frameon=False, fontsize=12)
    return picture


def map_by_each() -> Iterator[tuple[str, pycolmap.Reconstruction | sfm_shapefit.LocateResult]]:
    """Yield each program with its model."""
    same = {"random_seed": 0, "num_threads": 1}
    with tempfile.TemporaryDirectory() as name, quiet_log():
        database = Path(shutil.copy(SCENE / "database.db", name))
        incremental = pycolmap.IncrementalPipelineOptions(**same)
        yield "COLMAP", pycolmap.incremental_mapping(database, name, Path(name, "1"), incremental)[0]
        globally = pycolmap.GlobalPipelineOptions(**same)
        yield "GLOMAP", pycolmap.global_mapping(database, name, Path(name, "2"), globally)[0]
        yield "`map`", sfm_shapefit.map_database(database).models[0]


def _draw(
    axis: Axes, model: pycolmap.Reconstruction | sfm_shapefit.LocateResult, truth: pycolmap.Reconstruction
) -> str:
    """Draw a model from above in the axes of the truth; return how far its worst cameras are off."""
    found = sfm_shapefit.evaluate(model, truth)
    made = pycolmap.Reconstruction(getattr(model, "reconstruction", model))
    similarity = found.ref_from_model
    made.transform(
        pycolmap.Sim3d(similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation)
    )
    cameras = {image.name: image for image in made.images.values() if image.has_pose}
    errors = dict(zip(found.names, found.position_errors.tolist(), strict=True))
    points = np.array([point.xyz for point in made.points3D.values()])
    axis.scatter(*points[:, :2].T, s=6, color="0.45", linewidths=0)
    for image in truth.images.values():
        right, there = image.projection_center(), cameras[image.name]
        is_wrong = errors[image.name] > SHOWN_M
        if is_wrong:
            line = np.transpose([right[:2], there.projection_center()[:2]])
            axis.plot(*line, ":", color=COLORS["camera elsewhere"])
            _draw_camera(axis, image, "where that one was")
        _draw_camera(axis, there, "camera elsewhere" if is_wrong else "camera where it was")
    axis.set(aspect="equal", xticks=[], yticks=[], xlim=(-13, 13), ylim=(-10, 10))
    wrong = [f"{error:.0f}" for error in errors.values() if error > SHOWN_M]
    if wrong:
        return f"{len(wrong)} of {len(errors)} cameras off, by {', '.join(wrong)} m"
    return f"all within {100 * max(errors.values()):.0f} cm"


def _draw_camera(axis: Axes, image: pycolmap.Image, kind: str) -> None:
    """Draw a camera from above: its center, and the sides of what it sees."""
    pose = image.cam_from_world().inverse()
    corners = np.array([[-0.66, 0.0, 1.0], [0.0, 0.0, 0.0], [0.66, 0.0, 1.0]])
    outline = pose * corners
    axis.fill(*outline[:, :2].T, color=COLORS[kind], alpha=0.85, linewidth=0)
