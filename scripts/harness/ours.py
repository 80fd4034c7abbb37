"""Our own calls, as the benchmarks and figures make them: the one place that knows the package's signatures.

Everything is imported where it is used: a process that is measured loads no more than it needs.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from sfm_shapefit import LocateResult, SolverResult, ViewGraph
    from sfm_shapefit.base.arrays import FloatArray, IntArray
    from sfm_shapefit.placement.place import Placement


class Timed(NamedTuple):
    """An answer and what it took."""

    found: Any
    wall_s: float
    cpu_s: float


def time_call(function: Callable[[], Any]) -> Timed:
    """Call a function once."""
    wall, cpu = time.perf_counter(), time.process_time()
    found = function()
    return Timed(found, time.perf_counter() - wall, time.process_time() - cpu)


def solve(graph: "ViewGraph", *, note: Any = None, **options: Any) -> "SolverResult":
    """Return the certified ShapeFit optimum; `note` is called after each iteration."""
    from sfm_shapefit import solve as solve_program

    return solve_program(graph, on_iteration=note, **{"uniqueness": False, **options})


def solve_lud(graph: "ViewGraph") -> "FloatArray":
    """Return the LUD start, (n, d)."""
    from sfm_shapefit.solver.splitting.lud import solve_lud as solve_program

    return solve_program(graph).locations


def place(
    graph: "ViewGraph",
    *,
    covariance: "FloatArray | None" = None,
    num_cameras: int | None = None,
    **options: Any,
) -> "Placement":
    """Return the placement of the largest rigid piece: what the command does with a graph."""
    from sfm_shapefit.graph.measured import MeasuredGraph
    from sfm_shapefit.pipeline.place import place as place_graph
    from sfm_shapefit.refinement.options import PlacementOptions

    num_points = 0 if num_cameras is None else graph.num_nodes - num_cameras
    measured = MeasuredGraph(graph, covariance=covariance, num_points=num_points)
    return place_graph(measured, PlacementOptions(**options))


def place_file(source: Path, **options: Any) -> Any:
    """Place a graph file: what the command gives, with `placement`, `statement` and `timings_s`."""
    from sfm_shapefit.pipeline.place import place_graph_file
    from sfm_shapefit.refinement.options import PlacementOptions

    return place_graph_file(source, PlacementOptions(**options))


def warns(placement: "Placement") -> bool:
    """Return whether the report of a placement carries a warning."""
    from sfm_shapefit.facts.warnings import quality_warnings

    return any(True for _ in quality_warnings(placement))


def locate(model: Any, database: Path | None = None, **options: Any) -> "LocateResult":
    """Locate the cameras of a model."""
    from sfm_shapefit import locate as locate_cameras

    return locate_cameras(model, database, **options)


def locate_and_write(model: Any, out: Path, **options: Any) -> "LocateResult":
    """Locate the cameras of a model and write the output."""
    from sfm_shapefit import write_result

    found = locate(model, **options)
    write_result(found, out)
    return found


def map_database(database: Path, **options: Any) -> Any:
    """Return the largest model of `map`."""
    import sfm_shapefit

    found = sfm_shapefit.map_database(database, **options)
    return found.models[0].located.reconstruction


def rigid_pieces(num_nodes: int, edges: "IntArray") -> "IntArray":
    """Return the parallel-rigid piece of each edge in space."""
    from sfm_shapefit.graph.rigidity import parallel_rigid_pieces

    return parallel_rigid_pieces(num_nodes, edges, 3)
