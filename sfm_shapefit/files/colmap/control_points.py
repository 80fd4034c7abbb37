"""Ground control points from a file, and where the images of a model look at their marks.

The file is OpenDroneMap's gcp_list.txt:

    WGS84 UTM 32N                                     the projection of the coordinates
    481367.1 5782936.2 100.3 3044 2622 a.jpg P1       x y z, pixels, image, name of the point
    481367.1 5782936.2 100.3 1606 2763 b.jpg P1

Coordinates on the WGS84 ellipsoid, and of the zones of UTM on it, become meters east, north and up of their
median. Nothing else is converted.

Source: https://docs.opendronemap.org/gcp/ (the format; geographic coordinates are longitude, then latitude).
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import tangent_bases
from sfm_shapefit.files.colmap.geodesy import datum_of, enu_of, projection_named
from sfm_shapefit.files.colmap.lenses import rays_of
from sfm_shapefit.files.lines import is_number, text_of
from sfm_shapefit.scene.given import ControlPoints, MarkedViews
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.same_images import same_images

_LARGEST = 1e30  # units; squares of squares of larger coordinates overflow
_CHECK_PREFIX, _CHECK_WORD = "chk-", "check"
_LINE = "x y z, two pixel coordinates, the name of an image, and perhaps that of the point"


class _Mark(NamedTuple):
    number: int
    position: tuple[float, float, float]
    pixel: tuple[float, float]
    image: str
    point: str
    is_check: bool


def read_control_points(path: Path, images: Images) -> ControlPoints:
    """Read a gcp_list.txt: a line that names the projection, then one line per mark of a point in an image.

    The projection is WGS84 (longitude, latitude, altitude), one of its zones of UTM, or "local" for axes that
    are metric as they are. Points without a name are told apart by their coordinates. A point whose name
    begins with CHK-, or after whose name stands "check", only checks the model. Marks in images that the
    model lacks are passed over.

    Raises:
        InputError: if the file cannot be read, its projection is another, a line is malformed or contradicts
            an earlier one, no image is one of the model's, or the points cannot tell scale and axes.
    """
    lines = [
        (number, line)
        for number, line in enumerate(text_of(path).splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        raise InputError(f"{path} is empty; its first line is the projection, then a line is {_LINE}")
    try:
        project = projection_named(lines[0][1])
    except ValueError as error:
        raise InputError(f"{path}, line {lines[0][0]}: {error}") from error
    marks = [_parse(path, number, line) for number, line in lines[1:]]
    _refuse_contradictions(path, marks)
    named = list(dict.fromkeys(mark.image for mark in marks))
    shown = same_images(named, images.names)
    index_of_name = {name: k for name, k in zip(named, shown.places.tolist(), strict=True) if k >= 0}
    used = [mark for mark in marks if mark.image in index_of_name]
    if not used:
        why = f" ({shown.ambiguity})" if shown.ambiguity else ""
        raise InputError(f"{path} has no mark in an image of the model, such as {images.names[0]}{why}")
    names = sorted({mark.point for mark in used})
    place = {name: k for k, name in enumerate(names)}
    used.sort(key=lambda mark: (place[mark.point], index_of_name[mark.image]))
    first = {mark.point: mark for mark in reversed(used)}
    try:
        positions, is_geodetic = project(np.array([first[name].position for name in names]))
        datum = datum_of(positions) if is_geodetic else None
        positions = positions if datum is None else enu_of(positions, datum)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    statement = f"{len(names)} points of {path}"
    if datum is not None:
        statement += f", {datum.statement}"
    if len(used) < len(marks):
        statement += f", without {len(marks) - len(used)} of {len(marks)} marks, whose images the model lacks"
    return ControlPoints(
        names=tuple(names),
        positions=positions,
        is_check=np.array([first[name].is_check for name in names], dtype=np.bool_),
        points=np.array([place[mark.point] for mark in used], dtype=np.int64),
        images=np.array([index_of_name[mark.image] for mark in used], dtype=np.int64),
        pixels=np.array([mark.pixel for mark in used]),
        statement=statement,
        datum=datum,
    )


def look_at_marks(images: Images, known: ControlPoints) -> MarkedViews:
    """Return the views that the placed ones of images have of the marks of control points."""
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


def _parse(path: Path, number: int, line: str) -> _Mark:
    cells = [cell.strip() for cell in (line.split("\t") if line.count("\t") >= 5 else line.split())]
    if len(cells) < 6 or not all(map(is_number, cells[:5])):
        raise InputError(f"{path}, line {number}: expected {_LINE}")
    values = np.array([float(cell) for cell in cells[:5]])
    if not (np.abs(values) <= _LARGEST).all():
        raise InputError(f"{path}, line {number}: coordinates must be finite, and all three known")
    point = cells[6] if len(cells) > 6 else "({}, {}, {})".format(*cells[:3])
    is_check = point.lower().startswith(_CHECK_PREFIX) or _CHECK_WORD in map(str.lower, cells[7:])
    x, y, z, u, v = values.tolist()
    return _Mark(number, (x, y, z), (u, v), cells[5], point, is_check)


def _refuse_contradictions(path: Path, marks: list[_Mark]) -> None:
    """Refuse a point of two positions or roles, and one that an image shows twice."""
    first: dict[str, _Mark] = {}
    seen: set[tuple[str, str]] = set()
    for mark in marks:
        earlier = first.setdefault(mark.point, mark)
        where = f"{path}, line {mark.number}: "
        if earlier.position != mark.position:
            raise InputError(
                f"{where}{mark.point} has other coordinates than in line {earlier.number}; keep one position"
            )
        if earlier.is_check != mark.is_check:
            raise InputError(f"{where}{mark.point} is a check point in one line and none in another")
        if (mark.point, mark.image) in seen:
            raise InputError(f"{where}{mark.point} is marked twice in {mark.image}; keep one of its marks")
        seen.add((mark.point, mark.image))
