"""Tables of positions as programs write them: columns by the words of a header, in any order.

    SourceFile,GPSLatitude,GPSLongitude,GPSAltitude                      exiftool
    #Label,X/Longitude,Y/Latitude,Z/Altitude,Accuracy_X/Y_(m)            Metashape
    imagename,latitude,longitude,altitude,accuracy horizontal            Pix4D
    #name latitude/Y longitude/X height/Z yaw pitch roll SAlt            Mission Planner
    Name,Latitude,Longitude,AbsAlt,RltAlt,Pitch,Roll,Yaw,StdHorizon      DJI
    EPSG:4326                                                            OpenDroneMap's geo.txt

Without a header a line is a name, three coordinates and none, one or three standard deviations; under a line
that names a projection it is that of geo.txt, https://docs.opendronemap.org/geo/.
"""

import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.wording import first_of
from sfm_shapefit.files.colmap.geodesy import Projection, is_projection, projection_named
from sfm_shapefit.files.lines import cells_of, is_database, lines_of_cells, text_of
from sfm_shapefit.scene.given import EarthDatum

LARGEST = 1e30  # units; sums of squares of squares of larger coordinates or sigmas overflow
_FORM = "a name, three coordinates, and none, one or three standard deviations"
_PLAIN = ("name", "x", "y", "z")
_SIGMAS: dict[int, Sequence[str]] = {1: ("sigma xyz",), 3: ("sigma x", "sigma y", "sigma z")}
"""What columns without a name that follow four others are, by their number."""
_ODM = (*_PLAIN, "", "", "", "sigma xy", "sigma z")  # angles stand between

_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_FUSED = re.compile(r"(?:std|sigma|acc|sd)(t?[xyz]|[hvneu])|s([xyz])|(t?[xyz])(?:std|sigma|acc)")
_COVARIANCE = re.compile(r"cov_t?([xyz])([xyz])")
_WORDS = {
    "name": "name image imagename img file filename photo picture label source sourcefile path camera",
    "lat": "lat latitude",
    "lon": "lon lng long longitude",
    "alt": "alt altitude height elevation elev ele hgt hae h v vert vertical",
    "x": "x tx easting east e",
    "y": "y ty northing north n",
    "z": "z tz up u",
    "xy": "xy hor horz horiz horizontal horizon",
    "sigma": "sigma std stddev stdev sd deviation accuracy acc precision uncertainty rms rmse",
    "ref": "ref",
    "filler": "gps exif composite xmp wgs 84 drone dji geo position pos center above mean sea level msl amsl "
    "abs absolute ellipsoid ellipsoidal deg degree degrees decimal m meter meters metre metres",
    "unused": "yaw pitch roll omega phi kappa heading bearing gimbal speed velocity track direction date "
    "time utc timestamp est error relative rlt rel agl takeoff salt dop hdop vdop pdop fix satellites q "
    "quality make model serial iso exposure focal f width id index size status t k gx gy gz qw qx qy qz",
}
"""Words of a column's name by what they say; `unused` ones are of what is no position of an image."""
_KIND_OF = {word: kind for kind, words in _WORDS.items() for word in words.split()}
_AXES = {"lat": "y", "lon": "x", "alt": "z", "x": "x", "y": "y", "z": "z", "xy": "xy"}
"""Coordinates, and the axes of their standard deviations."""
_LENGTHS = {"m", "meter", "meters", "metre", "metres", "easting", "northing", "east", "north"}

_NOTHING = {"", "-", "nan", "none", "null", "n/a", "na"}
_DECIMAL_COMMA = re.compile(r"([+-]?\d+),(\d+)")
_DEGREES = re.compile(
    r"([NSEW]?) *([+-]?[\d.]+) *(?:(?:deg(?:rees)?|[°ºd]) *(?:([\d.]+) *['′] *)?"
    r"(?:([\d.]+) *(?:[\"″]|'') *)?)?([NSEW]?)",
    re.IGNORECASE,
)
_HEIGHT = re.compile(r"([+-]?[\d.]+) *m(?:et(?:er|re)s?)?\.?(?: (above|below)(?: sea level)?)?", re.I)
_NEGATIVE = ("s", "w", "b", "1")  # begins of south, west, below sea level, and EXIF's number for that

PositionSystem = Literal["geodetic", "metric", "lat lon?", "lon lat?"]
"""What positions are; where neither is said, the order in which they stand should they be degrees."""


class PositionTable(NamedTuple):
    """Named positions as a file has them."""

    names: tuple[str, ...]
    positions: FloatArray
    """(k, 3) latitude, longitude in degrees and altitude, or x, y, z; NaN where there is none."""
    covariances: FloatArray
    """(k, 3, 3) in axes x, y, z, or east, north, up; NaN where they are not known."""
    system: PositionSystem
    notes: tuple[str, ...] = ()
    """What was read otherwise than it stands, or not at all, a sentence each."""
    datum: EarthDatum | None = None
    """Where the origin of metric positions is on Earth, if that is known."""

    def part(self, rows: BoolArray) -> "PositionTable":
        """Return those of some rows (k,)."""
        names = tuple(name for name, is_kept in zip(self.names, rows, strict=True) if is_kept)
        return self._replace(names=names, positions=self.positions[rows], covariances=self.covariances[rows])


class _Columns(NamedTuple):
    roles: Sequence[str]
    """By column: name, an axis as in `_AXES`, or the axes of a sigma, cov or ref; ? or empty for others."""
    axes: Sequence[str]
    """Roles of the coordinates, in the order of a position; that of altitudes may be missing."""
    system: PositionSystem
    notes: tuple[str, ...] = ()


def read_position_table(path: Path) -> PositionTable:
    """Read a table of names and positions.

    Raises:
        InputError: if the file cannot be read, a line is malformed, or the header is not understood.
    """
    if is_database(path):
        raise InputError(f"{path} is a database; its own pose priors are priors=database")
    lines, project = dict(lines_of_cells(path)), None
    first = next(iter(lines), 0)
    if lines and is_projection(line := " ".join(lines[first])):
        try:
            project = projection_named(line)
        except ValueError as error:
            raise InputError(f"{path}, line {first}: {error}") from error
        del lines[first]
        first = next(iter(lines), 0)
    if lines and sum(map(_is_value, lines[first])) < 2:
        return read_columns(path, lines.pop(first), lines, project)
    if header := _commented_header(path, len(lines.get(first, ()))):
        return read_columns(path, header, lines, project)
    if project is None:
        lines = {number: _with_whole_name(cells) for number, cells in lines.items()}
    return _read_rows(path, _Columns(_ODM if project else _PLAIN, _PLAIN[1:], "lat lon?"), lines, project)


def _commented_header(path: Path, width: int) -> list[str]:
    """Return the words of the comment that names the columns of a table, whose first line has so many."""
    for line in text_of(path).splitlines():
        if line.lstrip().startswith("#"):
            words = cells_of(line.strip("# \t"))
            roles = list(map(_role_of, words))
            if _axes_of(roles) and (len(words) == width or ("name" in roles and "?" not in roles)):
                return words
    return []


def read_columns(
    path: Path, header: Sequence[str], lines: Mapping[int, Sequence[str]], project: Projection | None = None
) -> PositionTable:
    """Read lines, by their numbers, whose columns a header names.

    Raises:
        InputError: if the header is not understood, or a line is malformed.
    """
    roles = list(map(_role_of, header))
    axes = _axes_of(roles)
    if axes and "name" not in roles:  # the column of names may have none itself
        roles[next((k for k, role in enumerate(roles) if role in ("", "?")), 0)] = "name"
    unknown = [word for word, role in zip(header, roles, strict=True) if role == "?"]
    if not axes or not set(axes) <= set(roles):
        above_all = f", above all {first_of(list(map(repr, unknown)))}" if unknown else ""
        raise InputError(
            f"{path}: the header {','.join(header)} is not known{above_all}; give name,lat,lon,alt or "
            "name,x,y,z, with accuracies as sigma or sigma_x"
        )
    says_lengths = any(_LENGTHS & set(_words(header[roles.index(axis)])) for axis in axes[:2])
    system: PositionSystem = "geodetic" if axes[0] == "lat" else "metric" if says_lengths else "lon lat?"
    notes = (f"{path}: columns that are not known are not used: {first_of(unknown)}",) if unknown else ()
    return _read_rows(path, _Columns(roles, axes, system, notes), lines, project)


def _role_of(word: str) -> str:
    """Return what a column is by its name, ? if it is not known; see `_Columns`."""
    words = _words(word)
    if match := _COVARIANCE.fullmatch("_".join(words)):
        return f"cov {match[1]}{match[2]}"
    kinds = {_KIND_OF.get(one, "?") for one in [*words, "".join(words)] if one in words or one in _KIND_OF}
    if "unused" in kinds or {"image", "height"} <= set(words):
        return ""
    axes = _AXES.keys() & kinds
    if "sigma" in kinds:
        axes = axes - {"alt"} | {"xy"} if "h" in words else axes
        return f"sigma {''.join(_AXES[axis] for axis in sorted(axes)) or 'xyz'}"
    if axes & {"lat", "lon", "alt"}:
        axes -= {"x", "y", "z"}
    if not axes:
        return "name" if kinds - {"filler"} == {"name"} else "?"
    is_known = len(axes) == 1 and "?" not in kinds
    return f"{'ref ' if 'ref' in kinds else ''}{axes.pop()}" if is_known else "?"


def _words(word: str) -> list[str]:
    words: list[str] = []
    for one in map(str.lower, _WORD.findall(word)):
        fused = _FUSED.fullmatch(one)
        words += ["std", fused[fused.lastindex or 0]] if fused else [one.removeprefix("gps") or one]
    return words


def _axes_of(roles: Sequence[str]) -> tuple[str, ...]:
    """Return the coordinates among roles; none if they are no position. A latitude needs no altitude."""
    heights = tuple(role for role in ("alt", "z") if role in roles)[:1]
    first, second = ("lat", "lon") if {"lat", "lon"} & set(roles) else ("x", "y")
    is_complete = first in roles and second in roles and (heights or first == "lat")
    return (first, second, *heights) if is_complete else ()


def _with_whole_name(cells: list[str]) -> list[str]:
    """Return the cells of a line without header whose name may have blanks."""
    count = 1 + max((k for k, cell in enumerate(cells) if not _is_value(cell)), default=0)
    return [" ".join(cells[:count]), *cells[count:]]


def _read_rows(
    path: Path, columns: _Columns, lines: Mapping[int, Sequence[str]], project: Projection | None
) -> PositionTable:
    rows: dict[str, tuple[list[float], FloatArray]] = {}
    for number, cells in lines.items():
        where, roles = f"{path}, line {number}: ", list(columns.roles)
        if len(roles) == len(_PLAIN):
            roles += _SIGMAS.get(len(cells) - len(roles), ())
        cell_of = dict(reversed(list(zip(roles, cells, strict=False))))
        is_short = not {"name", *columns.axes[:2]} <= cell_of.keys()
        is_short |= "?" in roles and len(cells) < len(roles)  # as of a header whose names have blanks
        if is_short or (columns.roles is _PLAIN and len(cells) != len(roles)):
            raise InputError(f"{where}expected {_FORM}")
        name = cell_of["name"]
        if name in rows:
            raise InputError(f"{where}{name} appears twice; keep one of its lines")
        rows[name] = _numbers(where, cell_of, columns.axes)
    positions = np.array([position for position, _ in rows.values()]).reshape(-1, 3)
    system = columns.system
    if project and system != "geodetic":
        positions, is_geodetic = project(positions)
        system = "geodetic" if is_geodetic else "metric"
    covariances = np.array([covariance for _, covariance in rows.values()]).reshape(-1, 3, 3)
    return PositionTable(tuple(rows), positions, covariances, system, columns.notes)


def _numbers(where: str, cell_of: Mapping[str, str], axes: Sequence[str]) -> tuple[list[float], FloatArray]:
    """Return position (3,) and covariance (3, 3) of a line by the roles of its cells; NaN where unknown."""
    wanted = {role: cell for role, cell in cell_of.items() if role in axes or role[:4] in ("sigm", "cov ")}
    try:
        value_of = {role: _value(cell) for role, cell in wanted.items()}
    except ValueError as error:
        raise InputError(f"{where}expected {_FORM}, but {error} is not a number") from error
    for axis in axes:
        if cell_of.get(f"ref {axis}", "").lower().startswith(_NEGATIVE):
            value_of[axis] = -abs(value_of[axis])
    sigmas = [value for role, value in value_of.items() if role.startswith("sigma")]
    is_large = any(abs(value) > LARGEST for value in value_of.values())
    if is_large or any(sigma != 0.0 and sigma < 1.0 / LARGEST for sigma in sigmas):
        raise InputError(
            f"{where}coordinates must be finite and standard deviations positive, all below {LARGEST:g}"
        )
    position = [value_of.get(axis, np.nan) for axis in axes]
    return [*position, *[np.nan] * (3 - len(position))], _covariance(value_of)


def _covariance(value_of: Mapping[str, float]) -> FloatArray:
    """Return the covariance (3, 3) by the roles of numbers."""
    covariance = np.full((3, 3), np.nan)
    sigmas = {role[6:]: value for role, value in value_of.items() if role.startswith("sigma ")}
    sigma_of = {axis: value for axes, value in sigmas.items() for axis in axes}
    if {"x", "y", "z"} <= sigma_of.keys():
        covariance = np.diag([sigma_of[axis] ** 2 for axis in "xyz"])
    for i, j in itertools.combinations_with_replacement(range(3), 2):
        stated = value_of.get(f"cov {'xyz'[i]}{'xyz'[j]}", covariance[i, j])
        covariance[[i, j], [j, i]] = stated
    return covariance


def _is_value(cell: str) -> bool:
    """Return whether a cell is a number or an angle."""
    try:
        _value(cell)
    except ValueError:
        return False
    return cell.lower() not in _NOTHING or cell.lower() == "nan"


def _value(cell: str) -> float:
    """Return the number of a cell, such as 47.3, 47 deg 18' 0.00" N or 400 m Above Sea Level; NaN if empty.

    Raises:
        ValueError: if it is none.
    """
    try:
        return float(cell)
    except ValueError:
        pass
    if cell.lower() in _NOTHING:
        return np.nan
    if match := _DECIMAL_COMMA.fullmatch(cell):
        return float(f"{match[1]}.{match[2]}")
    if match := _HEIGHT.fullmatch(cell):
        return -float(match[1]) if match[2] and match[2].lower() == "below" else float(match[1])
    if match := _DEGREES.fullmatch(cell):
        sign, degrees, minutes, seconds, after = match.groups()
        size = abs(float(degrees)) + float(minutes or 0.0) / 60.0 + float(seconds or 0.0) / 3600.0
        return -size if degrees[0] in "-" or (sign + after).lower() in ("s", "w") else size
    raise ValueError(repr(cell))
