"""Places the cameras of a COLMAP model from known rotations: certified, explained, deterministic.

    models = global_mapping("database.db", "images", "sparse")    # as pycolmap.global_mapping
    mapped = map_database("database.db")                    # the same, with the evidence for each model
    mapped.write("sparse")                                  # models, tables, and a report.html each
    found  = locate("sparse/0")                             # known rotations: the cameras placed
    found.report("page.html")
    pairs  = relative_rotations("database.db")              # of every two images, and how well each is known
    judged = check("sparse/0")                              # whether any COLMAP model can be used
    report = inspect("sparse/0")                            # its view graph diagnosed, nothing solved
    joined = join(["sparse/0", "sparse/1"], "database.db")  # models that stand apart, in one world
    errors = evaluate(found, "truth")

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
    from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions as AdjustmentOptions
    from sfm_shapefit.base.errors import InputError as InputError
    from sfm_shapefit.base.errors import ShapeFitError as ShapeFitError
    from sfm_shapefit.base.errors import UnsolvableError as UnsolvableError
    from sfm_shapefit.base.executors import WorkerError as WorkerError
    from sfm_shapefit.commands.bundle_adjust import AdjustedModel as AdjustedModel
    from sfm_shapefit.commands.bundle_adjust import bundle_adjust as bundle_adjust
    from sfm_shapefit.commands.check import check as check
    from sfm_shapefit.commands.check import check_pieces as check_pieces
    from sfm_shapefit.commands.convert import convert as convert
    from sfm_shapefit.commands.drop_in import average_database as average_database
    from sfm_shapefit.commands.drop_in import global_mapping as global_mapping
    from sfm_shapefit.commands.evaluate import evaluate as evaluate
    from sfm_shapefit.commands.inspect import inspect as inspect
    from sfm_shapefit.commands.join import join as join
    from sfm_shapefit.commands.lengths import evaluate_lengths as evaluate_lengths
    from sfm_shapefit.commands.locate import locate as locate
    from sfm_shapefit.commands.map import map_database as map_database
    from sfm_shapefit.commands.match import match_images as match_images
    from sfm_shapefit.commands.place import place as place
    from sfm_shapefit.commands.relative_rotations import relative_rotations as relative_rotations
    from sfm_shapefit.commands.workspace import Workspace as Workspace
    from sfm_shapefit.commands.workspace import workspace as workspace
    from sfm_shapefit.commands.write import WriteOptions as WriteOptions
    from sfm_shapefit.commands.write import write_result as write_result
    from sfm_shapefit.facts.check_result import CheckResult as CheckResult
    from sfm_shapefit.facts.command_options import InspectOptions as InspectOptions
    from sfm_shapefit.facts.command_options import JoinOptions as JoinOptions
    from sfm_shapefit.facts.command_options import LocateOptions as LocateOptions
    from sfm_shapefit.facts.command_options import MapOptions as MapOptions
    from sfm_shapefit.facts.command_options import SourceOptions as SourceOptions
    from sfm_shapefit.facts.map_result import JoinedModel as JoinedModel
    from sfm_shapefit.facts.map_result import MapResult as MapResult
    from sfm_shapefit.facts.result import LocateResult as LocateResult
    from sfm_shapefit.files.colmap.quiet import hear_pycolmap as hear_pycolmap
    from sfm_shapefit.files.matching_options import MatchingOptions as MatchingOptions
    from sfm_shapefit.files.undistortion_options import UndistortionOptions as UndistortionOptions
    from sfm_shapefit.graph.viewgraph import ViewGraph as ViewGraph
    from sfm_shapefit.judgement.trust_options import TrustOptions as TrustOptions
    from sfm_shapefit.pairs.direction_options import DirectionOptions as DirectionOptions
    from sfm_shapefit.placement.gauge_options import GaugeOptions as GaugeOptions
    from sfm_shapefit.placement.place import Placement as Placement
    from sfm_shapefit.refinement.placement_options import PlacementOptions as PlacementOptions
    from sfm_shapefit.rotations.average import average_rotations as average_rotations
    from sfm_shapefit.rotations.averaged import AveragedRotations as AveragedRotations
    from sfm_shapefit.rotations.averaging_options import AveragingOptions as AveragingOptions
    from sfm_shapefit.scene.freedom import FreedomOptions as FreedomOptions
    from sfm_shapefit.solver.certificate import Certificate as Certificate
    from sfm_shapefit.solver.certificate import certify as certify
    from sfm_shapefit.solver.solve import solve as solve
    from sfm_shapefit.solver.solver_options import SolverOptions as SolverOptions
    from sfm_shapefit.solver.solver_options import SolverResult as SolverResult
    from sfm_shapefit.solver.solver_options import Status as Status
    from sfm_shapefit.tracks.structure_options import NodeOptions as NodeOptions
    from sfm_shapefit.tracks.structure_options import StructureOptions as StructureOptions

_HOMES = {
    "files.colmap.quiet": ("hear_pycolmap",),
    "files.matching_options": ("MatchingOptions",),
    "files.undistortion_options": ("UndistortionOptions",),
    "adjustment.adjustment_options": ("AdjustmentOptions",),
    "commands.bundle_adjust": ("AdjustedModel", "bundle_adjust"),
    "commands.check": ("check", "check_pieces"),
    "facts.check_result": ("CheckResult",),
    "commands.convert": ("convert",),
    "commands.drop_in": ("average_database", "global_mapping"),
    "commands.evaluate": ("evaluate",),
    "commands.inspect": ("inspect",),
    "commands.join": ("join",),
    "commands.lengths": ("evaluate_lengths",),
    "commands.locate": ("locate",),
    "commands.map": ("map_database",),
    "commands.match": ("match_images",),
    "commands.relative_rotations": ("relative_rotations",),
    "commands.workspace": ("Workspace", "workspace"),
    "commands.write": ("WriteOptions", "write_result"),
    "base.errors": ("InputError", "ShapeFitError", "UnsolvableError"),
    "base.executors": ("WorkerError",),
    "facts.command_options": (
        "InspectOptions",
        "JoinOptions",
        "LocateOptions",
        "MapOptions",
        "SourceOptions",
    ),
    "judgement.trust_options": ("TrustOptions",),
    "pairs.direction_options": ("DirectionOptions",),
    "placement.gauge_options": ("GaugeOptions",),
    "rotations.averaging_options": ("AveragingOptions",),
    "scene.freedom": ("FreedomOptions",),
    "tracks.structure_options": ("NodeOptions", "StructureOptions"),
    "commands.place": ("place",),
    "placement.place": ("Placement",),
    "refinement.placement_options": ("PlacementOptions",),
    "facts.map_result": ("JoinedModel", "MapResult"),
    "facts.result": ("LocateResult",),
    "rotations.average": ("average_rotations",),
    "rotations.averaged": ("AveragedRotations",),
    "solver.certificate": ("Certificate", "certify"),
    "solver.solver_options": ("SolverOptions", "SolverResult", "Status"),
    "solver.solve": ("solve",),
    "graph.viewgraph": ("ViewGraph",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__version__ = "0.1.0"
__all__ = list(_HOME_OF)


def _load_writers() -> _Any:
    """Return what writes results, for `base.display`, which stands below it."""
    return _import_module(f"{__name__}.commands.write").WRITERS


def __getattr__(name: str) -> _Any:
    if name in _HOME_OF:
        globals()[name] = getattr(_import_module(f"{__name__}.{_HOME_OF[name]}"), name)
        return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
