"""Synthetic input whose truth is known, for the tests of this package and of pipelines around it.

Scenes of cameras and surface points (`make_scene`), the same with textured surfaces that are drawn and
photographed (`make_rendered_scene`), and bare graphs of directions (`random_graph_problem` and others):

    scene = make_scene(SceneOptions(shape="courtyard", corrupted_pair_fraction=0.2, seed=3))
    scene.keypoints, scene.pairs, scene.matches_of(0)      # what a camera would see, and which images match
    scene.rotations, scene.centers, scene.pair_is_corrupted    # the truth

    drawn = make_rendered_scene(SceneOptions(shape="facade", image_width=640, image_height=480))
    draw_image(drawn, 0)                                   # (480, 640, 3) red, green, blue
    surface_points(drawn, 0, xy)                           # what the pixels show: the truth of any match

    problem = random_graph_problem(50, p=0.5, sigma=0.01, q=0.2)
    problem.view_graph, problem.locations, problem.corrupted

`write_workspace` and `.rendered_workspace.write_rendered_workspace` write scenes as COLMAP workspaces, and
`sfm_shapefit.synthetic.fixtures` is a pytest plugin with all of these as fixtures, and with comparisons.
The same options give the same values on every run.

Names are imported when they are first used: the options are cheap, and what makes scenes needs scipy.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sfm_shapefit.synthetic.graphs import (
        CorruptionKind,
        GraphProblem,
        Noise,
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
    from sfm_shapefit.synthetic.rendering import (
        RenderedScene,
        draw_image,
        make_rendered_scene,
        project_distorted,
        surface_points,
    )
    from sfm_shapefit.synthetic.rigs import make_rig_drive
    from sfm_shapefit.synthetic.scene_options import RenderOptions, SceneOptions, WorkspaceOptions
    from sfm_shapefit.synthetic.scenes import Scene, make_scene, project_points
    from sfm_shapefit.synthetic.streets import StreetProblem, street_problem
    from sfm_shapefit.synthetic.workspace import write_workspace

# In this order, a name is found before anything is imported that costs more than its own module.
_HOMES = ("scene_options", "graphs", "streets", "scenes", "rigs", "rendering", "workspace")

__all__ = [
    "CorruptionKind",
    "GraphProblem",
    "Noise",
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
    "make_rig_drive",
    "make_scene",
    "measured_problem",
    "project_distorted",
    "project_points",
    "random_graph_problem",
    "ring_graph_problem",
    "street_problem",
    "surface_points",
    "trajectory_graph_problem",
    "write_workspace",
]


def __getattr__(name: str) -> Any:
    for home in _HOMES if name in __all__ else ():
        module = import_module(f"{__name__}.{home}")
        if hasattr(module, name):
            globals()[name] = getattr(module, name)
            return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
