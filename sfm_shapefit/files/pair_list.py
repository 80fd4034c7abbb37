"""Lists of image pairs: two names a line, by commas or white space.

A table whose first two columns are the names serves too, as the first lines of a pairs.csv: further columns
are passed over, and so is a header "name1,name2,...". Lines that begin with # are comments.
"""

from collections.abc import Collection
from pathlib import Path

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.lines import lines_of_cells
from sfm_shapefit.scene.matches import PairNames
from sfm_shapefit.scene.same_images import names_among

_HEADER = ["name1", "name2"]


def read_pair_list(path: Path, known: Collection[str]) -> PairNames:
    """Return the pairs that a file lists.

    Args:
        path: the file.
        known: names of all images.

    Raises:
        InputError: if the file cannot be read, lists no pair, or a line is malformed or names no image; it
            is named by its number.
    """
    lines, pairs = list(lines_of_cells(path)), set()
    named, ambiguity = names_among({name for _, cells in lines for name in cells[:2]}, sorted(known))
    for number, cells in lines:
        if cells[:2] == _HEADER:
            continue
        if len(cells) < 2:
            raise InputError(f"{path}, line {number}: expected the names of two images")
        unknown = [name for name in cells[:2] if name not in named]
        if unknown:
            why = f"; {ambiguity}" if ambiguity else ""
            raise InputError(f"{path}, line {number}: there is no image {unknown[0]!r}{why}")
        first, second = sorted(named[name] for name in cells[:2])
        if first == second:
            raise InputError(f"{path}, line {number}: {first} makes no pair with itself")
        pairs.add((first, second))
    if not pairs:
        raise InputError(f"{path} lists no pair; give the names of two images per line")
    return frozenset(pairs)
