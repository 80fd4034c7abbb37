"""Synthetic input whose truth is known: photographed scenes, and bare graphs of directions."""

from sfm_shapefit.synthetic.graphs import (
    GraphProblem,
    box_graph_problem,
    community_graph_problem,
    expander_graph_problem,
    random_graph_problem,
    trajectory_graph_problem,
)
from sfm_shapefit.synthetic.scenes import Scene, SceneOptions, make_scene, project_points

__all__ = [
    "GraphProblem",
    "Scene",
    "SceneOptions",
    "box_graph_problem",
    "community_graph_problem",
    "expander_graph_problem",
    "make_scene",
    "project_points",
    "random_graph_problem",
    "trajectory_graph_problem",
]
