"""`place GRAPH`: a bare view graph, or relative poses of pairs, placed by the same steps as `locate`."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, real_numbers
from sfm_shapefit.base.clock import Clock, Progress
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import rotation_angles_deg
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.facts.placed_graph import PlacedGraph
from sfm_shapefit.facts.result import GraphResult
from sfm_shapefit.files.colmap.other_programs import relative_poses_of
from sfm_shapefit.files.g2o import is_g2o, read_g2o, read_g2o_rotations
from sfm_shapefit.files.glomap_text import is_relative_poses, read_relative_poses
from sfm_shapefit.files.graph_text import read_graph
from sfm_shapefit.files.onedsfm import EpipolarGeometries, is_onedsfm, read_onedsfm, read_rotations
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.judged import judge
from sfm_shapefit.placement.place import place_pieces
from sfm_shapefit.refinement.options import PlacementOptions
from sfm_shapefit.refinement.posterior import weigh_by_triangles
from sfm_shapefit.rotations.average import average_rotations
from sfm_shapefit.solver.options import OnIteration, reported

if TYPE_CHECKING:
    import pycolmap

MAX_ROTATION_ERROR_DEG = 10.0  # degrees; pairs off by more are taken for false, as 1DSfM does


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
        poses = _relative_poses(measured)
        measured = read_graph(measured) if poses is None else _orient(poses, None, threads=threads)[0]
    graph = MeasuredGraph(measured) if isinstance(measured, ViewGraph) else measured
    if sigma is not None:
        graph = replace(graph, covariance=_covariances(graph.graph, sigma))
    if rotations is not None:
        graph = _without_contradicted(graph, rotations, num_matches, threads)
    elif num_matches is not None:
        raise InputError("num_matches say how much relative rotations count; give rotations, too")
    placed = next(place_pieces(graph, options, on_iteration=on_iteration))
    return PlacedGraph.of(judge(placed, options), options)


def _without_contradicted(
    measured: MeasuredGraph, rotations: npt.ArrayLike, num_matches: npt.ArrayLike | None, threads: int
) -> MeasuredGraph:
    """Return what was measured of the pairs whose relative rotations agree with the averaged ones."""
    graph = measured.graph
    averaged = average_rotations(
        graph.edges, rotations, num_images=graph.num_nodes, weights=num_matches, threads=threads
    )
    relative = np.asarray(rotations, dtype=np.float64)
    agree = _agree(graph.edges, relative, averaged.rotations, MAX_ROTATION_ERROR_DEG)
    leave = averaged.registered[graph.edges].all(axis=1) & ~agree
    if num_matches is None and leave.any() and np.mean(weigh_by_triangles(graph).log_odds[leave] > 0.0) > 0.5:
        return measured
    return measured.subset(np.flatnonzero(~leave))


def _agree(pairs: IntArray, relative: FloatArray, rotations: FloatArray, most_deg: float) -> BoolArray:
    """Return which relative rotations of pairs (m, 2) agree with those of the cameras (n, 3, 3), (m,)."""
    i, j = pairs.T
    agree = rotation_angles_deg(relative @ rotations[i] @ rotations[j].swapaxes(1, 2)) <= most_deg
    if not agree.any():
        raise InputError(
            f"none of the {len(pairs)} relative rotations agrees with those of the cameras; "
            "check that they belong together"
        )
    return np.asarray(agree)


def _covariances(graph: ViewGraph, sigma: npt.ArrayLike) -> FloatArray:
    """Return the covariances (m, d - 1, d - 1) of directions from these, or from standard deviations (m,)."""
    given = real_numbers("sigma must be numbers, NaN where they are unknown", sigma)
    m, k = graph.num_edges, graph.dimension - 1
    if given.shape not in ((m,), (m, k, k)):
        raise InputError(
            f"sigma has shape {given.shape}; give one standard deviation, radians, for each of the {m} "
            f"directions, or covariances of shape {(m, k, k)}"
        )
    known = np.nan_to_num(given, posinf=np.inf, neginf=-np.inf)
    if given.ndim > 1 and not np.allclose(known, known.swapaxes(1, 2)):
        raise InputError("sigma has covariances that are not symmetric; give symmetric ones")
    if np.any(known > (np.pi if given.ndim == 1 else np.pi**2)) and not np.isinf(known).any():
        raise InputError(
            "sigma has values beyond pi radians, the largest angle; give radians, and NaN where they are "
            "unknown"
        )
    if np.isinf(known).any() or np.any((known if given.ndim == 1 else np.linalg.eigvalsh(known)) < 0.0):
        raise InputError(
            "sigma has negative or infinite values; give standard deviations or covariances, and NaN where "
            "they are unknown"
        )
    return np.asarray(np.square(given)[:, None, None] * np.eye(k) if given.ndim == 1 else given)


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
        geometries = _relative_poses(path)
    if geometries is not None:
        if reverse:
            raise InputError(f"{path} holds relative poses, whose sense is known; leave out reverse=True")
        with clock("rotations"):
            graph, statement = _orient(geometries, rotations, max_rotation_error_deg, threads=clock.threads)
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


def _relative_poses(source: "Path | str | pycolmap.PoseGraph") -> EpipolarGeometries | None:
    """Return the relative poses of a source; None if it is a bare graph of directions."""
    if not isinstance(source, Path | str):
        return relative_poses_of(source)
    if is_onedsfm(source):
        return read_onedsfm(source)
    if is_g2o(source):
        return read_g2o(source)
    return read_relative_poses(source) if is_relative_poses(source) else None


def _orient(
    poses: EpipolarGeometries,
    path: Path | str | None,
    max_rotation_error_deg: float = MAX_ROTATION_ERROR_DEG,
    *,
    threads: int,
) -> tuple[MeasuredGraph, str]:
    """Return the directions of the pairs that agree with the rotations, of a file or averaged."""
    if path is not None:
        read = read_g2o_rotations if is_g2o(path) else read_rotations
        (rotations, known), origin = read(path, poses.names), f"of {path}"
    else:
        averaged = average_rotations(
            poses.pairs,
            poses.rotations,
            poses.information,
            num_images=len(poses.names),
            weights=poses.num_matches,
            threads=threads,
        )
        rotations, known, origin = averaged.rotations, averaged.registered, "averaged"
        if averaged.counts_mislead:
            origin += " without numbers of matches, with which fewer pairs agree"
        elif poses.num_matches is not None:
            origin += " by the numbers of matches"
    agreeing = np.flatnonzero(_agree(poses.pairs, poses.rotations, rotations, max_rotation_error_deg))
    total, kept = len(poses.pairs), len(agreeing)
    statement = (
        f"{int(np.sum(known))} of {len(known)} rotations {origin}; {total - kept} of {total} pairs "
        f"contradict them by more than {max_rotation_error_deg:g} deg and are left out"
    )
    return poses.subset(agreeing.tolist()).measured(rotations, known), statement
