"""Position priors of cameras: pose priors of a COLMAP database or of its JSON, a table, or EXIF data.

Positions on the WGS84 ellipsoid (latitude, longitude in degrees, altitude in meters) become meters east,
north and up of their median. Their covariances are taken as meters squared in those axes.

Source: https://colmap.github.io/database.html; `colmap/geometry/pose_prior.h`: coordinate system -1 is
undefined, 0 WGS84, 1 Cartesian; covariances are stored by columns. Until COLMAP 3.12 a row names its image,
from then on its sensor and datum, and an image is the datum of a camera. Until COLMAP 3.8 images had a prior
themselves, latitude, longitude and altitude where it is that of EXIF data, and no system.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, quantile
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.wording import counted, counted_are
from sfm_shapefit.files.colmap.bitmaps import earth_position, read_bitmap
from sfm_shapefit.files.colmap.geodesy import datum_of, enu_of, unwrapped
from sfm_shapefit.files.colmap.pose_prior_json import read_pose_prior_json
from sfm_shapefit.files.colmap.position_table import (
    LARGEST,
    PositionSystem,
    PositionTable,
    read_position_table,
)
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.scene.given import EarthDatum, PositionPriors
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.known_positions import KnownPositions
from sfm_shapefit.scene.same_images import same_images

_UNDEFINED, _WGS84, _CARTESIAN = -1, 0, 1  # coordinate system of a prior; the numbers are COLMAP's
_SYSTEMS: dict[object, PositionSystem] = {_WGS84: "geodetic", _CARTESIAN: "metric"}
_SENSOR_IS_CAMERA = 0  # type of a sensor; COLMAP's number for cameras
PRIORS_OF_IMAGES = f"images.image_id = corr_data_id WHERE corr_sensor_type = {_SENSOR_IS_CAMERA}"
"""What joins pose priors to their images, of databases whose priors may be of other sensors too."""
_ORDERS = {"lat lon?": (0, 1), "lon lat?": (1, 0)}  # latitude and longitude, by columns
_WIDEST_DEG = 0.1  # degrees, 11 km; positions that are spread farther are not taken for degrees unsaid
_FAR_FROM_ZERO = 100.0  # spreads; lengths this far from their origin, and within _WIDEST_DEG, are rare
_STEEP = 10.0  # horizontal spreads; altitudes in meters scatter by more of them, or not at all


class MissingPriorsError(InputError):
    """A database that has no position prior of a model's images."""


def database_priors(file: DatabaseFile, images: Images) -> PositionPriors:
    """Read the pose priors of the model's images, matched by name, from a database.

    Raises:
        MissingPriorsError: if the database has no prior of these images that can be used.
        InputError: if it mixes coordinate systems, or is damaged.
    """
    path, unused = file.path, dict[str, int]()
    rows = list(_rows_of_images(file, unused))
    if not rows and not unused:
        rows = list(_rows_of_old_images(file))
    positions = np.array([_numbers(path, row.name, row.position, 3) for row in rows]).reshape(-1, 3)
    covariances = np.array([_numbers(path, row.name, row.covariance, 9) for row in rows]).reshape(-1, 3, 3)
    known = (np.abs(positions[:, :2]) <= LARGEST).all(axis=1)
    known &= same_images([row.name for row in rows], images.names).places >= 0
    systems = [row.system for row, is_known in zip(rows, known, strict=True) if is_known]
    system, notes = _system_of(path, systems, positions[known])
    notes += [
        f"{path}: {counted_are(n, 'pose prior')} of {whose}, and not used" for whose, n in unused.items()
    ]
    table = PositionTable(tuple(row.name for row in rows), positions, covariances, system, tuple(notes))
    return _priors(table, images, str(path), f"pose priors of {path}")


def _system_of(path: Path, told: list[object], positions: FloatArray) -> tuple[PositionSystem, list[str]]:
    """Return the system of positions (k, 3), by the numbers that are told of each, and what to note of it."""
    systems = {_SYSTEMS[system] for system in told if system in _SYSTEMS}
    if len(systems) > 1:
        raise InputError(f"{path} mixes WGS84 and Cartesian priors; give a table of one kind (priors=FILE)")
    is_degrees = degrees_order(positions, "lat lon?") == (0, 1)
    system = systems.pop() if systems else "geodetic" if is_degrees else "metric"
    if not (undefined := sum(one not in _SYSTEMS for one in told)):
        return system, []
    return system, [
        f"{path}: {counted(undefined, 'pose prior')} with coordinate_system UNDEFINED taken for "
        f"{'WGS84' if system == 'geodetic' else 'Cartesian'}; set it to WGS84 or CARTESIAN"
    ]


def table_priors(path: Path, images: Images) -> PositionPriors:
    """Read a table, see `position_table`, or COLMAP's pose-prior JSON; names that the model lacks are none.

    Raises:
        InputError: if the file cannot be read, a line is malformed (it is named by its number), or no name
            is one of the model's.
    """
    return _priors(read_positions(path), images, str(path))


def read_positions(path: Path) -> PositionTable:
    """Read names and positions of a table or of COLMAP's pose-prior JSON."""
    return read_pose_prior_json(path) if path.suffix.lower() == ".json" else read_position_table(path)


def exif_priors(folder: Path, images: Images) -> PositionPriors:
    """Read the GPS positions that the EXIF data of the model's images have, by pycolmap's own reader.

    Raises:
        InputError: if no image of the model in the folder has a position.
    """
    found: dict[str, list[float]] = {}
    for name in images.names:
        bitmap = read_bitmap(folder / name) if (folder / name).is_file() else None
        if bitmap is not None and (place := earth_position(bitmap)) is not None:
            found[name] = list(place)
    positions = np.array(list(found.values())).reshape(-1, 3)
    table = PositionTable(tuple(found), positions, np.full((len(found), 3, 3), np.nan), "geodetic")
    return _priors(table, images, str(folder), f"EXIF data of {len(found)} images of {folder}")


def in_meters(table: PositionTable, source: str, datum: EarthDatum | None = None) -> PositionTable:
    """Return the positions that are known, those on Earth in meters about a datum, their median if None.

    Altitudes that are missing are the median of the others, or 0. InputError if latitudes or longitudes are
    out of range.
    """
    notes = list(table.notes)
    if order := degrees_order(table.positions, table.system):
        table = table._replace(positions=table.positions[:, [*order, 2]], system="geodetic")
        names = " and ".join(("latitude", "longitude")[column] for column in order)
        notes.append(
            f"{source}: by their values, and by no header, numbers are taken for {names} in degrees; name "
            "the columns lat, lon, alt, or x_m, y_m, z_m if they are lengths"
        )
    is_geodetic = table.system == "geodetic"
    near = np.abs(table.positions) <= LARGEST
    known: BoolArray = np.asarray(near[:, : 2 if is_geodetic else 3].all(axis=1))
    if lost := int(np.sum(~known)):
        notes.append(f"{source}: {counted_are(lost, 'position')} missing or not finite, of {len(known)}")
    table = table.part(known)
    stated = table.covariances[np.isfinite(table.covariances).all(axis=(1, 2))]
    if bad := int(np.sum(np.linalg.eigvalsh(stated)[:, 0] <= 0.0)):
        notes.append(f"{source}: {counted_are(bad, 'covariance')} not positive definite, and not used")
    if is_geodetic and len(table.names):
        table = table._replace(positions=_with_altitudes(table.positions, near[known, 2], source, notes))
        datum = datum or datum_of(table.positions)
        try:
            table = table._replace(positions=enu_of(table.positions, datum), datum=datum)
        except ValueError as error:
            raise InputError(f"{source}: {error}") from error
    return table._replace(system="metric", notes=tuple(notes))


def _with_altitudes(geodetic: FloatArray, known: BoolArray, source: str, notes: list[str]) -> FloatArray:
    """Return positions (k, 3) with all altitudes; which are known (k,), and notes for what is odd."""
    filled = geodetic.copy()
    if missing := int(np.sum(~known)):
        level = float(np.median(geodetic[known, 2])) if known.any() else 0.0
        filled[~known, 2] = level
        notes.append(f"{source}: {counted_are(missing, 'position')} without altitude, taken for {level:g} m")
    elif len(filled) > 2 and np.ptp(filled[:, 2]) == 0.0:
        notes.append(f"{source}: all altitudes are {filled[0, 2]:g} m, as where they are not measured")
    return filled


def degrees_order(positions: FloatArray, system: PositionSystem) -> tuple[int, int] | None:
    """Return the columns of latitude and longitude of positions (k, 3) whose system is not said, or None.

    They are degrees beyond doubt if both are in range, vary by thousandths of themselves, and altitudes vary
    by meters or not at all: as lengths, cameras would stand within millimeters, and far from the origin.
    """
    known = positions[np.isfinite(positions[:, :2]).all(axis=1)]
    if system not in _ORDERS or not len(known):
        return None
    turns = np.column_stack([unwrapped(known[:, 0]), unwrapped(known[:, 1]), np.nan_to_num(known[:, 2])])
    low, middle, high = (quantile(turns, share) for share in (0.1, 0.5, 0.9))
    spread, far = float(np.max(high[:2] - low[:2])), float(np.max(np.abs(middle[:2])))
    is_steep = not 0.0 < high[2] - low[2] < _STEEP * spread
    if not (0.0 < spread < _WIDEST_DEG and far > _FAR_FROM_ZERO * spread and is_steep):
        return None
    first = _ORDERS[system]
    return next((o for o in (first, first[::-1]) if (np.abs(known[:, o]) <= [90.0, 180.0]).all()), None)


class _Row(NamedTuple):
    """A pose prior of a database as it stands."""

    name: str
    position: object
    covariance: object
    system: object


def _rows_of_images(file: DatabaseFile, unused: dict[str, int]) -> Iterator[_Row]:
    """Yield the pose priors of images, and count why others are of no use."""
    selected = (
        "SELECT images.name, position, {}, coordinate_system, {} FROM pose_priors LEFT JOIN images ON {}"
    )
    by_image, covariance = "images.image_id = pose_priors.image_id", "position_covariance"
    # One for each version of the schema, the newest first, by the columns that it has.
    queries = {
        ("corr_data_id", "corr_sensor_type", covariance): selected.format(
            covariance, "corr_sensor_type", "images.image_id = corr_data_id"
        ),
        ("image_id", covariance): selected.format(covariance, _SENSOR_IS_CAMERA, by_image),
        ("image_id", "position"): selected.format("NULL", _SENSOR_IS_CAMERA, by_image),
    }
    for *row, sensor in file.rows("pose_priors", queries):
        if sensor != _SENSOR_IS_CAMERA or not isinstance(row[0], str):
            whose = (
                "images that are not there" if sensor == _SENSOR_IS_CAMERA else "sensors that are no cameras"
            )
            unused[whose] = unused.get(whose, 0) + 1
        else:
            yield _Row(*row)


def _rows_of_old_images(file: DatabaseFile) -> Iterator[_Row]:
    """Yield the priors that images have themselves; zeros are what scripts write where there is none."""
    columns = ("prior_tx", "prior_ty", "prior_tz")
    for name, *xyz in file.rows("images", {columns: f"SELECT name, {', '.join(columns)} FROM images"}):
        values = [float(value) if isinstance(value, int | float) else np.nan for value in xyz]
        if isinstance(name, str) and np.nan_to_num(values).any():
            yield _Row(name, np.array(values, dtype="<f8").tobytes(), None, _UNDEFINED)


def _numbers(path: Path, name: str, blob: object, count: int) -> FloatArray:
    """Return the doubles of a blob, NaN if it is NULL."""
    if blob is None:
        return np.full(count, np.nan)
    if not isinstance(blob, bytes) or len(blob) != 8 * count:
        raise InputError(f"{path}: the pose prior of image {name} is damaged; leave it out or write it again")
    return np.frombuffer(blob, dtype="<f8").astype(np.float64)


def _priors(table: PositionTable, images: Images, source: str, statement: str = "") -> PositionPriors:
    """Return the positions of the model's images, in Cartesian axes."""
    places, ambiguity = same_images(table.names, images.names)
    place_of = dict(zip(table.names, places.tolist(), strict=True))
    table = in_meters(table.part(places >= 0), source)
    if not table.names:
        why = "; ".join(filter(None, (ambiguity, *table.notes)))
        raise MissingPriorsError(
            f"{source}: no position prior of the model's images, such as {images.names[0]}"
            f"{f' ({why})' if why else ''}; give a table (priors=FILE)"
        )
    row_of = {place_of[name]: row for row, name in enumerate(table.names)}  # the last of an image counts
    rows = [row_of[camera] for camera in sorted(row_of)]
    cameras = np.array(sorted(row_of), dtype=np.int64)
    statement = statement or f"{len(rows)} positions of {source}"
    if table.datum is not None:
        statement += f", in {table.datum.statement}"
    notes = [*table.notes, *([f"{source}: {ambiguity}"] if ambiguity else [])]
    if len(rows) < len(table.names):
        count = len(table.names) - len(rows)
        notes.append(f"{source}: {counted_are(count, 'position')} not used, for their images have later ones")
    return PositionPriors(
        known=KnownPositions.measured(cameras, table.positions[rows], table.covariances[rows]),
        statement=statement,
        datum=table.datum,
        notes=tuple(notes),
    )
