"""`place GRAPH`: a bare view graph, or relative poses of pairs, placed by the same steps as `locate`."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy.typing as npt

from sfm_shapefit.base.clock import Clock, Progress
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.commands.pose_graphs import (
    MAX_ROTATION_ERROR_DEG,
    orient_pose_graph,
    read_pose_graph,
    without_contradicted,
)
from sfm_shapefit.facts.placed_graph import PlacedGraph
from sfm_shapefit.facts.result import GraphResult
from sfm_shapefit.files.graph_text import read_graph
from sfm_shapefit.graph.measured import MeasuredGraph, direction_covariances
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.judged import judge
from sfm_shapefit.placement.place import place_pieces
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.solver.solver_options import OnIteration, reported

if TYPE_CHECKING:
    import pycolmap


def place(
    measured: MeasuredGraph | ViewGraph | Path | str,
    options: PlacementOptions | None = None,
    *,
    sigma: npt.ArrayLike | None = None,
    rotations: npt.ArrayLike | None = None,
    num_matches: npt.ArrayLike | None = None,
    on_iteration: OnIteration | None = None,
    **overrides: Any,
) -> PlacedGraph:
    """Place the largest rigid piece of a view graph: both convex starts, refinement, verdicts, trust.

        graph = ViewGraph(num_cameras, edges, directions)     # (m, 2) pairs (i, j), (m, d) of t_i - t_j
        placed = place(graph)
        placed.positions, placed.verdict.grade, placed.warnings

    This is what `sfm-shapefit place` does. `solve` is the certified program alone, whose optimum
    collapses on long chains and under heavy corruption.

    Args:
        measured: any view graph with at least one edge, or a file as `place_graph_file` takes it, best with
            what is known of its directions; what its largest rigid piece leaves out is not placed.
        options: settings, see `help(PlacementOptions)`; defaults if None.
        sigma: (m,) standard deviation of each direction per axis, radians, or (m, d - 1, d - 1) covariances
            in `tangent_bases(graph.directions)`, rad^2; NaN where unknown, None if all are. Noise that the
            residuals show beyond it is added.
        rotations: (m, 3, 3) cam_j_from_cam_i of each edge (i, j). They are averaged, and pairs off the
            averaged ones by more than 10 degrees leave the graph: repeated structure often turns a pair whose
            direction agrees with those of other false ones.
        num_matches: (m,) matches behind each of these rotations, see `average_rotations`. If None, all count
            alike, and no pair leaves if the directions of most such pairs close triangles: then the averaged
            rotations are those of a folded scene.
        on_iteration: as of `place_pieces`.
        **overrides: single options by name: `place(graph, refine=False)`.

    Raises:
        InputError: if sigma has another shape, negative values or such beyond pi radians, or if all rotations
            contradict one another; else as `average_rotations` and `place_pieces`.
        UnsolvableError: as `place_pieces`.
    """
    options = merge_options(options, PlacementOptions, overrides)
    threads = options.solver.num_threads()
    if isinstance(measured, Path | str):
        poses = read_pose_graph(measured)
        measured = orient_pose_graph(poses, threads=threads)[0] if poses else read_graph(measured)
    graph = MeasuredGraph(measured) if isinstance(measured, ViewGraph) else measured
    if sigma is not None:
        graph = replace(graph, covariance=direction_covariances(graph.graph, sigma))
    if rotations is not None:
        graph = without_contradicted(graph, rotations, num_matches, threads)
    elif num_matches is not None:
        raise InputError("num_matches say how much relative rotations count; give rotations, too")
    placed = next(place_pieces(graph, options, on_iteration=on_iteration))
    return PlacedGraph.of(judge(placed, options), options)


def place_graph_file(
    path: "Path | str | pycolmap.PoseGraph",
    options: PlacementOptions | None = None,
    *,
    rotations: Path | str | None = None,
    max_rotation_error_deg: float = MAX_ROTATION_ERROR_DEG,
    reverse: bool = False,
    progress: Progress | None = None,
    **overrides: Any,
) -> GraphResult:
    """Place the nodes of a bare view graph by the same steps as `locate`: pieces, solve, verdicts.

    Args:
        path: a text file, see `formats.read_graph`; or relative poses: a 1DSfM folder or EGs.txt, see
            `formats.read_onedsfm`, GLOMAP's text, see `formats.read_relative_poses`, the edges of a g2o file,
            see `formats.read_g2o`, or a pose graph.
        options: settings; defaults if None.
        rotations: of the cameras of relative poses: 1DSfM's rots.txt, see `formats.read_rotations`, or the
            vertices of a g2o file; averaged if None, see `average_rotations`.
        max_rotation_error_deg: relative poses whose rotation contradicts those of the cameras by more are
            left out, as `locate` leaves them out.
        reverse: the directions of a bare graph point from i to j, as in 1DSfM's prob.txt.
        progress: called as stages advance.
        **overrides: single options by name.

    Raises:
        InputError: if a file is malformed; the message names the line.
        UnsolvableError: if the directions determine nothing.
    """
    options = merge_options(options, PlacementOptions, overrides)
    clock = Clock.of(progress, options.solver.threads)
    statement = "directions as given"
    with clock("read"):
        geometries = read_pose_graph(path)
    if geometries is not None:
        if reverse:
            raise InputError(f"{path} holds relative poses, whose sense is known; leave out reverse=True")
        with clock("rotations"):
            graph, statement = orient_pose_graph(
                geometries, rotations, max_rotation_error_deg, threads=clock.threads
            )
    else:
        assert isinstance(path, Path | str)
        if rotations is not None:
            raise InputError(f"{path} is a bare graph of directions, which need no rotations; leave them out")
        with clock("read"):
            bare = read_graph(path)
        if reverse:
            bare = ViewGraph(bare.num_nodes, bare.edges, -bare.directions, bare.weights, bare.names)
        graph = MeasuredGraph(bare)
    with clock("solve"):
        placed = list(place_pieces(graph, options, on_iteration=reported(clock.advance)))
    with clock("trust"):
        judged = [judge(piece, options) for piece in placed]
    return GraphResult(
        path=Path(path if isinstance(path, Path | str) else "pose graph in memory"),
        statement=statement,
        options=options,
        placement=PlacedGraph.of(judged[0], options),
        further=tuple(judged[1:]),
        timings_s=clock.seconds,
    )
