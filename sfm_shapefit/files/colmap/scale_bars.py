"""Scale bars from a file: a known length between two points, each marked in images.

A line is a mark of one end, as a line of a list of control points is one of a point:

    1.0004 0.0001 3044 2622 a.jpg bar1 left           length and its standard deviation, pixels, image,
    1.0004 0.0001 1606 2763 b.jpg bar1 left           name of the bar, and which end it is
    1.0004 0.0001 3311 2590 a.jpg bar1 right

A bar whose name begins with CHK-, or after whose end stands "check", only checks the model.
"""

from pathlib import Path

import numpy as np

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.wording import counted
from sfm_shapefit.files.colmap.marks import Mark, lines_of, marks_in, read_marks
from sfm_shapefit.files.colmap.position_table import LARGEST
from sfm_shapefit.scene.given import ScaleBars
from sfm_shapefit.scene.images import Images

_LINE = (
    "the length of a bar, its standard deviation, two pixel coordinates, the name of an image, that of the "
    "bar, and which end it is"
)


def read_scale_bars(path: Path, images: Images) -> ScaleBars:
    """Read scale bars, a line for each mark of an end in an image; see the header.

    Marks in images that the model lacks are passed over.

    Raises:
        InputError: if the file cannot be read, a line is malformed or contradicts an earlier one, a bar has
            not two ends that are each marked in two images, a mark lies outside its picture, or none is in
            an image of the model.
    """
    marks = read_marks(path, lines_of(path), 2, 2, _LINE)
    if not marks:
        raise InputError(f"{path} has no scale bar; a line is {_LINE}")
    bars: dict[str, list[Mark]] = {}
    for mark in marks:
        _refuse_contradiction(path, mark, bars.setdefault(mark.names[0], [mark])[0])
        bars[mark.names[0]].append(mark)
    # A tab parts bar and end, since both may hold blanks, and neither a tab.
    ends = [f"{name}\t{end}" for name, own in bars.items() for end in _ends_of(path, name, own[1:])]
    known, _ = marks_in(path, images, [("\t".join(mark.names[:2]), mark) for mark in marks], ends)
    first = [own[0] for own in bars.values()]
    return ScaleBars(
        names=known.names,
        points=known.points,
        images=known.images,
        pixels=known.pixels,
        statement=f"{len(bars)} bars of {path}{known.statement}",
        bars=tuple(bars),
        lengths=np.array([mark.known[0] for mark in first]),
        sigmas=np.array([mark.known[1] for mark in first]),
        is_check=np.array([mark.is_check for mark in first], dtype=np.bool_),
        places=tuple(f"{path}, line {mark.number}" for mark in first),
    )


def _refuse_contradiction(path: Path, mark: Mark, first: Mark) -> None:
    """Refuse a mark whose length is none, or is not that of the first mark of its bar."""
    (length, sigma), where = mark.known, f"{path}, line {mark.number}: "
    if not 1.0 / LARGEST <= sigma < length:
        raise InputError(
            f"{where}a bar has a length above 0, and a standard deviation above {1.0 / LARGEST:g} and below "
            f"the length, in the output's units; got {length:g} and {sigma:g}"
        )
    if mark.known != first.known or mark.is_check != first.is_check:
        what = "other numbers" if mark.known != first.known else "another role"
        raise InputError(
            f"{where}{mark.names[0]} has {what} than in line {first.number}; repeat length, standard "
            'deviation and "check" in each line of a bar'
        )


def _ends_of(path: Path, bar: str, marks: list[Mark]) -> list[str]:
    """Return the names of the two ends of a bar, each of them marked in two images or more."""
    marked: dict[str, list[Mark]] = {}
    for mark in marks:
        marked.setdefault(mark.names[1], []).append(mark)
    if len(marked) != 2:
        ends = f"{counted(len(marked), 'end')}, {', '.join(marked)}"
        raise InputError(
            f"{path}, line {marks[0].number}: {bar} has {ends}; a scale bar has two, told apart by the word "
            "after its name; tabs part words that hold blanks"
        )
    for end, own in marked.items():
        if len({mark.image for mark in own}) < 2:
            where = f"{path}, line {own[0].number}"
            raise InputError(f"{where}: the end {end} of {bar} is marked in one image; mark it in another")
    return list(marked)
