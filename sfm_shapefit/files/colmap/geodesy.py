"""Positions on Earth: from latitudes and longitudes, or a projection named in words, to meters about a datum.

Source: https://docs.opendronemap.org/gcp/ and https://docs.opendronemap.org/geo/ (how projections are named;
geographic coordinates are longitude, then latitude).
"""

import re
from collections.abc import Callable

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.scene.given import EarthDatum

_LOCAL = {"local", "enu"}
_GEODETIC = re.compile(r"(epsg:4326|epsg:4979|wgs84|.*\+proj=(latlong|longlat)\b.*)")
_UTM_WORDS = re.compile(r"wgs84 (?:/ )?utm (?:zone )?(\d{1,2}) ?([ns])")
_UTM_CODE = re.compile(r"epsg:32([67])(\d\d)")
_UTM_STRING = re.compile(r".*\+proj=utm\b.*\+zone=(\d{1,2})\b.*")
_EARTH_SHAPE, _UNITS = re.compile(r"\+(?:ellps|datum)=(\S+)"), re.compile(r"\+units=(\S+)")
_ZONES = range(1, 61)
_NAMES_ONE = re.compile(r"(epsg:\d+|wgs84|utm\b|\+proj=|(local|enu)$)")
_FARTHEST_M = 1e7  # meters; the largest northing of a zone of UTM
_MUCH_CLOSER = 0.5  # share of the distances from the median; what other turns of longitudes have to save

Projection = Callable[[FloatArray], tuple[FloatArray, bool]]
"""What turns coordinates (k, 3) into latitude, longitude in degrees and altitude in meters, and says True; or
leaves them as they are, metric, and says False."""


def is_projection(line: str) -> bool:
    """Return whether a line names a projection, one that is known here or another."""
    return _NAMES_ONE.match(_plain(line)) is not None


def projection_named(line: str) -> Projection:
    """Return the projection that a line names.

    Raises:
        ValueError: if it is none that is converted; what is returned raises it for coordinates out of range.
    """
    named = _plain(line)
    if named in _LOCAL:
        return lambda xyz: (xyz, False)
    if _GEODETIC.fullmatch(named):
        return lambda xyz: (xyz[:, [1, 0, 2]], True)
    zone, is_north = _zone(named)
    if zone in _ZONES:
        return lambda xyz: (_from_zone(xyz, zone, is_north), True)
    raise ValueError(
        f"the projection {line.strip()!r} is not one that is converted; give coordinates in EPSG:4326 "
        "(longitude, latitude, altitude), in a zone as WGS84 UTM 32N, or metric ones after the line local"
    )


def _from_zone(xyz: FloatArray, zone: int, is_north: bool) -> FloatArray:
    """Return latitudes, longitudes and altitudes (k, 3) of eastings, northings and altitudes in meters."""
    if np.abs(xyz[:, :2]).max(initial=0.0) > _FARTHEST_M:
        raise ValueError("an easting or northing is beyond those of UTM; give meters, easting first")
    return np.asarray(earth().utm_to_ellipsoid(np.ascontiguousarray(xyz), zone, is_north))


def unwrapped(longitudes: FloatArray) -> FloatArray:
    """Return longitudes (k,) in degrees without the jump of a whole turn at 180 or at 0 degrees.

    The way to count them is the one that has them closest to their median, so that a few wrong ones do not
    choose it; they stay as they are where no other way is much closer.
    """
    ways = [longitudes, longitudes % 360.0, (longitudes + 180.0) % 360.0 - 180.0]
    apart = [float(np.sum(np.abs(way - np.median(way)))) for way in ways]
    best = int(np.argmin(apart))
    return ways[best] if apart[best] < _MUCH_CLOSER * apart[0] else longitudes


def datum_of(geodetic: FloatArray) -> EarthDatum:
    """Return the median of positions (k, 3), latitude, longitude in degrees and altitude, on either side of
    the 180th meridian. Near a pole, where longitudes scatter, it is a point near them."""
    latitude, altitude = np.median(geodetic[:, [0, 2]], axis=0).tolist()
    longitude = float(np.median(unwrapped(geodetic[:, 1])))
    longitude -= 360.0 * (longitude > 180.0)
    return EarthDatum(latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude)


def enu_of(geodetic: FloatArray, datum: EarthDatum) -> FloatArray:
    """Return positions (k, 3), latitude, longitude in degrees and altitude, in meters east, north and up.

    Raises:
        ValueError: if a latitude or longitude is out of range.
    """
    latitudes, longitudes = np.abs(geodetic[:, :2]).T
    if (latitudes > 90.0).any() or (longitudes > 360.0).any():
        is_swapped = (latitudes <= 360.0).all() and (longitudes <= 90.0).all()
        remedy = "are they swapped?" if is_swapped else "give degrees"
        raise ValueError(f"a latitude or longitude is out of range; {remedy}")
    return np.asarray(earth().ellipsoid_to_enu(np.ascontiguousarray(geodetic), *datum.geodetic))


def _plain(line: str) -> str:
    return " ".join(line.lower().replace("wgs 84", "wgs84").split())


def _zone(named: str) -> tuple[int, bool]:
    """Return the zone of UTM on WGS84 that a projection names, 0 if it is none, and whether it is north."""
    if words := _UTM_WORDS.fullmatch(named):
        return int(words[1]), words[2] == "n"
    if code := _UTM_CODE.fullmatch(named):
        return int(code[2]), code[1] == "6"
    string = _UTM_STRING.fullmatch(named)
    shapes = set(_EARTH_SHAPE.findall(named)) | set(_UNITS.findall(named))
    return (int(string[1]), "+south" not in named) if string and shapes <= {"wgs84", "m"} else (0, True)


def earth() -> pycolmap.GPSTransform:
    """Return the transformations of the WGS84 ellipsoid."""
    return pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
