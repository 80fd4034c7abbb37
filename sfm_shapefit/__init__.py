"""Places the cameras of a COLMAP model from known rotations: certified, explained, deterministic.

    found  = locate("sparse/0")                             # a COLMAP model with its cameras placed
    write_result(found, "out")
    mapped = map_database("database.db")                    # the same from the matches alone
    pairs  = relative_rotations("database.db")              # of every two images, and how well each is known
    report = inspect("sparse/0")                            # its view graph diagnosed, nothing solved
    errors = evaluate(found.reconstruction, "truth")

    graph  = ViewGraph(num_nodes, edges, directions)        # directions of t_i - t_j
    placed = place(graph)                                   # what `sfm-shapefit place` does with it
    result = solve(graph)                                   # ShapeFit alone, with a certificate of optimality

Options are given as a value, `locate(model, options=LocateOptions(min_trust=0.0))`, or by name,
`locate(model, min_trust=0.0)`. Names are imported when they are first used, so that importing the package is
cheap.
"""

import zlib as _zlib  # noqa: F401  before pycolmap, whose own copy would take the place of the system's, see `jit`
from importlib import import_module as _import_module
from typing import TYPE_CHECKING
from typing import Any as _Any

if TYPE_CHECKING:
    from sfm_shapefit.adjustment.options import AdjustmentOptions
    from sfm_shapefit.colmap.quiet import hear_pycolmap
    from sfm_shapefit.commands.adjust import AdjustedModel, bundle_adjust
    from sfm_shapefit.commands.convert import convert
    from sfm_shapefit.commands.evaluate import evaluate
    from sfm_shapefit.commands.inspect import inspect
    from sfm_shapefit.commands.locate import locate
    from sfm_shapefit.commands.map import map_database
    from sfm_shapefit.commands.relative_rotations import relative_rotations
    from sfm_shapefit.commands.write import WriteOptions, write_map_result, write_result
    from sfm_shapefit.errors import InputError, ShapeFitError, UnsolvableError
    from sfm_shapefit.locate_options import LocateOptions, MapOptions
    from sfm_shapefit.placement.place import Placement, place
    from sfm_shapefit.refinement.options import PlacementOptions
    from sfm_shapefit.results.map_result import MapResult
    from sfm_shapefit.results.result import LocateResult
    from sfm_shapefit.rotations.average import average_rotations
    from sfm_shapefit.rotations.averaged import AveragedRotations
    from sfm_shapefit.solver.certificate import Certificate, certify
    from sfm_shapefit.solver.options import SolverOptions, SolverResult, Status
    from sfm_shapefit.solver.solve import solve
    from sfm_shapefit.viewgraph import ViewGraph

_HOMES = {
    "colmap.quiet": ("hear_pycolmap",),
    "adjustment.options": ("AdjustmentOptions",),
    "commands.adjust": ("AdjustedModel", "bundle_adjust"),
    "commands.convert": ("convert",),
    "commands.evaluate": ("evaluate",),
    "commands.inspect": ("inspect",),
    "commands.locate": ("locate",),
    "commands.map": ("map_database",),
    "commands.relative_rotations": ("relative_rotations",),
    "commands.write": ("WriteOptions", "write_map_result", "write_result"),
    "errors": ("InputError", "ShapeFitError", "UnsolvableError"),
    "locate_options": ("LocateOptions", "MapOptions"),
    "placement.place": ("Placement", "place"),
    "refinement.options": ("PlacementOptions",),
    "results.map_result": ("MapResult",),
    "results.result": ("LocateResult",),
    "rotations.average": ("average_rotations",),
    "rotations.averaged": ("AveragedRotations",),
    "solver.certificate": ("Certificate", "certify"),
    "solver.options": ("SolverOptions", "SolverResult", "Status"),
    "solver.solve": ("solve",),
    "viewgraph": ("ViewGraph",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__version__ = "0.1.0"
__all__ = [
    "AdjustedModel",
    "AdjustmentOptions",
    "AveragedRotations",
    "Certificate",
    "InputError",
    "LocateOptions",
    "LocateResult",
    "MapOptions",
    "MapResult",
    "Placement",
    "PlacementOptions",
    "ShapeFitError",
    "SolverOptions",
    "SolverResult",
    "Status",
    "UnsolvableError",
    "ViewGraph",
    "WriteOptions",
    "average_rotations",
    "bundle_adjust",
    "certify",
    "convert",
    "evaluate",
    "hear_pycolmap",
    "inspect",
    "locate",
    "map_database",
    "place",
    "relative_rotations",
    "solve",
    "write_map_result",
    "write_result",
]


def __getattr__(name: str) -> _Any:
    if name in _HOME_OF:
        globals()[name] = getattr(_import_module(f"{__name__}.{_HOME_OF[name]}"), name)
        return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
