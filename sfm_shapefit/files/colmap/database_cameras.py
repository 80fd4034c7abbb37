"""The cameras of a COLMAP database, which may hold what no lens has.

A focal length, a coefficient or a size that cannot be (0, negative, NaN, infinite) is no reason to stop:

- what was guessed (`prior_focal_length` is 0) becomes what COLMAP guesses: a focal length of 1.2 times the
  larger side, the principal point in the middle, no distortion; so does a guess in no unit of pixels;
- what was stated leaves the images of that camera out;
- a size that is not there is twice the principal point.

Models of other programs are read as `camera_variants` has them. All this is told.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.wording import counted_are, first_of
from sfm_shapefit.files.colmap.camera_variants import cameras_alike, num_params_of_model, read_camera
from sfm_shapefit.files.colmap.database_pairs import NO_ID
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile, is_between

_LARGEST_SIDE = 2**31  # pixels; no image has such a side
_GUESS = 1.2  # focal length over the larger side where none is known; COLMAP's default_focal_length_factor
# Least and most focal length of a guess over the larger side; COLMAP's mapper takes 0.1 to 10 for possible.
_LEAST_GUESS, _MOST_GUESS = 0.01, 100.0
_COLUMNS = ("camera_id", "model", "width", "height", "params", "prior_focal_length")


class DatabaseCameras(NamedTuple):
    """The cameras of a database by their ids."""

    usable: Mapping[int, pycolmap.Camera]
    impossible: Mapping[int, str]
    """What is wrong with each of the others, with its verb."""
    changed: Mapping[int, str]
    """What was read otherwise than it stands."""

    def notes(self, names: Mapping[int, Sequence[str]]) -> Iterator[str]:
        """Yield what was read otherwise and which images are left out, a sentence for all alike.

        `names` are those of the images of impossible cameras.
        """
        for cameras, _, said in cameras_alike(self.changed):
            yield f"{cameras} of the database: {said}"
        for cameras, ids, why in cameras_alike({i: self.impossible[i] for i in names}):
            lost = [name for camera_id in ids for name in names[camera_id]]
            each = ": each" if len(ids) > 1 else ""
            yield (
                f"{cameras} of the database{each} {why}: {counted_are(len(lost), 'image')} left out "
                f"({first_of(lost)}); correct that, or set prior_focal_length to 0 for COLMAP's guess"
            )


def read_cameras(file: DatabaseFile) -> DatabaseCameras:
    """Read the cameras of a database.

    Raises:
        InputError: if an id is none or appears twice, or the database cannot be read.
    """
    query = f"SELECT {', '.join(_COLUMNS)} FROM cameras ORDER BY 1"
    usable: dict[int, pycolmap.Camera] = {}
    impossible, changed = dict[int, str](), dict[int, str]()
    for camera_id, *row in file.rows("cameras", {_COLUMNS: query}):
        if not is_between(camera_id, 0, NO_ID):
            raise InputError(
                f"{file.path}: the camera with id {camera_id!r} is damaged; extract features again"
            )
        if camera_id in usable or camera_id in impossible:
            raise InputError(f"{file.path}: camera {camera_id} appears twice; remove one of them")
        try:
            camera, said = _camera(*row)
        except ValueError as error:
            impossible[camera_id] = str(error)
            continue
        camera.camera_id, usable[camera_id] = camera_id, camera
        if said:
            changed[camera_id] = said
    return DatabaseCameras(usable, impossible, changed)


def _camera(model: Any, width: Any, height: Any, params: Any, prior: Any) -> tuple[pycolmap.Camera, str]:
    """Return the camera of a row, and what was read otherwise; ValueError says why it is none."""
    if not isinstance(model, int) or model not in num_params_of_model():
        raise ValueError(f"has the model {model!r}, which pycolmap does not know")
    name, wanted = num_params_of_model()[model]
    is_blob = isinstance(params, bytes) and len(params) % 8 == 0
    given = np.frombuffer(params if is_blob else b"", dtype="<f8")
    w, h = (side if is_between(side, 1, _LARGEST_SIDE) else 0 for side in (width, height))
    read, said = read_camera(model, (w, h), given.tolist()), list[str]()
    if read is not None:
        name, given, said = read.model, np.array(read.params), [read.note] * bool(read.note)
    elif prior or not (w and h):
        raise ValueError(f"has {len(given)} parameters, where {name} has {wanted}")
    else:
        given = np.full(wanted, np.nan)
    if not (w and h):
        w, h = _sides_by(name, given)
        said.append(f"its size {width!r} x {height!r} became {w} x {h}, twice its principal point")
    camera = pycolmap.Camera.create_from_model_name(1, name, _GUESS * max(w, h), w, h)
    camera.has_prior_focal_length, focal = bool(prior), camera.focal_length_idxs()
    between = (0.0, np.inf) if prior or not focal else (_LEAST_GUESS * max(w, h), _MOST_GUESS * max(w, h))
    bad, what = _impossible(given, focal, between)
    if bad.any():
        if prior and focal:
            raise ValueError(f"has the {what}")
        guess = f"COLMAP's guess, focal length {camera.params[0]:g} px" if focal else "the size of its images"
        said.append(f"the {what}, which cannot be, became {guess}")
    camera.params = np.where(bad, camera.params, given).tolist()
    return camera, "; ".join(said)


def _impossible(
    given: FloatArray, focal: Sequence[int], between: tuple[float, float]
) -> tuple[BoolArray, str]:
    """Return which parameters cannot be, and what they are; with a focal length the other one is not used.

    Focal lengths lie between two values. Without them, all are lengths: width and height of a panorama.
    """
    bad = ~np.isfinite(given)
    lengths = list(focal) or slice(None)
    bad[lengths] |= ~((given[lengths] > between[0]) & (given[lengths] < between[1]))
    values = " and ".join(dict.fromkeys(f"{value:g}" for value in given[bad]))
    what = "focal length" if focal and set(np.flatnonzero(bad)) <= set(focal) else "parameters"
    bad[focal] = bad[focal].any()
    return bad, f"{what} {values}"


def _sides_by(name: str, given: FloatArray) -> tuple[int, int]:
    """Return width and height of pictures of which only the lens is known, whose middle is in theirs."""
    idxs = pycolmap.Camera.create_from_model_name(1, name, 1.0, 2, 1).principal_point_idxs()
    sides = np.rint(2.0 * given[idxs] if idxs else given)
    if not ((sides >= 1.0) & (sides < _LARGEST_SIDE)).all():  # NaN is none either
        raise ValueError("has no size")
    return int(sides[0]), int(sides[1])
