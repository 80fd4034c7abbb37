"""The commands as functions: read, measure, place, seed. Each is a page; the steps stand beside it."""

from sfm_shapefit.pipeline.clock import Progress
from sfm_shapefit.pipeline.comparison import evaluate
from sfm_shapefit.pipeline.graphs import solve_graph_file
from sfm_shapefit.pipeline.inspection import inspect
from sfm_shapefit.pipeline.location import locate

__all__ = ["Progress", "evaluate", "inspect", "locate", "solve_graph_file"]
