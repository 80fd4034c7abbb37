"""The plugins of these tests, and the scenes that several of their folders share."""

import signal
from pathlib import Path

import pytest
from hypothesis import settings

import sfm_shapefit
from sfm_shapefit.synthetic import (
    RenderedScene,
    Scene,
    SceneOptions,
    WorkspaceOptions,
    make_rendered_scene,
    make_rig_drive,
    make_scene,
)
from sfm_shapefit.synthetic.rendered_workspace import write_rendered_workspace
from sfm_shapefit.synthetic.workspace import write_workspace
from tests.clusters import client_of
from tests.scenes import COURTYARD, RING

pytest_plugins = ["pytester", "sfm_shapefit.synthetic.fixtures"]

# The same examples in each run, however slow the machine is.
settings.register_profile("suite", deadline=None, derandomize=True)
settings.load_profile("suite")

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


@pytest.fixture
def dask_client():
    """A client of two workers, threads of this process, which end with the test: they draw random numbers."""
    with client_of(2) as client:
        yield client


@pytest.fixture(scope="session")
def ring_located() -> sfm_shapefit.LocateResult:
    """What `locate` makes of the ring; nobody may change it."""
    return sfm_shapefit.locate(RING / "sparse" / "0")


@pytest.fixture(scope="session")
def ring_mapped() -> sfm_shapefit.MapResult:
    """What `map` makes of the ring's database; nobody may change it."""
    return sfm_shapefit.map_database(RING / "database.db")


@pytest.fixture(scope="session")
def courtyard_located() -> sfm_shapefit.LocateResult:
    """What `locate` makes of the courtyard; nobody may change it."""
    return sfm_shapefit.locate(COURTYARD / "sparse" / "0")


@pytest.fixture(scope="session")
def courtyard_mapped() -> sfm_shapefit.MapResult:
    """What `map` makes of the courtyard's database."""
    return sfm_shapefit.map_database(COURTYARD / "database.db")


@pytest.fixture(scope="session")
def tiny_ring(tmp_path_factory) -> Path:
    """A small ring as a COLMAP workspace, a tenth of its matches wrong."""
    out = tmp_path_factory.mktemp("tiny") / "ring"
    write_workspace(make_scene(SceneOptions(num_images=16, num_points=600, wrong_match_fraction=0.1)), out)
    return out


@pytest.fixture(scope="session")
def rig_drive(tmp_path_factory) -> tuple[Scene, Path]:
    """Twelve frames of two rigs of three cameras, a fifth of the pairs wrong, and their workspace."""
    size = {"num_images": 36, "num_points": 1500, "max_pairs_per_image": 12}
    rigs = make_rig_drive(SceneOptions(seed=0, corrupted_pair_fraction=0.2, **size))
    folder = tmp_path_factory.mktemp("rigs") / "drive"
    write_workspace(rigs, folder, WorkspaceOptions(model="rotations"))
    return rigs, folder
