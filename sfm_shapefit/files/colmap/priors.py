"""Position priors of cameras: pose priors of a COLMAP database, a table of names and positions, or EXIF data.

Positions on the WGS84 ellipsoid (latitude, longitude in degrees, altitude in meters) become meters east,
north and up of their median. Their covariances are taken as meters squared in those axes.

Source: https://colmap.github.io/database.html; `colmap/geometry/pose_prior.h`: coordinate system -1 is
undefined, 0 WGS84, 1 Cartesian; covariances are stored by columns. Until COLMAP 3.12 a row names its image,
from then on its sensor and datum, and an image is the datum of a camera.
"""

from pathlib import Path

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.files.lines import is_database, named_rows
from sfm_shapefit.scene.given import Datum, PositionPriors
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.known_positions import KnownPositions

_WGS84, _CARTESIAN = 0, 1  # coordinate system of a prior; the numbers are COLMAP's
_SENSOR_IS_CAMERA = 0  # type of a sensor; COLMAP's number for cameras
PRIORS_OF_IMAGES = f"images.image_id = corr_data_id WHERE corr_sensor_type = {_SENSOR_IS_CAMERA}"
"""What joins pose priors to their images, of databases whose priors may be of other sensors too."""
_TABLE_COLUMNS = (4, 5, 7)  # cells of a row; a name, a position, and no, one or three standard deviations
_FORM = "a name, three coordinates, and none, one or three standard deviations"
_GEODETIC = ({"lat", "latitude"}, {"lon", "lng", "long", "longitude"}, {"alt", "altitude", "height"})
"""Names of the columns of latitude, longitude and altitude, in this order."""
_LARGEST = 1e30  # units; sums of squares of squares of larger coordinates or sigmas overflow


class MissingPriorsError(InputError):
    """A database that has no position prior of a model's images."""


def database_priors(file: DatabaseFile, images: Images) -> PositionPriors:
    """Read the pose priors of the model's images, matched by name, from a database.

    Raises:
        MissingPriorsError: if the database has no prior of these images.
        InputError: if it mixes coordinate systems, or is damaged.
    """
    path, found = file.path, dict[int, tuple[FloatArray, FloatArray]]()
    systems: set[int] = set()
    index_of_name = {name: index for index, name in enumerate(images.names)}
    selected = "SELECT images.name, position, {}, coordinate_system FROM pose_priors JOIN images ON {}"
    by_image, covariances = "images.image_id = pose_priors.image_id", "position_covariance"
    # One for each version of the schema, the newest first, by the columns that it has.
    queries = {
        ("corr_data_id", "corr_sensor_type", covariances): selected.format(covariances, PRIORS_OF_IMAGES),
        ("image_id", covariances): selected.format(covariances, by_image),
        ("image_id", "position"): selected.format("NULL", by_image),
    }
    for name, position, covariance, system in file.rows("pose_priors", queries):
        index = index_of_name.get(name)
        xyz = _numbers(path, name, position, 3)
        if index is None or system not in (_WGS84, _CARTESIAN) or not (np.abs(xyz) <= _LARGEST).all():
            continue
        found[index] = xyz, _numbers(path, name, covariance, 9).reshape(3, 3)
        systems.add(system)
    if not found:
        raise MissingPriorsError(
            f"{path} has no position prior of the model's images; give a table (priors=FILE)"
        )
    if len(systems) > 1:
        raise InputError(f"{path} mixes WGS84 and Cartesian priors; give a table of one kind (priors=FILE)")
    return _priors(found, f"pose priors of {path}", geodetic=systems == {_WGS84})


def table_priors(path: Path, images: Images) -> PositionPriors:
    """Read a text table `name x y z [sigma | sigma_x sigma_y sigma_z]`, by commas or white space.

    A first line that names the columns is optional; where it calls the second one lat or latitude, rows
    are latitude, longitude (degrees) and altitude (meters). Lines that begin with # are comments; names that
    are not among the model's are passed over.

    Raises:
        InputError: if the file cannot be read, a line is malformed (it is named by its number), or no name
            is one of the model's.
    """
    rows, geodetic = read_position_table(path)
    index_of_name = {name: index for index, name in enumerate(images.names)}
    found = {index_of_name[name]: row for name, row in rows.items() if name in index_of_name}
    if not found:
        raise InputError(f"{path} has no prior of the model's images, such as {images.names[0]}")
    return _priors(found, f"{len(found)} positions of {path}", geodetic=geodetic)


def exif_priors(folder: Path, images: Images) -> PositionPriors:
    """Read the GPS positions that the EXIF data of the model's images have, by pycolmap's own reader.

    A position without altitude has that of the median.

    Raises:
        InputError: if no image of the model in the folder has a position.
    """
    found: dict[int, tuple[FloatArray, FloatArray]] = {}
    for index, name in enumerate(images.names):
        bitmap = pycolmap.Bitmap.read(folder / name, True) if (folder / name).is_file() else None
        if bitmap is not None:
            read = bitmap.exif_latitude(), bitmap.exif_longitude(), bitmap.exif_altitude()
            position = np.array([np.nan if value is None else value for value in read])
            if np.isfinite(position[:2]).all():
                found[index] = position, np.full((3, 3), np.nan)
    if not found:
        raise InputError(f"{folder} has no image of the model with a GPS position in its EXIF data")
    altitudes = np.array([position[2] for position, _ in found.values()])
    level = float(np.median(altitudes[np.isfinite(altitudes)])) if np.isfinite(altitudes).any() else 0.0
    for position, _ in found.values():
        position[2] = level if np.isnan(position[2]) else position[2]
    return _priors(found, f"EXIF data of {len(found)} images of {folder}", geodetic=True)


def read_position_table(path: Path) -> tuple[dict[str, tuple[FloatArray, FloatArray]], bool]:
    """Read position (3,) and covariance (3, 3) of each name of a table, and whether it has latitudes.

    Raises:
        InputError: if the file cannot be read or a line is malformed.
    """
    if is_database(path):
        raise InputError(f"{path} is a database; its own pose priors are priors=database")
    header, rows = named_rows(path, _TABLE_COLUMNS, _FORM)
    geodetic = bool(header) and _is_geodetic(path, header)
    return {name: _prior_of(where, values) for name, (where, values) in rows.items()}, geodetic


def _is_geodetic(path: Path, header: list[str]) -> bool:
    """Return whether the columns are latitude, longitude and altitude, by their names."""
    named = [word.lower() for word in header[1:4]]
    are_so = [name in names for name, names in zip(named, _GEODETIC, strict=False)]
    if all(are_so) and len(are_so) == len(_GEODETIC):
        return True
    if any(name in names for name in named for names in _GEODETIC[:2]):
        raise InputError(
            f"{path}: the header {','.join(header)} is not known; give name,lat,lon,alt or name,x,y,z"
        )
    return False


def enu_of(geodetic: FloatArray, datum: Datum) -> FloatArray:
    """Return positions (k, 3), latitude, longitude in degrees and altitude, in meters east, north and up.

    Raises:
        ValueError: if a latitude or longitude is out of range.
    """
    if (np.abs(geodetic[:, 0]) > 90.0).any() or (np.abs(geodetic[:, 1]) > 360.0).any():
        raise ValueError("a latitude or longitude is out of range; give degrees")
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    return np.asarray(transform.ellipsoid_to_enu(geodetic, *datum))


def _numbers(path: Path, name: str, blob: object, count: int) -> FloatArray:
    """Return the doubles of a blob, NaN if it is NULL."""
    if blob is None:
        return np.full(count, np.nan)
    if not isinstance(blob, bytes) or len(blob) != 8 * count:
        raise InputError(f"{path}: the pose prior of image {name} is damaged; leave it out or write it again")
    return np.frombuffer(blob, dtype="<f8").astype(np.float64)


def _prior_of(where: str, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return position and covariance by the numbers of a line."""
    if not (np.abs(values) <= _LARGEST).all() or (values[3:] < 1.0 / _LARGEST).any():
        raise InputError(
            f"{where}coordinates must be finite and standard deviations positive, all below {_LARGEST:g}"
        )
    if len(values) == 3:
        return values, np.full((3, 3), np.nan)
    return values[:3], np.diag(np.broadcast_to(values[3:] ** 2, 3))


def _priors(
    found: dict[int, tuple[FloatArray, FloatArray]], source: str, *, geodetic: bool
) -> PositionPriors:
    """Return priors in Cartesian axes."""
    cameras = sorted(found)
    positions, covariances = (np.array([found[k][part] for k in cameras]) for part in (0, 1))
    statement, datum = source, None
    if geodetic:
        datum = Datum(*np.median(positions, axis=0).tolist())
        try:
            positions = enu_of(positions, datum)
        except ValueError as error:
            raise InputError(f"{source}: {error}") from error
        statement += f", in {datum.statement}"
    return PositionPriors(
        known=KnownPositions.measured(np.array(cameras, dtype=np.int64), positions, covariances),
        statement=statement,
        datum=datum,
    )
