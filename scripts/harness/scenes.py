"""Scenes of known truth in folders, made or drawn, and errors of rotations."""

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import mean_rotation_l1, rotation_angles_deg
from sfm_shapefit.scene.images import Images
from sfm_shapefit.synthetic import SceneOptions, WorkspaceOptions, make_scene
from sfm_shapefit.synthetic.layouts import SceneCameras

WRONG_DEG = 5.0
"""Error of a rotation from which it counts as wrong."""
# Rotations that the best common one is fitted to: more take long, and change nothing.
_FITTED = 20_000


def write_scene(
    folder: Path, scene: Mapping[str, Any] | SceneCameras, render: Mapping | None = None, **workspace: Any
) -> Any:
    """Write a made scene, or a drawn one with options of rendering, as a workspace; return it.

    Args:
        folder: of the workspace.
        scene: its options, or the scene itself.
        render: options of drawing; nothing is drawn if None.
        **workspace: options of the workspace.
    """
    from sfm_shapefit.synthetic import RenderOptions, make_rendered_scene
    from sfm_shapefit.synthetic.rendered_workspace import write_rendered_workspace
    from sfm_shapefit.synthetic.workspace import write_workspace

    if render is None:
        made = make_scene(SceneOptions(**scene)) if isinstance(scene, Mapping) else scene
        write_workspace(made, folder, WorkspaceOptions(**workspace))
        return made
    drawn = make_rendered_scene(SceneOptions(**scene), RenderOptions(**render))
    write_rendered_workspace(drawn, folder, WorkspaceOptions(**workspace))
    return drawn


@contextmanager
def temporary_scene(
    scene: Mapping[str, Any] | SceneCameras, render: Mapping | None = None, **workspace: Any
) -> Iterator[tuple[Any, Path]]:
    """Yield a scene and the folder of its workspace; arguments as of `write_scene`."""
    with tempfile.TemporaryDirectory() as folder:
        yield write_scene(Path(folder) / "scene", scene, render, **workspace), Path(folder) / "scene"


def set_rotation(frame: Any, rotation: Any) -> None:
    """Give a frame of pycolmap another rotation about its center."""
    center = frame.rig_from_world.inverse().translation
    frame.rig_from_world = pycolmap.Rigid3d(rotation, -(rotation * center))


def errors_deg(rotations: FloatArray, truth: FloatArray) -> FloatArray:
    """Return the angles to the truth after the best common rotation of the world, (n,)."""
    difference = rotations.transpose(0, 2, 1) @ truth
    return rotation_angles_deg(difference @ mean_rotation_l1(difference[:_FITTED]).T)


def rotation_errors_deg(images: Images, truth: Images) -> FloatArray:
    """Return the error of each rotation of images, (n,); NaN of an image without a truth."""
    place_of = {name: k for k, name in enumerate(truth.names)}
    common = [k for k, name in enumerate(images.names) if name in place_of]
    errors = np.full(len(images.names), np.nan)
    theirs = truth.rotations[[place_of[images.names[k]] for k in common]]
    errors[common] = errors_deg(images.rotations[common], theirs)
    return errors
