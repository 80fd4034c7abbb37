"""The plugins of these tests, and the scenes that several of their folders share."""

import signal
from pathlib import Path

import pytest

from sfm_shapefit.synthetic import RenderedScene, SceneOptions, WorkspaceOptions, make_rendered_scene
from sfm_shapefit.synthetic.rendered_workspace import write_rendered_workspace

pytest_plugins = ["pytester", "sfm_shapefit.synthetic.fixtures"]

# A shell starts background jobs with interrupts ignored, and their children inherit that: commands that the
# tests interrupt would never end.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def drawn(tmp_path_factory) -> tuple[RenderedScene, Path]:
    """Eight photographs of a row of houses, what COLMAP finds in them, and the true model."""
    size = {"image_width": 400, "image_height": 300, "focal_length_px": 350.0}
    scene = make_rendered_scene(
        SceneOptions(shape="facade", num_images=8, max_keypoints_per_image=600, **size)
    )
    folder = tmp_path_factory.mktemp("drawn") / "workspace"
    write_rendered_workspace(scene, folder, WorkspaceOptions(relative_poses=True))
    return scene, folder
