"""Pytest fixtures for pipelines that place cameras: scenes, graphs and workspaces whose truth is known.

Name the plugin in the conftest.py at the root of your tests (or run pytest with `-p` and its name):

    pytest_plugins = ["sfm_shapefit.synthetic.fixtures"]

Then ask for what you need, as `examples/test_my_pipeline.py` does. The fixtures:

| fixture | what it is |
|---|---|
| `drawn_workspace` | `drawn_workspace(shape, WorkspaceOptions(), **changes)`: a project of projected points |
| `rendered_workspace` | `rendered_workspace(shape, **changes)`: a project of photographs, drawn by OpenCV |
| `random_graph` | `random_graph(n, p, sigma=, q=, seed=, corruption=)`: a view graph with wrong directions |

A project is a folder in the test's `tmp_path`, with `database.db`, `sparse/0` and, where that is not the
exact model, `truth`; changes are fields of `SceneOptions`. Everything is the same on every run; another
`seed` makes another scene. Images are named `0001.jpg` and so on; one unit is a meter.

This module needs pytest, and no part of the package imports it.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from sfm_shapefit.base.arrays import FloatArray

if TYPE_CHECKING:
    from sfm_shapefit.synthetic import GraphProblem, RenderOptions, WorkspaceOptions

__all__ = ["assert_locations_near", "assert_reconstruction_near"]


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


def _new_folder(tmp_path: Path) -> Path:
    return tmp_path / f"project{len(list(tmp_path.glob('project*'))) + 1}"


@pytest.fixture
def drawn_workspace(tmp_path: Path) -> Callable[..., Path]:
    """Make COLMAP projects of 12 images of 1200 points with 0.5 px of noise, if nothing else is said."""

    def workspace(
        shape: str = "courtyard", options: "WorkspaceOptions | None" = None, **changes: Any
    ) -> Path:
        from sfm_shapefit.synthetic import SceneOptions, make_scene, write_workspace

        folder = _new_folder(tmp_path)
        scene = SceneOptions(**{"shape": shape, "num_images": 12, "num_points": 1200, **changes})
        write_workspace(make_scene(scene), folder, options)
        return folder

    return workspace


@pytest.fixture
def rendered_workspace(tmp_path: Path) -> Callable[..., Path]:
    """Make COLMAP projects of 6 photographs of 640 x 480 pixels, if nothing else is said."""

    def workspace(
        shape: str = "facade",
        options: "WorkspaceOptions | None" = None,
        render: "RenderOptions | None" = None,
        **changes: Any,
    ) -> Path:
        from sfm_shapefit.synthetic import RenderOptions, SceneOptions, make_rendered_scene
        from sfm_shapefit.synthetic.rendered_workspace import write_rendered_workspace

        size = {"num_images": 6, "image_width": 640, "image_height": 480, "focal_length_px": 560.0}
        folder, scene = _new_folder(tmp_path), SceneOptions(**{"shape": shape, **size, **changes})
        write_rendered_workspace(make_rendered_scene(scene, render or RenderOptions()), folder, options)
        return folder

    return workspace


@pytest.fixture(scope="session")
def random_graph() -> "Callable[..., GraphProblem]":
    """Make graphs of the paper's random model: see `random_graph_problem`."""
    from sfm_shapefit.synthetic import random_graph_problem

    return random_graph_problem
