"""What `locate` found as tables: one row per camera and one per pair, as CSV and as columns of arrays.

`cameras.csv` and `pairs.csv` are part of the interface: columns may be added, never renamed.
"""

import csv
import io
import itertools
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import Field, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, TextIO, TypeVar, cast, get_args, overload

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import BoolArray
from sfm_shapefit.base.atomic_folder import MARKER
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.facts.control_points import control_columns
from sfm_shapefit.files.lines import text_of
from sfm_shapefit.judgement.limits import KNOWN_DEG
from sfm_shapefit.judgement.reasons import ModelVerdict
from sfm_shapefit.judgement.verdicts import Verdict
from sfm_shapefit.pairs.pair_directions import DirectionStatus
from sfm_shapefit.scene.given import EarthDatum

TableName = Literal["cameras", "pairs", "control_points"]
Column = npt.NDArray[Any]
_QUOTED = '",\r\n'
"""Signs that make a cell stand in quotes."""
_ROWS_AT_ONCE = 10_000  # rows that are made texts together; those of pairs take 10 MB
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
    """Distance of its center from its position prior, in the prior's units; after the similarity that brings
    most near, where priors do not set origin and axes."""


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


R = TypeVar("R", bound=CameraRow | PairRow)
_PREFIXES = {"center": "", "sigma": "sigma_", "direction": "v", "correlation": "rho_"}
"""Beginning of the columns of a vector, one per axis, or per two axes."""


_KINDS: dict[Any, npt.DTypeLike] = {str: object, bool: np.bool_, int: np.int64, int | None: object}
"""Types of columns by those of the fields; floats and vectors are float64."""


def _fields_of(kind: type) -> Iterator[Field[Any]]:
    """Yield the fields of a row that are columns: its scores are columns under their own names."""
    for item in fields(kind):
        yield from fields(MethodScores) if item.name == "scores" else (item,)


class Table(Sequence[R]):
    """The rows of a table, kept as columns; a row is made when it is asked for."""

    def __init__(self, kind: type[R], dimension: int, columns: Mapping[str, Any]) -> None:
        """Take columns by the fields of a row, n values each, or (n, d) of vectors with NaN where unknown.

        The first column is given; others that are not have the default of their field.
        """
        self.kind, self.dimension = kind, dimension
        self.columns: dict[str, Column] = {}
        for item in _fields_of(kind):
            width = len(columns_of_field(item.name, dimension)) if item.name in _PREFIXES else 0
            default = item.default if not width else (math.nan,) * width
            values = columns[item.name] if item.name in columns else [default] * len(self)
            shape = (-1, width) if width else (-1,)
            self.columns[item.name] = np.asarray(values, _KINDS.get(item.type, np.float64)).reshape(shape)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def __repr__(self) -> str:
        return f"<{len(self)} rows of {self.kind.__name__}>"

    @overload
    def __getitem__(self, at: int) -> R: ...
    @overload
    def __getitem__(self, at: slice) -> list[R]: ...
    def __getitem__(self, at: int | slice) -> R | list[R]:
        if isinstance(at, slice):
            return [self[k] for k in range(len(self))[at]]
        cells = {name: _cell(values[at]) for name, values in self.columns.items()}
        if self.kind is PairRow:
            scores = {item.name: cells.pop(item.name) for item in fields(MethodScores)}
            cells["scores"] = MethodScores(**scores)
        return self.kind(**cells)

    def taken(self, rows: Sequence[int]) -> "Table[R]":
        """Return some of the rows."""
        picked = list(rows)
        return self.changed({name: values[picked] for name, values in self.columns.items()})

    def changed(self, columns: Mapping[str, Any]) -> "Table[R]":
        """Return the rows with other columns in place of some."""
        return Table(self.kind, self.dimension, self.columns | dict(columns))

    def followed_by(self, more: "Table[R]") -> "Table[R]":
        """Return these rows, and then others."""
        own = self.columns.items()
        return self.changed({name: np.concatenate([values, more.columns[name]]) for name, values in own})

    def flat(self) -> dict[str, Column]:
        """Return the columns of the CSV by their names there, (n,) each."""
        found: dict[str, Column] = {}
        for name, values in self.columns.items():
            names = columns_of_field(name, self.dimension)
            found |= {name: values} if values.ndim == 1 else dict(zip(names, values.T, strict=True))
        return found


def _cell(value: Any) -> Any:
    """Return a value of a column as Python has it; a vector of which nothing is known is empty."""
    if isinstance(value, np.ndarray):
        return () if np.isnan(value).all() else tuple(value.tolist())
    return value.item() if isinstance(value, np.generic) else value


def write_rows(rows: Table[R], path: Path) -> None:
    """Write rows as CSV; a vector of d numbers becomes d columns, one per axis."""
    with open_table(path) as stream:
        write_csv(rows.flat(), stream)


def contradicting(pairs: Table[PairRow]) -> BoolArray:
    """Return which pairs (m,) say that their cameras stand elsewhere; by less than a degree they do not."""
    known_deg = pairs.columns["residual_deg"] < KNOWN_DEG
    return np.asarray((pairs.columns["verdict"] == Verdict.OUTLIER.value) & ~known_deg)


def rejected(pairs: Table[PairRow]) -> BoolArray:
    """Return which pairs (m,) have no direction because most of their matches contradict the rotations."""
    return np.asarray(pairs.columns["reason"] == DirectionStatus.LOW_INLIER_RATIO.value)


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


def model_datum(model: Any) -> EarthDatum | None:
    """Return the datum of a result, or that in locate.json beside a model; None without."""
    datum: EarthDatum | None = told_of(model, "datum", lambda found: EarthDatum(**found))
    return datum


def model_scale_sigma(model: Any) -> float | None:
    """Return the relative standard deviation of the scale of a result or model, likewise."""
    sigma: float | None = told_of(model, "scale_sigma", float)
    return sigma


def model_doubt(model: Any) -> str:
    """Return the verdict on a result or model, likewise, where it is not good; else an empty text."""
    if isinstance(model, Path | str):
        statement = told_of(model, "verdict", lambda found: found.get("statement"))
    else:
        statement = getattr(getattr(model, "verdict", None), "statement", None)
    return "" if statement in (None, "good") else str(statement)


def model_options(model: Any) -> dict[str, Any]:
    """Return the options with which a result or model was made, likewise; none of another program's."""
    with suppress(InputError):  # which may have a locate.json of its own
        return told_of(model, "options", dict) or {}
    return {}


def told_of(model: Any, name: str, read: Callable[[Any], Any]) -> Any:
    """Return a figure of a result, or that in locate.json beside a model, read as it stands there."""
    if not isinstance(model, Path | str):  # the largest model of `map` stands for all
        every = (getattr(one, "facts", None) for one in (*getattr(model, "models", ()), model))
        return next((getattr(facts, name) for facts in every if hasattr(facts, name)), None)
    file = Path(model) / MARKER
    if not file.is_file():
        return None
    try:
        found = json.loads(text_of(file)).get(name)
        return None if found is None else read(found)
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


def write_csv(columns: Mapping[str, Sequence[object] | Column], stream: TextIO) -> None:
    """Write columns under their names; numbers round-trip, None and numbers that are not finite are empty."""
    bare = csv.writer(stream, lineterminator="\n")
    quoted = csv.writer(stream, lineterminator="\n", quoting=csv.QUOTE_ALL)
    bare.writerow(columns)
    for first in range(0, max(map(len, columns.values())), _ROWS_AT_ONCE):
        cells = [_cells(values[first : first + _ROWS_AT_ONCE]) for values in columns.values()]
        rows, words = zip(*cells, strict=True), "".join(map("".join, cells))
        if len(columns) > 1 and not any(sign in words for sign in _QUOTED):
            stream.write("\n".join(map(",".join, rows)) + "\n")
            continue
        for row in rows:  # a carriage return ends a line for others, which `csv` forgets
            (quoted if any("\r" in text for text in row) else bare).writerow(row)


def _cells(values: Sequence[object] | Column) -> list[str]:
    """Return values as texts; those of Python round-trip."""
    if isinstance(values, np.ndarray) and values.dtype == np.float64:
        is_known = np.isfinite(values)
        if not is_known.any():
            return [""] * len(values)
        texts = list(map(repr, values.tolist()))
        for row in np.flatnonzero(~is_known).tolist():
            texts[row] = ""
        return texts
    plain: list[Any] = values.tolist() if isinstance(values, np.ndarray) else list(values)
    kinds = set(map(type, plain))
    if kinds <= {str}:
        return plain
    if bool in kinds:
        return [str(value).lower() for value in plain]
    unknown = (value is None or (isinstance(value, float) and not math.isfinite(value)) for value in plain)
    return ["" if is_so else str(value) for value, is_so in zip(plain, unknown, strict=True)]


class Tabled:
    """A result with rows of `cameras` and `pairs`, and of `control_points` if it may be brought to some."""

    __slots__ = ()

    def table(self: Any, name: TableName) -> dict[str, Column]:
        """Return "cameras", "pairs" or "control_points" as columns, arrays by name; pandas takes them.

        Names are those in the CSV; of control points, those in locate.json, a column per axis.

        Raises:
            ValueError: if there is no table of this name.
        """
        tables = [one for one in get_args(TableName) if hasattr(self, one)]
        if name not in tables:
            raise ValueError(f"there is no table {name!r}, only {', '.join(map(repr, tables))}")
        if name == "control_points":
            return control_columns(self.control_points)
        columns = getattr(self, name).flat()
        if name == "cameras":  # where it is none, NaN
            columns["piece"] = columns["piece"].astype(np.float64)
        return dict(columns)


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
