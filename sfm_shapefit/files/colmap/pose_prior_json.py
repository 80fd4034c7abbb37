"""COLMAP's pose-prior JSON: what applies to all positions, the names of columns, and rows.

    {"coordinate_system": "WGS84", "translation_convention": "WORLD_FROM_CAM",
     "schema": ["NAME", "LAT", "LON", "ALT", "STD_TX", "STD_TY", "STD_TZ"],
     "data": [["a.jpg", 47.3769, 8.5417, 500.0, 2.0, 2.0, 4.0]]}

Source: https://github.com/colmap/colmap/pull/4537 (`PosePriorArchive`, July 2026). The origin of a Cartesian
system is `enu_origin`, its latitude, longitude and altitude.
"""

from pathlib import Path

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.position_table import PositionSystem, PositionTable, read_columns
from sfm_shapefit.files.json_node import JsonNode, read_json
from sfm_shapefit.scene.given import EarthDatum

_ONLY = {"sensor_type": "CAMERA", "translation_convention": "WORLD_FROM_CAM", "ellipsoid": "WGS84"}
"""What is read, by key; it is so where the file does not say."""
_SYSTEMS: dict[str, PositionSystem] = {"WGS84": "geodetic", "CARTESIAN": "metric"}


def read_pose_prior_json(path: Path) -> PositionTable:
    """Read names and positions.

    Raises:
        InputError: if the file cannot be read, says what is not read here, or has no such columns.
    """
    root = JsonNode(path, "", read_json(path))
    schema = [word.text() for word in root.get("schema").elements()]
    for key, only in _ONLY.items():
        if root.has(key) and root.get(key).text().upper() != only:
            raise InputError(f"{path}: {key} is {root.get(key).text()}, and only {only} is read; write that")
    told = root.get("coordinate_system").text().upper() if root.has("coordinate_system") else "UNDEFINED"
    if told not in {*_SYSTEMS, "UNDEFINED"}:
        raise InputError(f"{path}: coordinate_system is {told}; give WGS84 or CARTESIAN")
    wrong = {"WGS84": {"TX", "TY", "TZ"}, "CARTESIAN": {"LAT", "LON", "ALT"}}.get(told, set())
    header = ["INDEX" if word.upper() in wrong else word.upper() for word in schema]
    rows = {
        number: ["" if cell.value is None else str(cell.value) for cell in row.elements()]
        for number, row in enumerate(root.get("data").elements(), start=1)
    }
    table = read_columns(path, header, rows)
    datum = None
    if told == "CARTESIAN" and root.has("enu_origin"):
        latitude, longitude, altitude = root.get("enu_origin").numbers(3)
        datum = EarthDatum(latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude)
    return table._replace(system=_SYSTEMS.get(told, table.system), datum=datum)
