"""What `locate` found as tables: one row per camera, one per pair, and the summary in locate.json.

The formats are part of the interface (`cameras.csv`, `pairs.csv`, `locate.json`, schema version 1):
columns and keys may be added, never renamed.
"""

import csv
import itertools
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal, TypeVar

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.lines import refuse_irregular_file
from sfm_shapefit.judgement.verdicts import Verdict

SCHEMA_VERSION: Literal[1] = 1
IN_MEMORY = "in memory"
"""What stands in locate.json in the place of a model's path where there is none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRow:
    """One image of the input, or node of a bare graph, placed or not; NaN and None are empty fields."""

    name: str
    placed: bool = False
    reason: str = ""
    """Why it is not placed or, if it is, why its trust is low."""
    piece: int | None = None
    """The parallel-rigid piece it belongs to, 0 the largest, which is the output; N stands in pieces/N with
    a scale of its own. None outside every piece of 3 cameras."""
    center: tuple[float, ...] = ()
    """Center in the output's units, d numbers; empty when not placed. Columns x, y, z."""
    degree: int = 0
    """Number of its pairs with a usable direction."""
    trust: float = math.nan
    """How far it is to be trusted, in [0, 1]: the share of its matches with the consensus of cameras that
    agree with the solution, compared with what is usual in the scene, and lowered where it is loose; see
    `judgement.trust`."""
    sigma: tuple[float, ...] = ()
    """Standard deviation of the center that is delivered, in the output's units, relative to the centroid and
    scale of the model or to fixed cameras; `sigma_of` in locate.json says which, and what errors it knows of.
    Columns sigma_x, sigma_y, sigma_z, empty also where the agreeing pairs do not hold the camera."""
    correlation: tuple[float, ...] = ()
    """Correlations of the errors along two axes each, d (d - 1) / 2 numbers in [-1, 1], which with `sigma`
    make the covariance of the center. Columns rho_xy, rho_xz, rho_yz, empty where `sigma` is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairRow:
    """One pair that was looked at; NaN is an empty field."""

    name1: str
    name2: str
    direction: tuple[float, ...] = ()
    """Unit direction from image 2 to image 1 in world axes (of C_1 - C_2). Columns vx, vy, vz."""
    support: int = 0
    """Number of inlier matches; 0 for a bare graph, which does not say."""
    weight: float = math.nan
    """Weight in the program."""
    residual_deg: float = math.nan
    """Angle between the direction and the solved baseline."""
    dual_norm: float = math.nan
    """||y_e|| / w_e of the certificate; below 1 for directions that the solution fits exactly."""
    leverage: float = math.nan
    """Share of its own fitted direction that it decides itself, in [0, 1]; 0 for outliers."""
    verdict: str = Verdict.UNDETERMINED.value
    """inlier, outlier, or undetermined."""
    reason: str = ""
    """Why it is undetermined."""
    triplet_score: float = math.nan
    """Weighted share of the triangles of relative rotations that close with it; only where `map` averaged and
    the pair is in a triangle. A low one is a sign of repeated structure."""
    matched_share: float = math.nan
    """Of the keypoints in the overlap of its images that are matched with third images, the share matched
    here; the smaller one of its two images. Only from `map`."""
    pair_score: float = math.nan
    """`triplet_score` (0.5 where there is none) times `matched_share`: the lowest of a scene are the
    likeliest to be repeated structure."""
    prior_angle_deg: float = math.nan
    """Angle between the direction and the baseline of the position priors, where both cameras have one."""


Row = TypeVar("Row", CameraRow, PairRow)
_PREFIXES = {"center": "", "sigma": "sigma_", "direction": "v", "correlation": "rho_"}
"""Of the columns of a vector, one per axis, or per two axes."""
_PARSERS: dict[Any, Callable[[str], Any]] = {
    str: str.__str__,
    bool: "true".__eq__,
    int: int,
    float: lambda cell: float(cell or "nan"),
    int | None: lambda cell: int(cell) if cell else None,
}
"""How a cell is read, by the type of its field; one that a short line lacks is None, and refused."""
_ADDED_COLUMNS = {"triplet_score", "matched_share", "pair_score", "prior_angle_deg", "correlation"}
"""What earlier outputs lack."""


def write_rows(
    rows: Sequence[CameraRow] | Sequence[PairRow], row_type: type, dimension: int, path: Path
) -> None:
    """Write rows of one type as CSV; a column of d numbers becomes d columns, one per axis."""
    names = [field.name for field in fields(row_type)]
    values_of = attrgetter(*names)
    widths = [len(columns_of_field(name, dimension)) if name in _PREFIXES else 0 for name in names]

    def cells(row: CameraRow | PairRow) -> list[object]:
        found: list[object] = []
        for value, width in zip(values_of(row), widths, strict=True):
            if width:
                found.extend(map(_cell, value) if value else ("",) * width)
            else:
                found.append(_cell(value))
        return found

    columns = [column for name in names for column in columns_of_field(name, dimension)]
    _write_csv(columns, map(cells, rows), path)


def read_rows(row_type: type[Row], dimension: int, path: Path) -> list[Row]:
    """Return the rows that `write_rows` wrote.

    Raises:
        InputError: if it is no ordinary file.
        OSError, ValueError, KeyError, TypeError: if it cannot be read, or a cell is not as it should be.
    """
    refuse_irregular_file(path)

    columns = {item.name: columns_of_field(item.name, dimension) for item in fields(row_type)}

    def value(cells: dict[str, str], name: str, kind: Any) -> Any:
        if name not in _PREFIXES:
            return _PARSERS[kind](cells[name])
        numbers = [cells[column] for column in columns[name]]
        return tuple(map(float, numbers)) if all(numbers) else ()

    with path.open(newline="", encoding="utf-8") as stream:
        return [
            row_type(
                **{
                    item.name: value(cells, item.name, item.type)
                    for item in fields(row_type)
                    if item.name not in _ADDED_COLUMNS or columns[item.name][0] in cells
                }
            )
            for cells in csv.DictReader(stream)
        ]


def columns_of_field(name: str, dimension: int) -> list[str]:
    """Return the columns of a row's field: one, or one per axis of a vector, or per two axes."""
    if name not in _PREFIXES:
        return [name]
    axes = axis_names(dimension)
    if name == "correlation":
        axes = [first + second for first, second in itertools.combinations(axes, 2)]
    return [_PREFIXES[name] + axis for axis in axes]


def axis_names(dimension: int) -> list[str]:
    """Return x, y, z up to three dimensions, and x1, x2, ... beyond."""
    return list("xyz"[:dimension]) if dimension <= len("xyz") else [f"x{k + 1}" for k in range(dimension)]


def write_records(records: Sequence[Mapping[str, object]], path: Path) -> None:
    """Write records as CSV, at least one; numbers round-trip, NaN and None are empty fields.

    Raises:
        InputError: if the file cannot be written.
    """
    columns = list(records[0])
    _write_csv(columns, ([_cell(record[name]) for name in columns] for record in records), path)


def _write_csv(columns: Sequence[str], rows: Iterable[list[object]], path: Path) -> None:
    """Write a header and rows of cells; bytes that are no UTF-8, as names may have, appear as \\udcXX."""
    try:
        with path.open("w", newline="", encoding="utf-8", errors="backslashreplace") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows(rows)
    except OSError as error:
        raise InputError(f"{path} cannot be written ({error.strerror}); choose another file") from error


def write_json(summary: dict[str, Any], path: Path) -> None:
    """Write a summary as JSON, with null for numbers that are not finite."""
    path.write_text(dumps(summary) + "\n", encoding="utf-8")


def dumps(summary: dict[str, Any], *, only_ascii: bool = False) -> str:
    """Return a summary as JSON text that UTF-8 can encode, or ASCII, with escapes for all else.

    NaN and infinities, which JSON has not, become null. Bytes of a path that are no UTF-8 become the escape
    \\udcXX, from which `os.fsencode` of the parsed text gives them back.
    """
    text = json.dumps(_finite(summary), indent=2, ensure_ascii=only_ascii, allow_nan=False)
    return text.encode("utf-8", errors="backslashreplace").decode("utf-8")  # Python's escape is JSON's


def _cell(value: object) -> object:
    if isinstance(value, float):
        return repr(float(value)) if math.isfinite(value) else ""
    if isinstance(value, bool):
        return str(value).lower()
    return "" if value is None else value


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
