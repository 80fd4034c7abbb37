"""One row per camera and one per pair of a placed graph."""

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.facts.placed import folder_of
from sfm_shapefit.facts.tables import CameraRow, PairRow, Table, name_in, write_csv
from sfm_shapefit.files.lines import text_of
from sfm_shapefit.graph.rigidity import left_out_reasons
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.judgement.uncertainty import standard_deviations
from sfm_shapefit.judgement.verdicts import Verdict
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.placement.place import count_large

_UNCHECKED = "no other pair checks it: the solution bends to fit it"
_ELSEWHERE = "in a larger piece, to which this one is not rigidly tied"
_OUTSIDE = "outside the pieces that are solved"
_INNER = "inside a frame, or between fixed cameras: it says nothing of positions"


def camera_rows(
    placement: Judged,
    centers: FloatArray,
    scale: float,
    further: Sequence[Judged] = (),
    axes: FloatArray | None = None,
) -> Table[CameraRow]:
    """Return one row per camera of a placed graph.

    Args:
        placement: the graph and its solution.
        centers: (k, d) centers of the placed cameras in the output's units; NaN for those that are left out
            because they are not trusted.
        scale: the output's units in one unit of the solver.
        further: the other pieces that are solved; the rows of their cameras say where they stand.
        axes: (d, d) rotation from the input's axes to the output's; the same if None.
    """
    graph, cameras = placement.graph, range(placement.num_cameras)
    # Each camera's home is the first piece of three cameras or more that holds it, or the largest.
    homes: list[int | None] = [None] * graph.num_nodes
    for k in reversed(range(max(count_large(placement.pieces, placement.measured), 1))):
        for camera in placement.pieces[k].nodes.tolist():
            homes[camera] = k
    reasons = left_out_reasons(graph, placement.pieces)
    folders: dict[int, list[str]] = {}
    for piece in further:
        for camera in piece.cameras.tolist():
            folders.setdefault(camera, []).append(folder_of(piece.piece))
    reasons |= {
        camera: f"{reasons[camera]}; see {', '.join(names)}"
        for camera, names in folders.items()
        if camera in reasons
    }
    if placement.piece:
        reasons = dict.fromkeys(range(graph.num_nodes), _ELSEWHERE) | reasons
    told = {
        "name": [graph.name_of(camera) for camera in cameras],
        "piece": [homes[camera] for camera in cameras],
        "degree": _degrees(graph.edges[: placement.num_pairs], placement.num_cameras),
        "reason": [reasons.get(camera, "") for camera in cameras],
    }
    rows = Table(CameraRow, graph.dimension, told)
    for name, values in own_camera_rows(placement, centers, scale, axes).columns.items():
        if name != "degree":
            rows.columns[name][placement.cameras] = values
    return rows


def own_camera_rows(
    placement: Judged, centers: FloatArray, scale: float, axes: FloatArray | None = None
) -> Table[CameraRow]:
    """Return the rows of the cameras of the piece that is solved; arguments as of `camera_rows`."""
    graph, assessment, cameras = placement.graph, placement.assessment, placement.cameras
    inside = graph.edges[placement.edges[placement.pairs]]
    covariances = placement.covariances if axes is None else _turned(placement.covariances, axes)
    trust, kept = assessment.trust[: len(cameras)], np.asarray(np.isfinite(centers).all(axis=1))
    of_each = zip(kept.tolist(), trust.tolist(), assessment.reasons, strict=False)
    told = {
        "name": [graph.name_of(camera) for camera in cameras.tolist()],
        "placed": kept,
        "reason": [
            why if ok else f"not trusted ({value:.2f})" + (f": {why}" if why else "")
            for ok, value, why in of_each
        ],
        "piece": [placement.piece] * len(cameras),
        "center": np.where(kept[:, None], centers, np.nan),
        "degree": _degrees(inside, graph.num_nodes)[cameras],
        "trust": trust,
        "sigma": scale * standard_deviations(covariances),
        "correlation": correlations_of(covariances),
    }
    return Table(CameraRow, graph.dimension, told)


def _degrees(pairs: IntArray, count: int) -> IntArray:
    return np.bincount(pairs.ravel(), minlength=count)[:count]


def _turned(covariances: FloatArray, axes: FloatArray) -> FloatArray:
    """Return covariances (n, d, d) in other axes, infinite where nothing holds a node."""
    held = ~np.isinf(covariances).any(axis=(1, 2))
    turned = np.full(covariances.shape, np.inf)
    turned[held] = axes @ covariances[held] @ axes.T
    return turned


def covariances_of(rows: Table[CameraRow]) -> FloatArray:
    """Return the covariances (n, 3, 3) of centers, of the first three axes; NaN where nothing holds one."""
    sigmas, d = rows.columns["sigma"], rows.dimension
    found = np.zeros((len(rows), max(d, 3), max(d, 3)))
    correlations = np.tile(np.eye(d), (len(rows), 1, 1))
    i, j = np.triu_indices(d, k=1)
    correlations[:, i, j] = correlations[:, j, i] = rows.columns["correlation"]
    known = np.isfinite(sigmas).all(axis=1)
    found[:, :d, :d] = np.nan
    found[known, :d, :d] = (correlations * (sigmas[:, :, None] * sigmas[:, None, :]))[known]
    return found[:, :3, :3]


def covariances_text(covariances: Mapping[str, FloatArray]) -> str:
    """Return covariances (3, 3) of centers, by the names of cameras, as a CSV; numbers round-trip."""
    stream, values = io.StringIO(), np.reshape(list(covariances.values()), (-1, 9)).T.tolist()
    names = (first + second for first in "xyz" for second in "xyz")
    write_csv({"name": list(covariances)} | dict(zip(names, values, strict=True)), stream)
    return stream.getvalue()


def read_covariances(path: Path) -> dict[str, FloatArray]:
    """Return the covariances (3, 3) in a covariances.csv, by the names of cameras.

    Raises:
        InputError: if the file cannot be read.
    """
    try:
        _, *rows = csv.reader(io.StringIO(text_of(path, keeps_returns=True), newline=""))
        return {name_in(name): np.array(cells, dtype=np.float64).reshape(3, 3) for name, *cells in rows}
    except (InputError, ValueError, csv.Error) as error:
        raise InputError(f"{path} is missing or damaged ({error}); run locate or map again") from error


def correlations_of(covariances: FloatArray) -> FloatArray:
    """Return the correlations of each two axes, (n, d (d - 1) / 2): 0 if exact, NaN if nothing holds it."""
    sigmas = standard_deviations(covariances)
    i, j = np.triu_indices(covariances.shape[1], k=1)
    products = sigmas[:, i] * sigmas[:, j]
    with np.errstate(invalid="ignore"):
        found = covariances[:, i, j] / np.where(products > 0.0, products, 1.0)
    return np.asarray(np.clip(found, -1.0, 1.0))


def pair_rows(placement: Judged, support: IntArray, further: Sequence[Judged] = ()) -> Table[PairRow]:
    """Return one row per pair of cameras (m,), with its number of inlier matches.

    Pairs of the `further` pieces that are solved are judged by these.
    """
    graph, groups, count = placement.graph, placement.groups, placement.num_pairs
    edges = graph.edges[:count]
    reasons = np.full(count, _OUTSIDE, dtype=object)
    if groups is not None:
        reasons[groups.group_of[edges[:, 0]] == groups.group_of[edges[:, 1]]] = _INNER
    verdicts = np.full(count, Verdict.UNDETERMINED.value, dtype=object)
    figures = np.full((4, count), np.nan)
    for piece in (placement, *further):
        own = piece.edges < count
        judged, rows = piece.assessment, piece.edges[own]
        verdicts[rows] = [judged.verdict(k).value for k in np.flatnonzero(own).tolist()]
        reasons[rows] = np.where(verdicts[rows] == Verdict.UNDETERMINED.value, _UNCHECKED, "")
        dual_norms = np.linalg.norm(piece.certified.dual, axis=1) / graph.weights[piece.edges]
        values = judged.residuals_deg, dual_norms, judged.leverages, piece.refined.posterior
        figures[:, rows] = np.stack(values)[:, own]
    columns = {
        "name1": [graph.name_of(i) for i in edges[:, 0].tolist()],
        "name2": [graph.name_of(j) for j in edges[:, 1].tolist()],
        "direction": graph.directions[:count],
        "support": support,
        "weight": graph.weights[:count],
        "verdict": verdicts,
        "reason": reasons,
    }
    columns |= zip(("residual_deg", "dual_norm", "leverage", "posterior"), figures, strict=True)
    return Table(PairRow, graph.dimension, columns)


def without_direction(directions: PairDirections, graph: ViewGraph) -> dict[int, str]:
    """Say, for the cameras none of whose pairs has a usable direction, what became of their pairs."""
    causes: dict[int, Counter[str]] = {c: Counter() for c in np.flatnonzero(graph.degrees() == 0).tolist()}
    for pair, status in zip(directions.pairs.tolist(), directions.status, strict=True):
        for camera in pair:
            if camera in causes:
                causes[camera][status.value] += 1
    reasons = dict.fromkeys(causes, "no matches with any posed image")
    for camera, counter in causes.items():
        for cause, count in counter.most_common(1):
            total = counter.total()
            reasons[camera] = f"no usable direction in {total} pairs, most often ({count}): {cause}"
    return reasons
