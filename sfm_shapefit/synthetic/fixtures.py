"""Pytest fixtures for pipelines that place cameras: scenes, graphs and workspaces whose truth is known.

Name the plugin in the conftest.py at the root of your tests (or run pytest with `-p` and its name):

    pytest_plugins = ["sfm_shapefit.synthetic.fixtures"]

Then ask for what you need, as `examples/test_my_pipeline.py` does. The fixtures:

| fixture | what it is |
|---|---|
| `scene_of` | `scene_of(shape, **changes)`: a `Scene`; changes are fields of `SceneOptions` |
| `ring_scene`, `facade_scene`, `courtyard_scene`, `drive_scene` | 12 images, half a pixel of noise |
| `rendered_scene_of` | `rendered_scene_of(shape, render=RenderOptions(), **changes)`: a scene to be drawn |
| `workspace_of` | `workspace_of(scene, WorkspaceOptions())`: a folder with a scene of either kind |
| `ring_workspace` | database and exact model of `ring_scene` |
| `corrupted_workspace` | a courtyard's rotations and database, a fifth of its pairs wrong; `truth` |
| `random_graph` | `random_graph(n, p, sigma=, q=, seed=, corruption=)`: the random model of the paper |
| `graph_of` | `graph_of(family, n, ...)`: ring, trajectory, lawn, box, corridor, community, expander |
| `street_graph` | `street_graph(num_cameras, ...)`: a straight street of cameras and points |

Scenes and graphs are values that nobody changes: they are made once per session for the same arguments.
Workspaces are folders of your own, in the test's `tmp_path`. Everything is the same on every run; another
`seed` makes another one. COLMAP's images are named `0001.jpg` and so on; one unit is a meter.

This module needs pytest, and no part of the package imports it.
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from sfm_shapefit.base.arrays import FloatArray

if TYPE_CHECKING:
    from sfm_shapefit.synthetic import GraphProblem, RenderedScene, Scene, StreetProblem, WorkspaceOptions

__all__ = ["assert_locations_near", "assert_reconstruction_near"]

_FAMILIES = ("ring", "trajectory", "lawn", "box", "corridor", "community", "expander")


# --- comparisons -------------------------------------------------------------------------------------------


def assert_reconstruction_near(
    found: Any,
    truth: Any,
    *,
    max_error: float | None = None,
    max_median_error: float | None = None,
    max_rotation_error_deg: float | None = None,
    min_placed: float = 1.0,
) -> None:
    """Fail unless a reconstruction has the true camera poses, up to a similarity.

    Cameras are matched by name; the alignment is robust, so that one camera far off does not hide in it.
    Without any limit it raises ValueError; the failure names every limit that is exceeded, and the worst
    camera.

    Args:
        found, truth: results, reconstructions or model folders.
        max_error: limit for any placed camera's center, in units of the truth.
        max_median_error: limit for the median placed camera's center, in units of the truth.
        max_rotation_error_deg: limit for any placed camera's rotation.
        min_placed: the fraction of the true cameras that must be placed.
    """
    if max_error is None and max_median_error is None and max_rotation_error_deg is None:
        raise ValueError("give max_error, max_median_error or max_rotation_error_deg")
    from sfm_shapefit import evaluate

    errors = evaluate(found, truth)
    placed = len(errors.names) / (len(errors.names) + len(errors.missing))
    worst = errors.names[int(np.argmax(errors.position_errors))]
    turned = errors.names[int(np.argmax(errors.rotation_errors_deg))]
    complaints = []
    if placed < min_placed:
        complaints.append(
            f"{placed:.0%} of the cameras are placed, not {min_placed:.0%}: {errors.missing} miss"
        )
    largest, median, angle = errors.position.max, errors.position.median, errors.rotation_deg.max
    for error, limit, said, unit in (
        (largest, max_error, f"{worst} is {largest:.3g} off", ""),
        (median, max_median_error, f"the median camera is {median:.3g} off", ""),
        (angle, max_rotation_error_deg, f"{turned} is turned by {angle:.3g} deg", " deg"),
    ):
        if limit is not None and error > limit:
            complaints.append(f"{said}, limit {limit:g}{unit}")
    assert not complaints, "; ".join(complaints)


def assert_locations_near(found: FloatArray, truth: FloatArray, *, max_error: float) -> None:
    """Fail unless locations (n, d) are the true ones up to shift and scale, as directions leave them.

    `max_error` is the paper's relative error: both centered and scaled to Frobenius norm 1, the norm of their
    difference. The failure names the location that is farthest off.
    """
    assert found.shape == truth.shape, f"locations have shape {found.shape}, the truth has {truth.shape}"
    one, two = (t - t.mean(axis=0) for t in (found, truth))
    difference = one / np.linalg.norm(one) - two / np.linalg.norm(two)
    error = float(np.linalg.norm(difference))
    worst = int(np.argmax(np.linalg.norm(difference, axis=1)))
    assert error <= max_error, f"relative error {error:.3g}, limit {max_error:g}; worst location {worst}"


# --- scenes ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def scene_of() -> "Callable[..., Scene]":
    """Make photographed scenes: 12 images of 1200 points with 0.5 px of noise, if nothing else is said."""
    from sfm_shapefit.synthetic import SceneOptions, make_scene

    make = cache(make_scene)

    def scene(shape: str, **changes: Any) -> "Scene":
        return make(SceneOptions(**{"shape": shape, "num_images": 12, "num_points": 1200, **changes}))

    return scene


def _shape_fixture(shape: str, meaning: str) -> Any:
    """Return the fixture of the scene of a shape."""

    def scene(scene_of: "Callable[..., Scene]") -> "Scene":
        return scene_of(shape)

    scene.__doc__ = meaning
    return pytest.fixture(scope="session", name=f"{shape}_scene")(scene)


ring_scene = _shape_fixture("ring", "Cameras around an object.")
facade_scene = _shape_fixture("facade", "A grid of cameras before a wall.")
courtyard_scene = _shape_fixture("courtyard", "Cameras around the inside of four facades.")
drive_scene = _shape_fixture("drive", "Cameras that look ahead along a street.")


@pytest.fixture(scope="session")
def rendered_scene_of() -> "Callable[..., RenderedScene]":
    """Make scenes to be drawn: 8 images of 640 x 480 pixels, if nothing else is said."""
    from sfm_shapefit.synthetic import RenderOptions, SceneOptions, make_rendered_scene

    make = cache(make_rendered_scene)
    default = {"num_images": 8, "image_width": 640, "image_height": 480, "focal_length_px": 560.0}

    def scene(shape: str, render: RenderOptions | None = None, **changes: Any) -> "RenderedScene":
        options = SceneOptions(**{"shape": shape, **default, **changes})
        return make(options, render or RenderOptions())

    return scene


# --- workspaces --------------------------------------------------------------------------------------------


@pytest.fixture
def workspace_of(tmp_path: Path) -> Callable[..., Path]:
    """Write scenes as COLMAP workspaces, each in a folder of its own."""

    def workspace(scene: "Scene | RenderedScene", options: "WorkspaceOptions | None" = None) -> Path:
        from sfm_shapefit.synthetic import Scene
        from sfm_shapefit.synthetic.rendered_workspace import write_rendered_workspace
        from sfm_shapefit.synthetic.workspace import write_workspace

        folder = tmp_path / f"workspace{len(list(tmp_path.glob('workspace*'))) + 1}"
        if isinstance(scene, Scene):
            write_workspace(scene, folder, options)
        else:
            write_rendered_workspace(scene, folder, options)
        return folder

    return workspace


@pytest.fixture
def ring_workspace(ring_scene: "Scene", workspace_of: Callable[..., Path]) -> Path:
    """Write the ring: database.db, and the exact model in sparse/0."""
    return workspace_of(ring_scene)


@pytest.fixture
def corrupted_workspace(scene_of: "Callable[..., Scene]", workspace_of: Callable[..., Path]) -> Path:
    """Write a courtyard with a fifth of its pairs wrong: rotations only in sparse/0, the answer in truth."""
    from sfm_shapefit.synthetic import WorkspaceOptions

    scene = scene_of("courtyard", corrupted_pair_fraction=0.2)
    return workspace_of(scene, WorkspaceOptions(model="rotations"))


# --- graphs ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def random_graph() -> "Callable[..., GraphProblem]":
    """Make graphs of the paper's random model: see `random_graph_problem`."""
    from sfm_shapefit.synthetic import random_graph_problem

    return random_graph_problem


@pytest.fixture(scope="session")
def graph_of() -> "Callable[..., GraphProblem]":
    """Make graphs by family, with `degree`, `sigma`, `q`, `seed` and `corruption` as keywords."""

    def graph(family: str, n: int, **arguments: Any) -> "GraphProblem":
        from sfm_shapefit import synthetic

        if family not in _FAMILIES:
            raise ValueError(f"family must be one of {', '.join(_FAMILIES)}, got {family!r}")
        problem: GraphProblem = getattr(synthetic, f"{family}_graph_problem")(n, **arguments)
        return problem

    return graph


@pytest.fixture(scope="session")
def street_graph() -> "Callable[..., StreetProblem]":
    """Make straight streets of cameras and points: see `street_problem`."""
    from sfm_shapefit.synthetic import street_problem

    return street_problem
