"""Places on Earth, given in meters east, north and up of a datum, as coordinates of an EPSG code.

    EPSG:326ZZ, 327ZZ   zone ZZ of UTM on WGS84, north and south: easting, northing, and the height as it is
    EPSG:4978           Earth-centered x, y, z of WGS84

Source: the codes are those of https://epsg.org; the formulas are pycolmap's. For one batch it takes the zone
that most of its rows lie in, by longitude alone, and 10,000 km of false northing for rows of the south.
"""

import re

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.geodesy import earth
from sfm_shapefit.scene.given import EarthDatum

_ECEF = 4978  # EPSG code; Earth-centered, Earth-fixed
_NORTH, _SOUTH = 32600, 32700  # EPSG codes; those of a hemisphere's zones are larger by their numbers
_FALSE_NORTHING = 1e7  # meters; so that no northing of the south is negative
_FARTHEST_DEG = 9.0  # degrees from the middle of a zone, a zone further; the grid bends beyond


def epsg_code(name: str, datum: EarthDatum) -> int:
    """Return the EPSG code that a user names for a scene around a datum; `utm` is the zone that it lies in.

    Raises:
        InputError: if it is none of these, or a zone that the scene is far from.
    """
    zone, word = _zone_of(datum), name.strip().lower()
    code = int(word[5:]) if re.fullmatch(r"epsg:\d{4,5}", word) else 0
    code = zone if word == "utm" else code
    if code != _ECEF and not (code // 100 * 100 in (_NORTH, _SOUTH) and 1 <= code % 100 <= 60):
        raise InputError(
            f"{name!r} is no system that models are converted to; give utm, the EPSG code of a zone of UTM "
            "on WGS84 (EPSG:32601 to 32660, south EPSG:32701 to 32760), or EPSG:4978 (Earth-centered)"
        )
    if code != _ECEF and abs(_wrapped(datum.longitude_deg - _middle_deg(code))) > _FARTHEST_DEG:
        raise InputError(f"{name} is far from the model, which lies in EPSG:{zone}; give that, or utm")
    return code


def to_epsg(places: FloatArray, datum: EarthDatum, code: int) -> FloatArray:
    """Return places (k, 3), in meters east, north and up of a datum, as coordinates of an EPSG code."""
    transform = earth()
    if code == _ECEF:
        return np.asarray(transform.enu_to_ecef(places, *datum.geodetic))
    geodetic = np.asarray(transform.enu_to_ellipsoid(places, *datum.geodetic))
    votes = np.tile([0.0, _middle_deg(code), 0.0], (len(places) + 1, 1))  # for the zone, against all rows
    found = np.asarray(transform.ellipsoid_to_utm(np.concatenate([votes, geodetic]))[0])[len(votes) :]
    found[:, 1] += _FALSE_NORTHING * ((code > _SOUTH) - (geodetic[:, 0] < 0.0).astype(np.float64))
    return found


def _zone_of(datum: EarthDatum) -> int:
    """Return the EPSG code of the zone of UTM that a datum lies in; off Norway they have other widths."""
    latitude, longitude = datum.latitude_deg, _wrapped(datum.longitude_deg)
    zone = int((longitude + 180.0) // 6.0) + 1
    if 56.0 <= latitude < 64.0 and 3.0 <= longitude < 12.0:
        zone = 32
    if 72.0 <= latitude < 84.0 and 0.0 <= longitude < 42.0:
        zone = (31, 33, 35, 37)[int((longitude + 3.0) // 12.0)]
    return zone + (_NORTH if latitude >= 0.0 else _SOUTH)


def _middle_deg(code: int) -> float:
    return 6.0 * (code % 100) - 183.0


def _wrapped(longitude_deg: float) -> float:
    """Return a longitude in [-180, 180)."""
    return (longitude_deg + 180.0) % 360.0 - 180.0
