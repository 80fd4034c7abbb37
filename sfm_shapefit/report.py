"""What `locate` found as tables: one row per camera, one per pair, and the summary in locate.json.

The formats are part of the interface (`cameras.csv`, `pairs.csv`, `locate.json`, schema version 1):
columns and keys may be added, never renamed.
"""

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from sfm_shapefit.errors import InputError
from sfm_shapefit.robust import Verdict
from sfm_shapefit.solver.options import SolverResult

SCHEMA_VERSION = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRow:
    """One image of the input, placed or not; NaN and None are empty fields."""

    name: str
    placed: bool = False
    reason: str = ""
    """Why it is not placed."""
    piece: int | None = None
    """The parallel-rigid piece it belongs to, 0 the solved one; None outside every piece of 3 cameras."""
    x: float = math.nan
    y: float = math.nan
    z: float = math.nan
    """Centre in the output's units."""
    degree: int = 0
    """Number of its pairs with a usable direction."""
    trust: float = math.nan
    """Share of its pairs that agree with the solution, in [0, 1]."""
    sigma_x: float = math.nan
    sigma_y: float = math.nan
    sigma_z: float = math.nan
    """Standard deviation of the solved centre in the output's units, with centroid and scale held fixed;
    empty also where the agreeing pairs do not hold the camera."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairRow:
    """One image pair that was looked at; NaN is an empty field."""

    name1: str
    name2: str
    vx: float = math.nan
    vy: float = math.nan
    vz: float = math.nan
    """Unit direction from image 2 to image 1 in world axes (of C_1 - C_2)."""
    support: int = 0
    """Number of inlier matches."""
    weight: float = math.nan
    """Weight in the program."""
    residual_deg: float = math.nan
    """Angle between the direction and the solved baseline."""
    dual_norm: float = math.nan
    """||y_e|| / w_e of the certificate; below 1 for directions that the solution fits exactly."""
    verdict: str = Verdict.UNDETERMINED.value
    """inlier, outlier, or undetermined."""
    reason: str = ""
    """Why it is undetermined."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PieceRow:
    """A parallel-rigid piece of three cameras or more."""

    num_cameras: int
    scale: str
    """The gauge of a solved piece, "not solved" for the others."""
    hinges: list[str]
    """Names of the cameras that it shares with other pieces."""


def write_csv(rows: Sequence[CameraRow] | Sequence[PairRow], row_type: type, path: Path) -> None:
    """Write rows of one type as CSV; the header stands even where there is no row."""
    names = [field.name for field in fields(row_type)]
    write_records([asdict(row) for row in rows], path, names)


def write_records(
    records: Sequence[Mapping[str, object]], path: Path, names: Sequence[str] | None = None
) -> None:
    """Write records as CSV; numbers round-trip, NaN and None are empty fields.

    Args:
        records: one mapping per row.
        path: the file.
        names: the columns; by default those of the first record.

    Raises:
        InputError: if the file cannot be written.
    """
    columns = names or list(records[0])
    try:
        with path.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows([_cell(record[name]) for name in columns] for record in records)
    except OSError as error:
        raise InputError(f"{path} cannot be written ({error.strerror}); choose another file") from error


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
