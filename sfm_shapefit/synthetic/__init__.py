"""Synthetic input whose truth is known: photographed scenes, and bare graphs of directions.

Names are imported when they are first used: the options are cheap, and what makes scenes needs scipy.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sfm_shapefit.synthetic.graphs import (
        Corruption,
        GraphProblem,
        box_graph_problem,
        community_graph_problem,
        corridor_graph_problem,
        expander_graph_problem,
        lawn_graph_problem,
        measured_problem,
        random_graph_problem,
        ring_graph_problem,
        trajectory_graph_problem,
    )
    from sfm_shapefit.synthetic.options import RenderOptions, SceneOptions, WorkspaceOptions
    from sfm_shapefit.synthetic.rendering import (
        RenderedScene,
        draw_image,
        make_rendered_scene,
        project_distorted,
        surface_points,
    )
    from sfm_shapefit.synthetic.scenes import Scene, make_scene, project_points
    from sfm_shapefit.synthetic.streets import StreetProblem, street_problem

_HOMES = {
    "graphs": (
        "Corruption",
        "GraphProblem",
        "box_graph_problem",
        "community_graph_problem",
        "corridor_graph_problem",
        "expander_graph_problem",
        "lawn_graph_problem",
        "measured_problem",
        "random_graph_problem",
        "ring_graph_problem",
        "trajectory_graph_problem",
    ),
    "options": ("RenderOptions", "SceneOptions", "WorkspaceOptions"),
    "rendering": (
        "RenderedScene",
        "draw_image",
        "make_rendered_scene",
        "project_distorted",
        "surface_points",
    ),
    "scenes": ("Scene", "make_scene", "project_points"),
    "streets": ("StreetProblem", "street_problem"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "Corruption",
    "GraphProblem",
    "RenderOptions",
    "RenderedScene",
    "Scene",
    "SceneOptions",
    "StreetProblem",
    "WorkspaceOptions",
    "box_graph_problem",
    "community_graph_problem",
    "corridor_graph_problem",
    "draw_image",
    "expander_graph_problem",
    "lawn_graph_problem",
    "make_rendered_scene",
    "make_scene",
    "measured_problem",
    "project_distorted",
    "project_points",
    "random_graph_problem",
    "ring_graph_problem",
    "street_problem",
    "surface_points",
    "trajectory_graph_problem",
]


def __getattr__(name: str) -> Any:
    if name in _HOME_OF:
        return getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME_OF})
