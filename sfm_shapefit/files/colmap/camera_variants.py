"""Camera models as programs other than COLMAP write them, read as the models of COLMAP that they are.

- SPHERE of SphereSfM, SPHERICAL and OPENCV_SPHERICAL of others are EQUIRECTANGULAR. Their parameters are w, h
  as COLMAP has them, or f, cx, cy with the middle of the picture, or none. These programs number the models
  as COLMAP numbers others (11, 12, 16), so that in binary files the number of parameters tells them apart.
- A model of two focal lengths whose list ends early lacks distortion, which is none then. One focal length
  (f, cx, cy, ...: Project Aria, radial models of openMVG) is told by the fourth value, which is no cy.

Sources: https://github.com/json87/SphereSfM (`camera_models.h`), https://github.com/colmap/colmap/pull/4433,
https://github.com/colmap/colmap/pull/4441.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import NamedTuple

import pycolmap

from sfm_shapefit.base.wording import first_of

EQUIRECTANGULAR = "EQUIRECTANGULAR"
_SPHERES = (EQUIRECTANGULAR, "SPHERE", "SPHERICAL", "OPENCV_SPHERICAL")
_IDS_OF_SPHERES = (11, 12, 16, 17)  # ids; those of SphereSfM, its converters, colmap#4433 and COLMAP
OTHER_COUNTS = ((11, 3), (12, 3), (16, 3), (17, 3), (6, 6), (6, 8), (11, 14), (11, 15))
"""Ids with other numbers of parameters; a binary file of another program is only read by trying them."""
_LEAST_CY = 2.0  # pixels; a smaller absolute value is a distortion, for no picture has its middle there
_FOCAL_AND_PRINCIPAL = 4  # parameters fx, fy, cx, cy; a model of two focal lengths begins with them


class CameraVariant(NamedTuple):
    """A camera as COLMAP has it."""

    model: str
    """COLMAP's name of the model."""
    params: tuple[float, ...]
    """Parameters in COLMAP's order."""
    note: str = ""
    """What was read otherwise than it was written, without a subject; empty if nothing was."""


def cameras_alike(said: Mapping[int, str]) -> Iterator[tuple[str, list[int], str]]:
    """Yield cameras of which the same is said, as words and as ids, and that."""
    ids_of: dict[str, list[int]] = {}
    for camera_id, words in said.items():
        ids_of.setdefault(words, []).append(camera_id)
    for words, ids in ids_of.items():
        yield f"{'cameras' if len(ids) > 1 else 'camera'} {first_of([str(i) for i in ids])}", ids, words


@cache
def num_params_of_model() -> dict[int, tuple[str, int]]:
    """Return the name and the number of parameters of each camera model id that pycolmap knows."""
    models = (m for m in pycolmap.CameraModelId.__members__.values() if m != pycolmap.CameraModelId.INVALID)
    return {int(m): (m.name, len(_defaults(m.name))) for m in models}


def read_camera(model: str | int, size: tuple[float, float], params: Sequence[float]) -> CameraVariant | None:
    """Return the camera that a model's name or id and its parameters are; None if they are of no model.

    Args:
        model: name, or id in a binary file or a database.
        size: width and height of its pictures, in pixels.
        params: parameters as they were found.
    """
    known = num_params_of_model()
    name = known.get(model, ("", 0))[0] if isinstance(model, int) else model
    if (name, len(params)) in known.values():
        return CameraVariant(name, tuple(params))
    if model in _IDS_OF_SPHERES or name in _SPHERES:
        sphere = _panorama(size, params)
        if sphere is not None:
            written = name if name in _SPHERES else f"model {model}"
            note = f"{written} with {len(params)} parameters, read as EQUIRECTANGULAR {_listed(sphere)}"
            return CameraVariant(EQUIRECTANGULAR, sphere, note)
    is_known = name in (known_name for known_name, _ in known.values())
    completed = _completed(name, tuple(params)) if is_known else None
    if completed is None:
        return None
    note = f"{name} with {len(params)} parameters instead of {len(completed)}, read as {_listed(completed)}"
    return CameraVariant(name, completed, note)


def _panorama(size: tuple[float, float], params: Sequence[float]) -> tuple[float, ...] | None:
    """Return w and h of a panorama from the parameters of other programs; None if it is no panorama.

    Twice the principal point; the size of the picture where that is 0, or missing.
    """
    if len(params) not in (0, 2, 3):
        return None
    given = tuple(2.0 * x for x in params[1:]) if len(params) == 3 else tuple(params)
    given = given if given and min(given) > 0.0 else tuple(map(float, size))
    return given if min(given) > 0.0 else None


def _completed(name: str, given: tuple[float, ...]) -> tuple[float, ...] | None:
    """Return all parameters of a model of two focal lengths of which some are given; None if it is none."""
    wanted = _defaults(name)
    if wanted[:2] != (1.0, 1.0) or len(given) < _FOCAL_AND_PRINCIPAL:
        return None
    if abs(given[3]) < _LEAST_CY:
        given = (given[0], *given)
    if name == "FULL_OPENCV" and len(given) == 7:  # k1, k2, k3: OpenCV itself never gives three
        given = (*given[:6], 0.0, 0.0, given[6])
    return (*given, *wanted[len(given) :]) if len(given) <= len(wanted) else None


@cache
def _defaults(name: str) -> tuple[float, ...]:
    """Return the parameters of a lens of focal length 1 without distortion."""
    return tuple(pycolmap.Camera.create_from_model_name(1, name, 1.0, 2, 1).params.tolist())


def _listed(params: Sequence[float]) -> str:
    return " ".join(f"{value:g}" for value in params)
