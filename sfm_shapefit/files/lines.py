"""What the readers of text formats share: lines of words and numbers, refused by their number."""

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.paths import refuse_irregular_file
from sfm_shapefit.scene.same_images import same_images

_IS_INTEGER = re.compile(r"-?[0-9]{1,40}")  # longer ones are words, for Python does not convert them
_DATABASE = b"SQLite format 3\0"
_MOST_BYTES = 8_000_000_000  # bytes of a text; the graph of a million cameras has one
_SEPARATORS, _FEWEST_SEPARATORS = ";\t", 3  # a table of positions has three or more in a line
_BLOCK_BYTES = 2**20  # bytes that are looked at together; a file that is no text is read no further
UNIT_TOLERANCE = 1e-3
"""Largest error of the length of a quaternion or direction, or of R R^T; a few printed digits pass."""


def _is_huge(path: Path) -> bool:
    """Return whether a file is larger than any text that is read."""
    return path.exists() and path.stat().st_size > _MOST_BYTES


def is_database(path: Path) -> bool:
    """Return whether a path is a file that begins as a database of SQLite does."""
    if not path.is_file():
        return False
    try:
        with path.open("rb") as stream:
            return stream.read(len(_DATABASE)) == _DATABASE
    except OSError:
        return False


def refuse_database(path: Path) -> None:
    """Refuse a database where a model or a text file is wanted.

    Raises:
        InputError: if it is one; it says what takes it.
    """
    if is_database(path):
        raise InputError(
            f"{path} is a database: `sfm-shapefit map`, in Python `map_database`, makes a model of its "
            "matches; give a model's folder here (the database goes by --database, database=, if at all)"
        )


def text_of(file: Path, *, keeps_returns: bool = False) -> str:
    """Return what an ordinary text file holds, without the byte order mark that editors of Windows put first.

    Lines end with \\n alone then, unless the carriage returns are to be kept, which names may have. Bytes
    that are no UTF-8, of names in other encodings, become lone surrogates as Python's own do.

    Raises:
        InputError: if it is none, is missing, cannot be read, or is binary.
    """
    refuse_irregular_file(file)
    refuse_database(file)
    if _is_huge(file):
        raise InputError(f"{file} has more than {_MOST_BYTES / 1e9:g} GB; is it the right file?")
    try:
        data = _bytes_of(file)
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("utf-8-sig", errors="surrogateescape")
        return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text and not keeps_returns else text
    except FileNotFoundError:
        raise InputError(f"{file} does not exist") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{file} is not a readable text file ({error})") from error


def _bytes_of(file: Path) -> bytearray:
    """Return what a text file holds; one with zeros, which no text has, is not read beyond the first."""
    data = bytearray()
    with file.open("rb") as stream:
        while block := stream.read(_BLOCK_BYTES):
            if b"\0" in block:
                raise InputError(f"{file} is not a readable text file: it has binary zeros; save it in UTF-8")
            data += block
    return data


def lines_of_cells(file: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the cells, as of `cells_of`, of each line that is no comment.

    Raises:
        InputError: as `text_of`.
    """
    for number, line in enumerate(text_of(file).splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, cells_of(line)


def cells_of(line: str) -> list[str]:
    """Return the cells of a line, perhaps quoted, between semicolons, tabs, commas or white space.

    Three semicolons or tabs separate, for commas may be those of decimals then.
    """
    for separator in _SEPARATORS:
        if line.count(separator) >= _FEWEST_SEPARATORS and f",{separator}" not in line:
            return _split(line, separator)
    return _split(line, ",") if "," in line else _split(" ".join(line.split()), " ")


def _split(line: str, separator: str) -> list[str]:
    try:
        cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    except csv.Error:  # a cell longer than csv takes
        cells = line.split(separator)
    return [cell.strip() for cell in cells]


def first_words(file: Path) -> list[str]:
    """Return the words of the first line that is not empty, or none if this is no ordinary text file."""
    if not file.is_file() or _is_huge(file):  # a pipe or a device would be read for ever
        return []
    try:
        with file.open("rb") as stream:
            begin = stream.read(_BLOCK_BYTES).decode("utf-8-sig", errors="ignore")
    except OSError:
        return []
    return next((words for line in begin.splitlines() if (words := line.split("#", 1)[0].split())), [])


def first_numbers(file: Path, width: int) -> FloatArray | None:
    """Return what follows two names in the first line that is not empty; None unless it has `width` words."""
    words = first_words(file)
    try:
        values = np.array(words[2:], dtype=np.float64)
    except ValueError:
        return None
    return values if len(words) == width else None


@dataclass(frozen=True, slots=True)
class TextTable:
    """The words of some lines of a file, and the numbers of these lines for messages."""

    file: Path
    numbers: list[int]
    rows: list[list[str]]

    def refuse(self, bad: BoolArray, reason: str) -> None:
        """Raise InputError for the first line that is bad."""
        if bad.any():
            raise InputError(f"{self.file}, line {self.numbers[int(np.argmax(bad))]}: {reason}")

    def values(self, first: int, width: int) -> FloatArray:
        """Return the finite numbers of the columns from `first` on, shape (m, width - first).

        Raises:
            InputError: naming the first line with another number of columns, or a word that is no number.
        """
        for number, row in zip(self.numbers, self.rows, strict=True):
            if len(row) != width:
                raise InputError(f"{self.file}, line {number}: has {len(row)} columns, expected {width}")
        try:
            values = np.array([row[first:] for row in self.rows], dtype=np.float64)
        except ValueError:
            words = ((n, w) for n, row in zip(self.numbers, self.rows, strict=True) for w in row[first:])
            number, word = next((n, w) for n, w in words if not is_number(w))
            raise InputError(f"{self.file}, line {number}: {word!r} is not a number") from None
        self.refuse(np.asarray(~np.isfinite(values).all(axis=1)), "has a number that is not finite")
        return values

    def pairs(self, first: int = 0) -> tuple[tuple[str, ...], IntArray]:
        """Return the names in the two columns from `first` on, in order, and their indices (m, 2)."""
        names, nodes = node_indices([word for row in self.rows for word in row[first : first + 2]])
        return names, nodes.reshape(-1, 2)

    def refuse_no_unit(self, vectors: FloatArray, reason: str) -> None:
        """Raise InputError for the first line whose vector (m, d) is not of length 1."""
        lengths = np.linalg.norm(vectors, axis=1)
        self.refuse(np.asarray(~(np.abs(lengths - 1.0) <= UNIT_TOLERANCE)), reason)


def read_lines(file: Path, form: str) -> TextTable:
    """Return the lines of a text file that are not empty; `#` begins a comment.

    Raises:
        InputError: if the file cannot be read or holds no line; `form` is what one should look like.
    """
    text, numbers, rows = text_of(file), [], []
    for number, line in enumerate(text.splitlines(), start=1):
        if words := line.split("#", 1)[0].split():
            numbers.append(number)
            rows.append(words)
    if not rows:
        what = "has no lines" if text else "is empty, so it has no lines"
        raise InputError(f"{file} {what} of the form {form}; give some")
    return TextTable(file, numbers, rows)


def node_indices(words: Sequence[str]) -> tuple[tuple[str, ...], IntArray]:
    """Return the distinct ids in order, numbers by value, and the index of every word among them."""
    ids = sorted(set(words))
    if all(_IS_INTEGER.fullmatch(word) for word in ids):
        ids.sort(key=int)
    index = {word: k for k, word in enumerate(ids)}
    return tuple(ids), np.fromiter((index[word] for word in words), dtype=np.int64, count=len(words))


def rotations_by_name(
    table: TextTable, column: int, rotations: FloatArray, names: Sequence[str]
) -> tuple[FloatArray, BoolArray]:
    """Return the rotations (n, 3, 3) of names, the identity where a table has none, and (n,) who has one.

    Raises:
        InputError: if the ids in the table's column repeat one, or none is among the names.
    """
    ids = [row[column] for row in table.rows]
    table.refuse(is_repeated(node_indices(ids)[1][:, None]), "gives an earlier camera a second rotation")
    row_of = same_images(names, ids).places
    has_one = row_of >= 0
    if not has_one.any():
        raise InputError(f"{table.file} has a rotation of none of the {len(names)} cameras; check its ids")
    chosen = np.tile(np.eye(3), (len(names), 1, 1))
    chosen[has_one] = rotations[row_of[has_one]]
    return chosen, has_one


def is_repeated(rows: IntArray) -> BoolArray:
    """Return which of (k, c) rows occurred before."""
    repeated = np.ones(len(rows), dtype=np.bool_)
    repeated[np.unique(rows, axis=0, return_index=True)[1]] = False
    return repeated


def is_number(word: str) -> bool:
    """Return whether a word is a number for Python, finite or not."""
    try:
        float(word)
    except ValueError:
        return False
    return True
