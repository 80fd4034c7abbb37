"""What `locate` found as tables: one row per camera, one per pair, and the summary in locate.json.

The formats are part of the interface (`cameras.csv`, `pairs.csv`, `locate.json`, schema version 1):
columns and keys may be added, never renamed.
"""

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from sfm_shapefit.solver.options import SolverResult

SCHEMA_VERSION = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRow:
    """One image of the input, placed or not."""

    name: str
    placed: bool
    reason: str
    """Why it is not placed; empty for a placed camera."""
    piece: int | None
    """The parallel-rigid piece it belongs to, 0 the largest; None outside every piece of 3 cameras."""
    x: float
    y: float
    z: float
    """Centre in the output's units; NaN when not placed."""
    degree: int
    """Number of its pairs with a usable direction."""
    trust: float
    """Share of its pairs that agree with the solution, in [0, 1]; NaN when not placed."""
    sigma_x: float
    sigma_y: float
    sigma_z: float
    """Standard deviation of the centre in the output's units, centroid and scale held fixed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairRow:
    """One image pair with a usable direction."""

    name1: str
    name2: str
    vx: float
    vy: float
    vz: float
    """Unit direction from image 2 to image 1 in world axes (of C_1 - C_2)."""
    support: int
    """Number of inlier matches."""
    weight: float
    residual_deg: float
    """Angle between the direction and the solved baseline; NaN if a camera is not placed."""
    dual_norm: float
    """||y_e|| / w_e of the certificate, below 1 for directions that the solution fits exactly."""
    verdict: str
    """inlier, outlier or undetermined."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PieceRow:
    """A parallel-rigid piece of three cameras or more."""

    num_cameras: int
    scale: str
    """The gauge of a solved piece, "not solved" for the others."""
    hinges: list[str]
    """Names of the cameras that it shares with other pieces."""


def write_csv(rows: Sequence[CameraRow] | Sequence[PairRow], row_type: type, path: Path) -> None:
    """Write rows as CSV with a header; numbers round-trip, NaN and None are empty fields."""
    names = [field.name for field in fields(row_type)]
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(names)
        writer.writerows([_cell(getattr(row, name)) for name in names] for row in rows)


def write_json(summary: dict[str, Any], path: Path) -> None:
    """Write a summary as JSON, with null for numbers that are not finite."""
    path.write_text(dumps(summary) + "\n", encoding="utf-8")


def dumps(summary: dict[str, Any]) -> str:
    """Return a summary as JSON text; NaN and infinities, which JSON has not, become null."""
    return json.dumps(_finite(summary), indent=2, ensure_ascii=False, allow_nan=False)


def solve_summary(result: SolverResult) -> dict[str, Any]:
    """Return the `solve` object of locate.json."""
    return {
        "status": result.status.name.lower(),
        "objective": result.objective,
        "dual_bound": result.dual_bound,
        "gap": result.gap,
        "equality_residual": result.equality_residual,
        "iterations": result.iterations,
        "seconds": result.seconds,
        "method": result.method,
        "method_reason": result.method_reason,
    }


def pieces_summary(pieces: Sequence[PieceRow]) -> list[dict[str, Any]]:
    """Return the `pieces` list of locate.json."""
    return [asdict(piece) for piece in pieces]


def _cell(value: object) -> object:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    return repr(float(value)) if isinstance(value, float) else value


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
