"""What `locate` returns, and its files: the seeded model, `locate.json`, `cameras.csv`, `pairs.csv`."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sfm_shapefit import __version__
from sfm_shapefit.colmap.adjustment import Adjusted
from sfm_shapefit.colmap.model import PosedModel
from sfm_shapefit.colmap.seed import write_model
from sfm_shapefit.directions import DirectionStatus, PairDirections
from sfm_shapefit.gauge import Gauge
from sfm_shapefit.options import LocateOptions, Source
from sfm_shapefit.output import MARKER, atomic_folder
from sfm_shapefit.report import (
    SCHEMA_VERSION,
    CameraRow,
    PairRow,
    PieceRow,
    solve_summary,
    write_csv,
    write_json,
)
from sfm_shapefit.rigidity import RigidPiece, left_out_reasons
from sfm_shapefit.robust import Assessment, Verdict
from sfm_shapefit.solver.options import SolverResult
from sfm_shapefit.viewgraph import ViewGraph

if TYPE_CHECKING:
    import pycolmap

_SMALLEST_PIECE = 3  # cameras; two cameras of one pair are no piece worth a line


@dataclass(frozen=True, slots=True, kw_only=True)
class Inputs:
    """What `locate` worked from."""

    folder: Path | None
    """The model folder; None for a reconstruction in memory."""
    database: Path | None
    """The database whose matches were used, if any."""
    source: Source
    """Where the directions came from; never "auto"."""
    statement: str
    """How that choice was made, for the user."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocateResult:
    """The seeded model and the evidence for it. Piece 0, the largest, is the one that is solved."""

    reconstruction: "pycolmap.Reconstruction"
    """A new reconstruction: placed cameras and triangulated points; other images are unregistered."""
    inputs: Inputs
    options: LocateOptions
    model: PosedModel
    """The input as read; camera k below is its image k."""
    directions: PairDirections
    """All pairs that were looked at, with their support."""
    graph: ViewGraph
    """All cameras and the usable directions; edge e is row `directions.usable()[e]`."""
    pieces: list[RigidPiece]
    """Parallel-rigid pieces of `graph`, largest first."""
    solve: SolverResult
    """The solve of piece 0; its row e is edge `pieces[0].edges[e]` of `graph`."""
    assessment: Assessment
    """Evidence for the pairs and cameras of piece 0, in the solver's units."""
    gauge: Gauge
    """From the solver's units to the output's."""
    adjusted: Adjusted | None
    """How bundle adjustment went, if it was asked for; its model is `reconstruction`, uncoloured."""
    timings_s: dict[str, float]
    """Wall-clock seconds per stage."""
    warnings: tuple[str, ...]
    """What the user should know, a sentence each."""


def camera_rows(found: LocateResult) -> list[CameraRow]:
    """Return one row per image of the input: the posed ones by id, then those without a rotation."""
    placed = {camera: k for k, camera in enumerate(found.pieces[0].cameras.tolist())}
    homes = _home_pieces(found)
    reasons = left_out_reasons(found.graph, found.pieces)
    degrees = found.graph.degrees()
    sigmas = found.assessment.sigmas * found.gauge.similarity.scale
    rows = []
    for camera, image_id in enumerate(found.model.image_ids.tolist()):
        row = CameraRow(name=found.model.names[camera], piece=homes[camera], degree=int(degrees[camera]))
        if camera not in placed:
            rows.append(replace(row, reason=_reason(found, camera, reasons[camera])))
            continue
        k = placed[camera]
        x, y, z = found.reconstruction.image(image_id).projection_center().tolist()
        trust, (sigma_x, sigma_y, sigma_z) = float(found.assessment.trust[k]), sigmas[k].tolist()
        row = replace(row, placed=True, x=x, y=y, z=z, trust=trust)
        rows.append(replace(row, sigma_x=sigma_x, sigma_y=sigma_y, sigma_z=sigma_z))
    unposed = sorted(set(_all_names(found)) - set(found.model.names))
    return rows + [CameraRow(name=name, reason="the input has no rotation for it") for name in unposed]


def pair_rows(found: LocateResult) -> list[PairRow]:
    """Return one row per pair that was looked at, usable or not, in the order of pairs."""
    names, looked_at = found.model.names, found.directions
    usable = looked_at.usable()
    solved_row = np.full(len(looked_at.pairs), -1, dtype=np.int64)
    solved_row[usable[found.pieces[0].edges]] = np.arange(len(found.pieces[0].edges))
    weights = found.graph.weights[found.pieces[0].edges]
    dual_norms = np.linalg.norm(found.solve.dual, axis=1) / weights
    rows = []
    for p, (i, j) in enumerate(looked_at.pairs.tolist()):
        vx, vy, vz = looked_at.directions[p].tolist()
        row = PairRow(
            name1=names[i], name2=names[j], vx=vx, vy=vy, vz=vz, support=int(looked_at.num_inliers[p])
        )
        e = int(solved_row[p])
        if e >= 0:
            verdict = Verdict.INLIER if found.assessment.inliers[e] else Verdict.OUTLIER
            rows.append(
                replace(
                    row,
                    weight=float(weights[e]),
                    residual_deg=float(found.assessment.residuals_deg[e]),
                    dual_norm=float(dual_norms[e]),
                    verdict=verdict.value,
                )
            )
        elif looked_at.status[p] is DirectionStatus.USABLE:
            rows.append(replace(row, reason="a camera of the pair is not placed"))
        else:
            rows.append(replace(row, reason=looked_at.status[p].value))
    return rows


def piece_rows(found: LocateResult) -> list[PieceRow]:
    """Return one row per parallel-rigid piece of three cameras or more, and for the solved one."""
    names = found.model.names
    return [
        PieceRow(
            num_cameras=len(piece.cameras),
            scale=found.gauge.statement if k == 0 else "free, not solved",
            hinges=[names[hinge] for hinge in piece.hinges.tolist()],
        )
        for k, piece in enumerate(found.pieces)
        if k == 0 or len(piece.cameras) >= _SMALLEST_PIECE
    ]


def summary(found: LocateResult) -> dict[str, Any]:
    """Return what stands in locate.json: plain values, schema version first."""
    num_outliers = int(np.sum(~found.assessment.inliers))
    num_unusable = len(found.directions.pairs) - len(found.directions.usable())
    return {
        "schema_version": SCHEMA_VERSION,
        "inputs": {
            "model": str(found.inputs.folder or "in memory"),
            "database": found.inputs.database and str(found.inputs.database),
            "directions": found.inputs.statement,
        },
        "options": asdict(found.options),
        "num_images": len(_all_names(found)),
        "num_placed": len(found.pieces[0].cameras),
        "num_pairs": len(found.directions.pairs),
        "num_pairs_rejected": num_unusable + num_outliers,
        "pairs": {status.name.lower(): count for status, count in found.directions.counts().items()}
        | {"outlier": num_outliers},
        "num_points": found.reconstruction.num_points3D(),
        "mean_reprojection_error_px": found.reconstruction.compute_mean_reprojection_error(),
        "residual_level_deg": found.assessment.level_deg,
        "scale": found.gauge.statement,
        "pieces": [asdict(row) for row in piece_rows(found)],
        "solve": solve_summary(found.solve),
        "bundle_adjustment": found.adjusted and _adjustment_summary(found.adjusted),
        "timings_s": found.timings_s,
        "warnings": list(found.warnings),
        "versions": {"sfm_shapefit": __version__}
        | {name: version(name) for name in ("pycolmap", "numpy", "scipy", "clarabel")},
    }


def write_result(
    found: LocateResult, out: Path | str, *, overwrite: bool = False, protect: Sequence[Path | str] = ()
) -> None:
    """Write the seeded model and its tables into a folder that appears whole or not at all.

    Args:
        found: what `locate` returned.
        out: the folder to be made.
        overwrite: replace an earlier output of this package.
        protect: paths that `out` must not be or contain, beside the inputs of `found`.

    Raises:
        InputError: if the folder exists, cannot be written, or would hit a protected path.
    """
    inputs = [path for path in (found.inputs.folder, found.inputs.database) if path is not None]
    with atomic_folder(out, overwrite=overwrite, protect=[*inputs, *protect]) as folder:
        write_model(found.reconstruction, folder)
        write_csv(camera_rows(found), CameraRow, folder / "cameras.csv")
        write_csv(pair_rows(found), PairRow, folder / "pairs.csv")
        write_json(summary(found), folder / MARKER)


def _all_names(found: LocateResult) -> list[str]:
    """Return the names of all images of the input, posed or not."""
    return [image.name for image in found.model.reconstruction.images.values()]


def _home_pieces(found: LocateResult) -> list[int | None]:
    """Return the first piece of three cameras or more that holds each camera, or the solved one."""
    homes: list[int | None] = [None] * found.graph.num_cameras
    for k, piece in reversed(list(enumerate(found.pieces))):
        if k == 0 or len(piece.cameras) >= _SMALLEST_PIECE:
            for camera in piece.cameras.tolist():
                homes[camera] = k
    return homes


def _reason(found: LocateResult, camera: int, fallback: str) -> str:
    """Return why a camera is not placed; for one without usable pairs, what became of its pairs."""
    if found.graph.degrees()[camera] > 0:
        return fallback
    own = (found.directions.pairs == camera).any(axis=1)
    if not own.any():
        return "no matches with any posed image"
    causes = Counter(found.directions.status[p].value for p in np.flatnonzero(own).tolist())
    cause, count = causes.most_common(1)[0]
    return f"no usable direction in {int(own.sum())} pairs, most often ({count}): {cause}"


def _adjustment_summary(adjusted: Adjusted) -> dict[str, Any]:
    return {
        "converged": adjusted.converged,
        "iterations": adjusted.iterations,
        "initial_error_px": adjusted.initial_error_px,
        "final_error_px": adjusted.final_error_px,
    }
