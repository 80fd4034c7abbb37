"""One row per camera and one per pair of a placed graph."""

import csv
import io
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.facts.placed import folder_of
from sfm_shapefit.facts.tables import CameraRow, MethodScores, PairRow, name_in, write_csv
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
_NOT_JUDGED = (Verdict.UNDETERMINED, *4 * (math.nan,))
_INNER = "inside a frame, or between fixed cameras: it says nothing of positions"


def camera_rows(
    placement: Judged,
    centers: FloatArray,
    scale: float,
    further: Sequence[Judged] = (),
    axes: FloatArray | None = None,
) -> list[CameraRow]:
    """Return one row per camera of a placed graph.

    Args:
        placement: the graph and its solution.
        centers: (k, d) centers of the placed cameras in the output's units; NaN for those that are left out
            because they are not trusted.
        scale: the output's units in one unit of the solver.
        further: the other pieces that are solved; the rows of their cameras say where they stand.
        axes: (d, d) rotation from the input's axes to the output's; the same if None.
    """
    graph = placement.graph
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
    degrees = np.bincount(graph.edges[: placement.num_pairs].ravel(), minlength=placement.num_cameras)
    if placement.piece:
        reasons = dict.fromkeys(range(graph.num_nodes), _ELSEWHERE) | reasons
    rows = [
        CameraRow(
            name=graph.name_of(camera), piece=homes[camera], degree=degree, reason=reasons.get(camera, "")
        )
        for camera, degree in enumerate(degrees.tolist())
    ]
    for camera, row in zip(
        placement.cameras.tolist(), own_camera_rows(placement, centers, scale, axes), strict=True
    ):
        rows[camera] = replace(row, degree=rows[camera].degree)
    return rows


def own_camera_rows(
    placement: Judged, centers: FloatArray, scale: float, axes: FloatArray | None = None
) -> list[CameraRow]:
    """Return the rows of the cameras of the piece that is solved; arguments as of `camera_rows`."""
    graph, assessment = placement.graph, placement.assessment
    inside = graph.edges[placement.edges[placement.pairs]]
    degrees = np.bincount(inside.ravel(), minlength=graph.num_nodes)
    covariances = placement.covariances if axes is None else _turned(placement.covariances, axes)
    sigmas, correlations = scale * standard_deviations(covariances), correlations_of(covariances)
    rows = []
    for k, camera in enumerate(placement.cameras.tolist()):
        kept = bool(np.isfinite(centers[k]).all())
        trust, reason = float(assessment.trust[k]), assessment.reasons[k]
        rows.append(
            CameraRow(
                name=graph.name_of(camera),
                placed=kept,
                reason=reason if kept else f"not trusted ({trust:.2f}): {reason}",
                piece=placement.piece,
                center=tuple(centers[k].tolist()) if kept else (),
                degree=int(degrees[camera]),
                trust=trust,
                sigma=tuple(sigmas[k].tolist()),
                correlation=tuple(correlations[k].tolist()),
            )
        )
    return rows


def _turned(covariances: FloatArray, axes: FloatArray) -> FloatArray:
    """Return covariances (n, d, d) in other axes, infinite where nothing holds a node."""
    held = ~np.isinf(covariances).any(axis=(1, 2))
    turned = np.full(covariances.shape, np.inf)
    turned[held] = axes @ covariances[held] @ axes.T
    return turned


def covariance_of(row: CameraRow) -> FloatArray:
    """Return the covariance (3, 3) of a center, NaN where nothing holds it; of the first three axes."""
    d = len(row.sigma)
    correlations = np.eye(d)
    i, j = np.triu_indices(d, k=1)
    correlations[i, j] = correlations[j, i] = row.correlation
    sigmas = np.array(row.sigma)
    found = np.zeros((max(d, 3), max(d, 3)))
    found[:d, :d] = correlations * np.outer(sigmas, sigmas) if np.isfinite(sigmas).all() else np.nan
    return found[:3, :3]


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


def pair_rows(
    placement: Judged,
    support: IntArray,
    further: Sequence[Judged] = (),
    scores: Sequence[MethodScores] = (),
) -> list[PairRow]:
    """Return one row per pair of cameras (m,), with its number of inlier matches, and `scores`.

    Pairs of the `further` pieces that are solved are judged by these.
    """
    graph, groups = placement.graph, placement.groups
    judged: dict[int, tuple[Any, ...]] = {}
    for piece in (placement, *further):
        told, dual_norms = piece.assessment, np.linalg.norm(piece.certified.dual, axis=1)
        figures = (told.residuals_deg, dual_norms / graph.weights[piece.edges], told.leverages)
        columns = (column.tolist() for column in (*figures, piece.refined.posterior))
        verdicts = map(told.verdict, range(len(piece.edges)))
        judged |= zip(piece.edges.tolist(), zip(verdicts, *columns, strict=True), strict=True)
    rows = []
    known = (graph.edges, graph.directions, support, graph.weights)
    given = zip(*(column[: placement.num_pairs].tolist() for column in known), strict=True)
    for edge, ((i, j), direction, number, weight) in enumerate(given):
        verdict, residual_deg, dual_norm, leverage, posterior = judged.get(edge, _NOT_JUDGED)
        reason = _UNCHECKED if verdict is Verdict.UNDETERMINED else ""
        if edge not in judged:
            inner = groups is not None and bool(groups.group_of[i] == groups.group_of[j])
            reason = _INNER if inner else _OUTSIDE
        rows.append(
            PairRow(
                name1=graph.name_of(i),
                name2=graph.name_of(j),
                direction=tuple(direction),
                support=number,
                residual_deg=residual_deg,
                verdict=verdict.value,
                reason=reason,
                scores=replace(
                    scores[edge] if scores else MethodScores(),
                    weight=weight,
                    dual_norm=dual_norm,
                    leverage=leverage,
                    posterior=posterior,
                ),
            )
        )
    return rows


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
