"""Which images the entries of a list of poses are of: by names of other programs, or by numbers, as of time.

Numbers are compared by their digits: double precision cannot tell nanoseconds since 1970 apart.
"""

import itertools
import re
from bisect import bisect_left
from collections import Counter
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path, PurePosixPath

import numpy as np

from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.scene.same_images import same_images

NUMBER = re.compile(r"[0-9]+(?:\.[0-9]+)?$")
"""The number at the end of a name without suffix."""
_FOLDER = re.compile(r"[/\\]")
_UNITS = [Decimal(10) ** k for k in (0, 9, -9, 6, -6, 3, -3)]
"""Units in which numbers may be listed, by those of names."""
_DOUBLE = Decimal(2) ** -52  # relative error of a number; double precision has no more
_FRACTION = -4  # exponent of a last digit; numbers that end before it are exact, others rounded there


def find_images(file: Path, listed: Sequence[str], names: Sequence[str]) -> IntArray:
    """Return which image (n,) each name of a list is of; -1 where none, or not one alone.

    By the name but for folders, else by the last part without suffix, else by the number that it is.

    Raises:
        InputError: if two names are of one image.
    """
    places = same_images(listed, names).places
    for match in (_by_stems, _by_numbers):
        left = np.flatnonzero(places < 0).tolist()
        units = _UNITS if len(left) == len(listed) else _UNITS[:1]
        if left:
            rows, taken = match([listed[k] for k in left], names, units), set(places.tolist())
            whole = [_FOLDER.search(listed[k]) is not None for k in left]  # which may be another folder's
            places[left] = [-1 if own and row in taken else row for own, row in zip(whole, rows, strict=True)]
    for row, count in Counter(places[places >= 0].tolist()).items():
        if count > 1:
            first, second = (listed[k] for k in np.flatnonzero(places == row)[:2].tolist())
            raise InputError(
                f"{file}: {first} and {second} are both the image {names[row]}; keep one of them"
            )
    return places


def named_as(file: Path, listed: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of a list, those of images by the names that these have elsewhere."""
    rows = find_images(file, listed, names).tolist()
    return tuple(name if row < 0 else names[row] for name, row in zip(listed, rows, strict=True))


def _by_stems(listed: Sequence[str], names: Sequence[str], _: Sequence[Decimal]) -> list[int]:
    """Return which image each listed name is of by the last part without suffix, where no other has that."""
    stems = [stem_of(name) for name in names]
    counts = Counter(stems)
    row_of = {stem: row for row, stem in enumerate(stems) if counts[stem] == 1}
    return [row_of.get(stem_of(name), -1) for name in listed]


def _by_numbers(listed: Sequence[str], names: Sequence[str], units: Sequence[Decimal]) -> list[int]:
    """Return which image each listed number is of, by the numbers that names end with, if no two are equal.

    The units (seconds, where names have nanoseconds) are those in which most numbers are an image's.
    """
    numbers = [number_of(name) for name in names]
    row_of = {number: row for row, number in enumerate(numbers) if number is not None}
    if len(row_of) < len(numbers) - numbers.count(None):
        return [-1] * len(listed)
    wanted, ordered = [number_of(name, alone=True) for name in listed], sorted(row_of)
    nearest = ([None if one is None else _nearest(one, unit, ordered) for one in wanted] for unit in units)
    most = max(nearest, key=lambda some: len(some) - some.count(None))
    return [-1 if number is None else row_of[number] for number in most]


def _nearest(number: Decimal, unit: Decimal, ordered: Sequence[Decimal]) -> Decimal | None:
    """Return which of some numbers one in other units is, exactly or else, alone, as far as its digits go.

    Digits beyond double precision are none, and whole numbers are exact.
    """
    exponent = int(number.as_tuple().exponent)
    slack = max(number * _DOUBLE, Decimal(5).scaleb(exponent - 1) if exponent <= _FRACTION else Decimal(0))
    k = bisect_left(ordered, (number - slack) * unit)
    near = list(itertools.takewhile(lambda one: one <= (number + slack) * unit, ordered[k:]))
    exact = [one for one in near if one == number * unit]
    return exact[0] if exact else near[0] if len(near) == 1 else None


def number_of(name: str, *, alone: bool = False) -> Decimal | None:
    """Return the number that the name of an image ends with, or is `alone`, without folders and suffix."""
    match = (NUMBER.fullmatch if alone else NUMBER.search)(stem_of(name))
    return None if match is None else Decimal(match[0])


def stem_of(name: str) -> str:
    """Return a name without folders and suffix; a number keeps what follows its point."""
    last = PurePosixPath(name.replace("\\", "/"))
    return last.name if last.suffix[1:].isdigit() else last.stem
