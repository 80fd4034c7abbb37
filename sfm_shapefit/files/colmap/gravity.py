"""Gravity in axes of cameras: a table, or the gravity column that pose priors of a COLMAP database have.

Source: `colmap/geometry/pose_prior.h`: gravity is a direction in axes of the camera, x to the right, y down
and z ahead, so that (0, 1, 0) is that of a level camera.
"""

import math
from pathlib import Path

import numpy as np

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.priors import PRIORS_OF_IMAGES
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.files.lines import is_number, lines_of_cells
from sfm_shapefit.scene.given import Gravity
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.same_images import same_images

_SIGMA_DEG = 1.0  # degrees; that of a phone, where the table states none
_LEAST_SIGMA_DEG = 1e-3
"""Degrees; no instrument is as exact, and beside such a gravity the pairs' share drowns in rounding."""
_LARGEST = 1e30  # units; squares of squares of larger coordinates overflow
_FORM = "the name of an image, three components of its gravity and at most a standard deviation in degrees"


def table_gravity(path: Path, images: Images) -> Gravity:
    """Read a text table `name x y z [sigma_deg]`, by commas or white space; sigma is 1 degree if not given.

    A first line that names the columns is optional. Lines that begin with # are comments; images that the
    model lacks are passed over.

    Raises:
        InputError: if the file cannot be read, a line is malformed, or no name is one of the model's.
    """
    rows: dict[str, list[float]] = {}
    for place, (number, cells) in enumerate(lines_of_cells(path)):
        where = f"{path}, line {number}: "
        if place == 0 and len(cells) > 1 and not is_number(cells[1]):
            continue
        if len(cells) not in (4, 5) or not all(map(is_number, cells[1:])):
            raise InputError(f"{where}expected {_FORM}")
        if cells[0] in rows:
            raise InputError(f"{where}{cells[0]} appears twice; keep one of its lines")
        *direction, sigma = [*map(float, cells[1:]), _SIGMA_DEG][:4]
        length = float(np.linalg.norm(direction))
        if not 1.0 / _LARGEST <= length <= _LARGEST or not _LEAST_SIGMA_DEG <= sigma < 90.0:
            raise InputError(
                f"{where}the direction must be finite and not zero, the standard deviation between "
                f"{_LEAST_SIGMA_DEG:g} and 90 deg"
            )
        rows[cells[0]] = [*direction, sigma]
    same = same_images(list(rows), images.names)
    gravities = {k: row for k, row in zip(same.places.tolist(), rows.values(), strict=True) if k >= 0}
    if not gravities:
        why = same.ambiguity or f"such as {images.names[0]}"
        raise InputError(f"{path} has no gravity of the model's images, {why}")
    return _gravity(gravities)


def database_gravity(file: DatabaseFile, images: Images) -> Gravity:
    """Read the gravity of the pose priors of the model's images, each to 1 degree.

    Raises:
        InputError: if the database has none of these images, or a damaged one.
    """
    query = f"SELECT images.name, gravity FROM pose_priors JOIN images ON {PRIORS_OF_IMAGES}"
    gravities: dict[int, list[float]] = {}
    columns = ("corr_data_id", "corr_sensor_type", "gravity")
    rows = file.rows("pose_priors", {columns: query})
    places = same_images([str(name) for name, _ in rows], images.names).places.tolist()
    for place, (name, blob) in zip(places, rows, strict=True):
        if place < 0 or blob is None:
            continue
        if not isinstance(blob, bytes) or len(blob) != 24:
            raise InputError(
                f"{file.path}: the gravity of image {name} is damaged; leave it out or write it again"
            )
        values = np.frombuffer(blob, dtype="<f8")
        if 1.0 / _LARGEST <= float(np.linalg.norm(values)) <= _LARGEST:
            gravities[place] = [*values.tolist(), _SIGMA_DEG]
    if not gravities:
        raise InputError(f"{file.path} has no gravity of its images; give a table (gravity=FILE)")
    return _gravity(gravities)


def _gravity(gravities: dict[int, list[float]]) -> Gravity:
    indices = sorted(gravities)
    values = np.array([gravities[k] for k in indices])
    lengths = np.linalg.norm(values[:, :3], axis=1, keepdims=True)
    sigmas = np.array([math.radians(sigma) for sigma in values[:, 3].tolist()])
    return Gravity(np.array(indices, dtype=np.int64), values[:, :3] / lengths, sigmas)
