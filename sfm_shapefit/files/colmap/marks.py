"""Marks: where images show points that the user knows something of; read from lists, and looked at.

A list has a line for each mark: numbers that are known of the point, the pixels, counted from the upper left
corner of the picture, the image, and names.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import tangent_bases
from sfm_shapefit.base.wording import first_of
from sfm_shapefit.files.colmap.lenses import rays_of
from sfm_shapefit.files.colmap.position_table import LARGEST
from sfm_shapefit.files.lines import is_number, text_of
from sfm_shapefit.scene.given import MarkedViews, Marks
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.same_images import same_images

_CHECK_PREFIX, _CHECK_WORD = "chk-", "check"
_OUTSIDE_PX = 1.0  # pixels beyond the edge of a picture; programs count from the middle or edge of a pixel


class Mark(NamedTuple):
    """A line of the list."""

    number: int
    typed: tuple[str, ...]
    """What is known of the point, in words of the list."""
    pixel: tuple[float, float]
    image: str
    names: tuple[str, ...]
    """What is named after the image."""

    @property
    def known(self) -> tuple[float, ...]:
        """What is known of the point."""
        return tuple(map(float, self.typed))

    @property
    def is_check(self) -> bool:
        """Whether the point, or what it is part of, only checks the model."""
        words = [name.lower() for name in self.names]
        return bool(words) and (words[0].startswith(_CHECK_PREFIX) or _CHECK_WORD in words[1:])


def lines_of(path: Path) -> list[tuple[int, str]]:
    """Return the lines of a list with their numbers, without empty ones and comments."""
    numbered = enumerate(text_of(path).splitlines(), start=1)
    return [(k, line) for k, line in numbered if line.strip() and not line.lstrip().startswith("#")]


def read_marks(
    path: Path, lines: Sequence[tuple[int, str]], count: int, names: int, expected: str
) -> list[Mark]:
    """Read lines of so many known numbers, and so many names after the image.

    Raises:
        InputError: if a line is malformed; `expected` says what it is made of.
    """
    marks, least = [], count + 3 + names
    for number, line in lines:
        by_tabs = line.count("\t") >= least - 1
        cells = [cell.strip() for cell in (line.split("\t") if by_tabs else line.split())]
        numbers = cells[: count + 2]
        if len(cells) < least or not all(map(is_number, numbers)):
            raise InputError(f"{path}, line {number}: expected {expected}")
        values = np.array([float(cell) for cell in numbers])
        if not (np.abs(values) <= LARGEST).all():
            raise InputError(f"{path}, line {number}: numbers must be finite, and all of them known")
        u, v = values[count:].tolist()
        marks.append(Mark(number, tuple(cells[:count]), (u, v), cells[count + 2], tuple(cells[count + 3 :])))
    return marks


def marks_in(
    path: Path, images: Images, marks: Sequence[tuple[str, Mark]], points: Sequence[str] = ()
) -> tuple[Marks, dict[str, Mark]]:
    """Return the marks in images of a model, and the first mark of each point.

    Args:
        path, images: of the list, and of the model.
        marks: point and mark of each line.
        points: names of all points; of those with a mark in the model, ascending, if there are none.

    Raises:
        InputError: if no image is one of the model's, an image shows a point twice, or a mark lies outside
            its picture.
    """
    named = list(dict.fromkeys(mark.image for _, mark in marks))
    shown = same_images(named, images.names)
    index_of = {name: k for name, k in zip(named, shown.places.tolist(), strict=True) if k >= 0}
    used = [(point, mark) for point, mark in marks if mark.image in index_of]
    if not used:
        why = f" ({shown.ambiguity})" if shown.ambiguity else ""
        raise InputError(f"{path} has no mark in an image of the model, such as {images.names[0]}{why}")
    for fault in _faults(images, marks, index_of):
        raise InputError(f"{path}, {fault}")
    names = points or sorted({point for point, _ in used})
    place = {name: k for k, name in enumerate(names)}
    used.sort(key=lambda one: (place[one[0]], index_of[one[1].image]))
    lost, absent = len(marks) - len(used), tuple(name for name in named if name not in index_of)
    lacking = f", without {lost} of {len(marks)} marks, whose images the model lacks ({first_of(absent)})"
    known = Marks(
        names=tuple(names),
        points=np.array([place[point] for point, _ in used], dtype=np.int64),
        images=np.array([index_of[mark.image] for _, mark in used], dtype=np.int64),
        pixels=np.array([mark.pixel for _, mark in used]),
        statement=lacking if lost else "",
        absent=absent,
    )
    return known, dict(reversed(used))


def _faults(images: Images, marks: Sequence[tuple[str, Mark]], index_of: dict[str, int]) -> Iterator[str]:
    """Yield what is wrong with a mark among all of the list, a clause that begins with its line."""
    seen: set[tuple[str, str]] = set()
    for point, mark in marks:
        named = point.replace("\t", " ")  # the end of a bar
        if (point, mark.image) in seen:
            yield f"line {mark.number}: {named} is marked twice in {mark.image}; keep one of its marks"
        seen.add((point, mark.image))
        lens = images.lenses[images.lens_of[index_of[mark.image]]] if mark.image in index_of else None
        if lens is None or not (lens.width and lens.height):
            continue
        if any(
            not -_OUTSIDE_PX <= x <= size + _OUTSIDE_PX
            for x, size in zip(mark.pixel, (lens.width, lens.height), strict=True)
        ):
            at = "({:g}, {:g})".format(*mark.pixel)
            yield (
                f"line {mark.number}: the mark of {named}, {at}, is outside {mark.image}, a picture of "
                f"{lens.width} x {lens.height} pixels; count them from its upper left corner"
            )


def look_at_marks(images: Images, known: Marks) -> MarkedViews:
    """Return the views that the placed ones of images have of marks."""
    rows = np.flatnonzero(images.is_posed[known.images])
    of, rotations = known.images[rows], images.rotations[known.images[rows]]
    on_plane = np.full((len(rows), 2), np.nan)
    for k, row in enumerate(rows.tolist()):
        lens = images.lenses[images.lens_of[of[k]]]
        ray = rays_of(lens, known.pixels[row : row + 1])[0]
        if lens.is_panorama or ray[2] <= 0.0:
            across = tangent_bases(ray[None])[0, :, 0]
            turn = np.stack([across, np.cross(ray, across), ray])
            rotations[k], ray = turn @ rotations[k], turn @ ray
        if ray[2] > 0.0:
            on_plane[k] = ray[:2] / ray[2]
    return MarkedViews(
        rotations=rotations,
        centers=images.centers[of],
        focal_lengths_px=images.focal_lengths_px[of],
        rows=rows,
        images=of,
        on_plane=on_plane,
    )
