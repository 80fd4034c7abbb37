"""What the readers of text formats share: lines of words and numbers, refused by their number."""

import re
import stat
from pathlib import Path

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.errors import InputError

# Longer numbers are words: Python refuses to convert very long ones.
_IS_INTEGER = re.compile(r"-?[0-9]{1,40}")


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


def text_of(file: Path) -> str:
    """Return what an ordinary text file holds.

    Raises:
        InputError: if it is none, is missing, cannot be read, or is no UTF-8.
    """
    refuse_irregular_file(file)
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise InputError(f"{file} is not a readable text file ({error})") from error


def first_words(file: Path) -> list[str]:
    """Return the words of the first line that is not empty, or none if this is no ordinary text file."""
    if not file.is_file():  # a pipe or a device would be read for ever
        return []
    try:
        with file.open(encoding="utf-8") as stream:
            return next((words for line in stream if (words := line.split("#", 1)[0].split())), [])
    except (OSError, ValueError):
        return []


def read_lines(file: Path, form: str) -> tuple[list[int], list[list[str]]]:
    """Return the numbers and the words of the lines that are not empty; `#` begins a comment.

    Args:
        file: a text file.
        form: what its lines should look like, for the message.

    Raises:
        InputError: if the file cannot be read or holds nothing.
    """
    numbers, rows = [], []
    for number, line in enumerate(text_of(file).splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if words:
            numbers.append(number)
            rows.append(words)
    if not rows:
        raise InputError(f"{file} has no lines of the form {form}; give some")
    return numbers, rows


def number_table(
    file: Path, numbers: list[int], rows: list[list[str]], *, first: int, width: int
) -> FloatArray:
    """Return the finite numbers of the columns from `first` on, shape (m, width - first).

    Raises:
        InputError: naming the first line that has another number of columns, or a word that is no number.
    """
    for number, row in zip(numbers, rows, strict=True):
        if len(row) != width:
            raise InputError(f"{file}, line {number}: has {len(row)} columns, expected {width}")
    try:
        values = np.array([row[first:] for row in rows], dtype=np.float64)
    except ValueError:
        number, word = next(
            (n, w) for n, row in zip(numbers, rows, strict=True) for w in row[first:] if not _is_number(w)
        )
        raise InputError(f"{file}, line {number}: {word!r} is not a number") from None
    refuse(file, numbers, np.asarray(~np.isfinite(values).all(axis=1)), "has a number that is not finite")
    return values


def node_indices(words: list[str]) -> tuple[list[str], IntArray]:
    """Return the distinct ids in order, numbers by value, and the index of every word among them."""
    distinct = set(words)
    if all(_IS_INTEGER.fullmatch(word) for word in distinct):
        ids = sorted(distinct, key=lambda word: (int(word), word))
    else:
        ids = sorted(distinct)
    index = {word: k for k, word in enumerate(ids)}
    return ids, np.fromiter((index[word] for word in words), dtype=np.int64, count=len(words))


def refuse(file: Path, numbers: list[int], bad: BoolArray, reason: str) -> None:
    """Raise InputError for the first line that is bad."""
    if bad.any():
        raise InputError(f"{file}, line {numbers[int(np.argmax(bad))]}: {reason}")


def is_repeated(rows: IntArray) -> BoolArray:
    """Return which of (k, c) rows occurred before."""
    found = np.ones(len(rows), dtype=np.bool_)
    found[np.unique(rows, axis=0, return_index=True)[1]] = False
    return found


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
