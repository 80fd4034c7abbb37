"""Files of other programs: so far bare view graphs as text.

A graph file has one pair per line,

    i j v1 v2 ... vd [weight]        # comments and empty lines are skipped

with the unit direction of t_i - t_j (it points from j to i). Node ids are words; they need not be
numbers, nor contiguous. All lines have the same number of columns. The last column is a weight if it is
positive and the columns before it are unit vectors, in every line; otherwise it belongs to the direction.
"""

import re
import stat
from pathlib import Path

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.errors import InputError
from sfm_shapefit.viewgraph import ViewGraph

_UNIT_TOLERANCE = 1e-4  # directions printed with 5 digits
_ROUNDED = 1e-7
_LARGEST_WEIGHT = 1e30  # sums of squares of products of weights must not overflow
_IS_INTEGER = re.compile(r"-?[0-9]{1,40}")  # longer ones are words: Python refuses to convert very long ones
_MIN_COLUMNS = 4  # two ids and a direction in the plane


def refuse_irregular_file(path: Path) -> None:
    """Refuse what is neither a file nor missing: reading a pipe waits for ever, and a device may have no end.

    Raises:
        InputError: if `path` is, or links to, a folder, a pipe, a socket or a device.
    """
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return  # whoever opens it says why it cannot be read
    if stat.S_ISDIR(mode):
        raise InputError(f"{path} cannot be read: Is a directory")
    if not stat.S_ISREG(mode):
        raise InputError(f"{path} cannot be read: it is a pipe or a device; give an ordinary file")


def read_graph(path: Path | str) -> ViewGraph:
    """Read a bare view graph; the ids become its names, numbers in numerical order, else alphabetically.

    Directions are normalised; a pair that stands twice is merged (see `ViewGraph`).

    Raises:
        InputError: if the file cannot be read, naming the first malformed line by its number.
    """
    file = Path(path)
    refuse_irregular_file(file)
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file} is not a readable text file ({error})") from error
    numbers, rows = [], []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if words:
            numbers.append(number)
            rows.append(words)
    if not rows:
        raise InputError(f"{file} has no pairs; give lines of the form: i j vx vy vz [weight]")
    values = _values(file, numbers, rows)
    with np.errstate(over="ignore"):  # a length that overflows is no unit length
        directions, weights = _directions_and_weights(values)
        lengths = np.linalg.norm(directions, axis=1)
    ids, nodes = _nodes([word for row in rows for word in row[:2]])
    edges = nodes.reshape(-1, 2)

    _refuse(file, numbers, edges[:, 0] == edges[:, 1], "joins a node with itself")
    _refuse(file, numbers, ~(np.abs(lengths - 1.0) <= _UNIT_TOLERANCE), "has no unit direction")
    _refuse(file, numbers, ~(weights > 0.0), "has a weight that is not positive")
    extreme = (weights < 1.0 / _LARGEST_WEIGHT) | (weights > _LARGEST_WEIGHT)
    _refuse(file, numbers, extreme, f"has a weight beyond 1 / {_LARGEST_WEIGHT:g} to {_LARGEST_WEIGHT:g}")
    rounded = np.abs(lengths - 1.0) > _ROUNDED  # printed with few digits; ViewGraph sees to the rest
    directions = np.where(rounded[:, None], directions / lengths[:, None], directions)
    try:
        return ViewGraph(len(ids), edges, directions, weights, ids)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error


def graph_text(graph: ViewGraph) -> str:
    """Return a view graph in the text format that `read_graph` takes; numbers round-trip."""
    ids = graph.names or tuple(str(k) for k in range(graph.num_cameras))
    weighted = bool(np.any(graph.weights != 1.0))
    lines = []
    for (i, j), v, weight in zip(
        graph.edges.tolist(), graph.directions.tolist(), graph.weights.tolist(), strict=True
    ):
        numbers = [*v, weight] if weighted else v
        lines.append(" ".join([ids[i], ids[j], *map(repr, numbers)]))
    return "\n".join(lines) + "\n"


def _values(file: Path, numbers: list[int], rows: list[list[str]]) -> FloatArray:
    """Return the numbers behind the two ids of every line, shape (m, columns - 2)."""
    width = len(rows[0])
    if width < _MIN_COLUMNS:
        raise InputError(f"{file}, line {numbers[0]}: expected i j and a direction, got {width} columns")
    for number, row in zip(numbers, rows, strict=True):
        if len(row) != width:
            raise InputError(
                f"{file}, line {number}: has {len(row)} columns, line {numbers[0]} has {width}; "
                "give every line the same columns"
            )
    try:
        values = np.array([row[2:] for row in rows], dtype=np.float64)
    except ValueError:
        number, word = next(
            (n, w) for n, row in zip(numbers, rows, strict=True) for w in row[2:] if not _is_number(w)
        )
        raise InputError(f"{file}, line {number}: {word!r} is not a number") from None
    _refuse(file, numbers, np.asarray(~np.isfinite(values).all(axis=1)), "has a number that is not finite")
    return values


def _directions_and_weights(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Tell whether the last column is a weight, and split it off if it is."""
    head, last = values[:, :-1], values[:, -1]
    if head.shape[1] >= _MIN_COLUMNS - 2:
        is_unit = np.abs(np.linalg.norm(head, axis=1) - 1.0) <= _UNIT_TOLERANCE
        if bool(np.all(is_unit)) and not np.all(last == 0.0):
            return head, last
    return values, np.ones(len(values))


def _nodes(words: list[str]) -> tuple[list[str], IntArray]:
    """Return the distinct ids in order, and the index of every word among them."""
    distinct = set(words)
    if all(_IS_INTEGER.fullmatch(word) for word in distinct):
        ids = sorted(distinct, key=lambda word: (int(word), word))
    else:
        ids = sorted(distinct)
    index = {word: k for k, word in enumerate(ids)}
    return ids, np.fromiter((index[word] for word in words), dtype=np.int64, count=len(words))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _refuse(file: Path, numbers: list[int], bad: BoolArray, reason: str) -> None:
    """Raise InputError for the first line that is bad."""
    if bad.any():
        raise InputError(f"{file}, line {numbers[int(np.argmax(bad))]}: {reason}")
