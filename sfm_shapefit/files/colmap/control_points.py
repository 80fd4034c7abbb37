"""Ground control points from a file.

The file is OpenDroneMap's gcp_list.txt:

    WGS84 UTM 32N                                     the projection of the coordinates
    481367.1 5782936.2 100.3 3044 2622 a.jpg P1       x y z, pixels, image, name of the point
    481367.1 5782936.2 100.3 1606 2763 b.jpg P1

Coordinates on the WGS84 ellipsoid, and of the zones of UTM on it, become meters east, north and up of their
median. Nothing else is converted.

Source: https://docs.opendronemap.org/gcp/ (the format; geographic coordinates are longitude, then latitude).
"""

from pathlib import Path

import numpy as np

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.geodesy import datum_of, enu_of, projection_named
from sfm_shapefit.files.colmap.marks import Mark, lines_of, marks_in, read_marks
from sfm_shapefit.scene.given import ControlPoints
from sfm_shapefit.scene.images import Images

_LINE = "x y z, two pixel coordinates, the name of an image, and perhaps that of the point"


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
    lines = lines_of(path)
    if not lines:
        raise InputError(f"{path} is empty; its first line is the projection, then a line is {_LINE}")
    try:
        project = projection_named(lines[0][1])
    except ValueError as error:
        raise InputError(f"{path}, line {lines[0][0]}: {error}") from error
    marks = [(_name_of(mark), mark) for mark in read_marks(path, lines[1:], 3, 0, _LINE)]
    _refuse_contradictions(path, marks)
    known, first = marks_in(path, images, marks)
    try:
        positions, is_geodetic = project(np.array([first[name].known for name in known.names]))
        datum = datum_of(positions) if is_geodetic else None
        positions = positions if datum is None else enu_of(positions, datum)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    of = f", {datum.statement}" if datum else ""
    return ControlPoints(
        names=known.names,
        positions=positions,
        is_check=np.array([first[name].is_check for name in known.names], dtype=np.bool_),
        points=known.points,
        images=known.images,
        pixels=known.pixels,
        statement=f"{len(known.names)} points of {path}{of}{known.statement}",
        absent=known.absent,
        datum=datum,
    )


def _name_of(mark: Mark) -> str:
    return mark.names[0] if mark.names else "({}, {}, {})".format(*mark.typed)


def _refuse_contradictions(path: Path, marks: list[tuple[str, Mark]]) -> None:
    """Refuse a point of two positions or roles."""
    first: dict[str, Mark] = {}
    for point, mark in marks:
        earlier, where = first.setdefault(point, mark), f"{path}, line {mark.number}: {point}"
        if earlier.known != mark.known:
            raise InputError(
                f"{where} has other coordinates than in line {earlier.number}; keep one position"
            )
        if earlier.is_check != mark.is_check:
            raise InputError(f"{where} is a check point in one line and none in another")
