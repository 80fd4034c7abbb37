"""What `locate` found as tables: one row per camera and one per pair, as CSV and as columns of arrays.

`cameras.csv` and `pairs.csv` are part of the interface: columns may be added, never renamed.
"""

import csv
import io
import itertools
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, TextIO, cast

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.atomic_folder import MARKER
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.lines import text_of
from sfm_shapefit.judgement.limits import KNOWN_DEG
from sfm_shapefit.judgement.reasons import ModelVerdict
from sfm_shapefit.judgement.verdicts import Verdict
from sfm_shapefit.scene.given import Datum

TableName = Literal["cameras", "pairs"]
Column = npt.NDArray[Any]
_BYTE = re.compile(r"\\u(dc[89a-f][0-9a-f])")


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
    """How far it is to be trusted, in [0, 1]: the share of its pairs, or of their matches, that agree with
    it, and lower where it is loose; see `judgement.trust` and `judgement.doubted`."""
    sigma: tuple[float, ...] = ()
    """Standard deviation of the center that is delivered, in the output's units, relative to the centroid and
    scale of the model or to fixed cameras; `sigma_of` in locate.json says which, and what errors it knows of.
    Columns sigma_x, sigma_y, sigma_z, empty also where the agreeing pairs do not hold the camera."""
    correlation: tuple[float, ...] = ()
    """Correlations of the errors along two axes each, d (d - 1) / 2 numbers in [-1, 1], which with `sigma`
    make the covariance of the center. Columns rho_xy, rho_xz, rho_yz, empty where `sigma` is."""
    turned_deg: float = math.nan
    """Angle by which its given rotation was turned; empty where none was adjusted."""
    moved: float = math.nan
    """Distance of its center from the given one, in the output's units, after the similarity that brings most
    given centers near; only with rough rotations."""
    prior_off: float = math.nan
    """Distance of its center from its position prior, in the output's units; only where priors set these."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodScores:
    """What the method computes of a pair, for who studies it; NaN is an empty field."""

    weight: float = math.nan
    """Weight in the program."""
    dual_norm: float = math.nan
    """||y_e|| / w_e of the certificate; below 1 for directions that the solution fits exactly."""
    leverage: float = math.nan
    """Share of its own fitted direction that it decides itself, in [0, 1]; 0 for outliers."""
    triplet_score: float = math.nan
    """Weighted share of the triangles of relative rotations that close with it; only where `map` averaged and
    the pair is in a triangle. A low one is a sign of repeated structure."""
    matched_share: float = math.nan
    """Share, among the keypoints in the overlap of its images that are matched with third images, matched
    here; the smaller one of its two images. Only from `map`."""
    pair_score: float = math.nan
    """`triplet_score` (0.5 where there is none) times `matched_share`: the lowest of a scene are the
    likeliest to be repeated structure."""
    posterior: float = math.nan
    """Probability that the direction is right, by its residual and by the residuals of all pairs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairRow:
    """One pair that was looked at; NaN is an empty field."""

    name1: str
    name2: str
    direction: tuple[float, ...] = ()
    """Unit direction from image 2 to image 1 in world axes (of C_1 - C_2). Columns vx, vy, vz."""
    support: int = 0
    """Number of inlier matches; 0 for a bare graph, which does not say."""
    residual_deg: float = math.nan
    """Angle between the direction and the solved baseline."""
    verdict: str = Verdict.UNDETERMINED.value
    """inlier, outlier, or undetermined."""
    reason: str = ""
    """Why it is undetermined."""
    prior_angle_deg: float = math.nan
    """Angle between the direction and the baseline of the position priors, where both cameras have one."""
    scores: MethodScores = field(default=MethodScores(), repr=False)
    """Columns under their own names."""

    @property
    def contradicts(self) -> bool:
        """Whether it says that its cameras stand elsewhere; by less than a degree it does not."""
        return self.verdict == Verdict.OUTLIER.value and not self.residual_deg < KNOWN_DEG


_ROW_TYPES: dict[TableName, type[CameraRow] | type[PairRow]] = {"cameras": CameraRow, "pairs": PairRow}
_PREFIXES = {"center": "", "sigma": "sigma_", "direction": "v", "correlation": "rho_"}
"""Beginning of the columns of a vector, one per axis, or per two axes."""


def write_rows(
    rows: Sequence[CameraRow] | Sequence[PairRow], row_type: type, dimension: int, path: Path
) -> None:
    """Write rows of one type as CSV; a column of d numbers becomes d columns, one per axis."""
    with open_table(path) as stream:
        write_csv(_values_of(rows, row_type, dimension), stream)


def _values_of(rows: Sequence[Any], row_type: type, dimension: int) -> dict[str, list[Any]]:
    """Return the values of each column; NaN along the axes of a vector that is not known."""
    found: dict[str, list[Any]] = {}
    for item in fields(row_type):
        if item.name == "scores":
            found |= _values_of([row.scores for row in rows], MethodScores, dimension)
            continue
        values, names = [getattr(row, item.name) for row in rows], columns_of_field(item.name, dimension)
        if names == [item.name]:
            found[item.name] = values
        else:
            whole = [value or (math.nan,) * len(names) for value in values]
            found |= {name: [value[k] for value in whole] for k, name in enumerate(names)}
    return found


def read_trust(path: Path) -> dict[str, float]:
    """Return the trust of the cameras in a cameras.csv by their names; NaN where it is empty.

    Raises:
        InputError: if the file cannot be read.
    """
    try:
        rows = csv.DictReader(io.StringIO(text_of(path, keeps_returns=True), newline=""))
        return {name_in(cells["name"]): float(cells["trust"] or "nan") for cells in rows}
    except (InputError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise InputError(f"{path} is damaged or of another version ({error}); run locate again") from error


def model_datum(model: Any) -> Datum | None:
    """Return the datum of a result, or that in locate.json beside a model; None without."""
    if not isinstance(model, Path | str):
        known = getattr(getattr(model, "facts", None), "datum", None)
        return known and Datum(known.latitude_deg, known.longitude_deg, known.altitude_m)
    file = Path(model) / MARKER
    if not file.is_file():
        return None
    try:
        found = json.loads(text_of(file)).get("datum")
        return None if found is None else Datum(**found)
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{file} cannot be read; run locate again, or remove it") from error


def name_in(cell: str) -> str:
    """Return the name in a cell of a table, where bytes that are no UTF-8 are as `open_table` has them."""
    return _BYTE.sub(lambda found: chr(int(found[1], 16)), cell)


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
    """Write records as CSV, at least one; numbers round-trip, NaN and None are empty fields."""
    with open_table(path) as stream:
        write_csv({name: [record[name] for record in records] for name in records[0]}, stream)


def open_table(path: Path) -> TextIO:
    """Open a table to be written; bytes that are no UTF-8, as names may have, appear as \\udcXX."""
    return path.open("w", newline="", encoding="utf-8", errors="backslashreplace")


def write_csv(columns: Mapping[str, Sequence[object]], stream: TextIO) -> None:
    """Write columns under their names."""
    rows = zip(*map(_cells, columns.values()), strict=True)
    bare = csv.writer(stream, lineterminator="\n")
    quoted = csv.writer(stream, lineterminator="\n", quoting=csv.QUOTE_ALL)
    bare.writerow(columns)
    if not any(map(_has_return, columns.values())):
        bare.writerows(rows)
    for row in rows:  # a carriage return ends a line for others, which `csv` forgets
        (quoted if _has_return(row) else bare).writerow(row)


def _has_return(cells: Sequence[object]) -> bool:
    """Return whether one of some texts, beside which there may be other things, has a carriage return."""
    return str in set(map(type, cells)) and any("\r" in str(cell) for cell in cells)


def _cells(values: Sequence[object]) -> Sequence[object]:
    """Return values as `csv` is to write them; itself it writes numbers that round-trip, None as nothing."""
    kinds = set(map(type, values))
    if bool in kinds:
        return [str(value).lower() for value in values]
    if float not in kinds:
        return values
    return ["" if isinstance(value, float) and not math.isfinite(value) else value for value in values]


class Tabled:
    """A result with rows of `cameras` and `pairs`."""

    __slots__ = ()

    @property
    def dimension(self) -> int:
        """Number of coordinates of a location."""
        return 3

    def table(self, name: TableName) -> dict[str, Column]:
        """Return "cameras" or "pairs" as columns, arrays by their names in the CSV; pandas takes them.

        Raises:
            ValueError: if there is no table of this name.
        """
        if name not in _ROW_TYPES:
            raise ValueError(f"there is no table {name!r}; there are 'cameras' and 'pairs'")
        return columns_of(getattr(self, name), _ROW_TYPES[name], self.dimension)


class Stated(Tabled):
    """A result with rows that says of itself what its facts say."""

    __slots__ = ()

    @property
    def verdict(self: Any) -> ModelVerdict:
        """Whether the model can be used, and why."""
        return cast(ModelVerdict, self.facts.verdict)

    @property
    def warnings(self: Any) -> Sequence[str]:
        """What the user should know."""
        return cast(Sequence[str], self.facts.warnings)

    @property
    def timings_s(self: Any) -> Mapping[str, float]:
        """Seconds of each stage."""
        return cast(Mapping[str, float], self.facts.timings_s)


def columns_of(
    rows: Sequence[CameraRow] | Sequence[PairRow], row_type: type[CameraRow] | type[PairRow], dimension: int
) -> dict[str, Column]:
    """Return an array for each column of cameras.csv or pairs.csv, by its name there.

    Returns:
        n values each: numbers are float64, or int64 and bool where none can be missing, NaN where there is
        none; texts are objects.
    """
    kinds = {item.name: item.type for item in (*fields(row_type), *fields(MethodScores))}
    values = _values_of(rows, row_type, dimension)
    return {name: _column(column, kinds.get(name)) for name, column in values.items()}


def _column(values: list[Any], kind: Any) -> Column:
    """Return values of a field's type as an array; those along an axis have no field of their own."""
    if kind is str:
        return np.array(values, dtype=object)
    if kind in (bool, int):
        return np.array(values, dtype=np.bool_ if kind is bool else np.int64)
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)
