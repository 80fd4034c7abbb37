"""Read what the user knows of images beside their matches: positions, distances, gravity, who stays."""

from pathlib import Path

import numpy as np

from sfm_shapefit.base.arrays import BoolArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.paths import OF_DATABASE, SOLVED
from sfm_shapefit.files.colmap.control_points import read_control_points
from sfm_shapefit.files.colmap.model import ColmapModel
from sfm_shapefit.files.colmap.scale_bars import read_scale_bars
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.files.lines import text_of
from sfm_shapefit.scene.given import ControlPoints, Gravity, Known, PositionPriors
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.same_images import same_images


def read_known(
    images: Images,
    file: DatabaseFile | None,
    priors: Path | str | None = None,
    *,
    control_points: str = "",
    scale_bars: str = "",
    gravity: str = "",
) -> Known:
    """Return what files tell of images: priors, points, bars and gravity, as far as asked for."""
    return Known(
        priors=None if priors is None else read_priors(images, file, priors),
        control=_read_control(images, control_points) if control_points else None,
        bars=read_scale_bars(Path(scale_bars), images) if scale_bars else None,
        gravity=_read_gravity(images, file, gravity) if gravity else None,
    )


def read_priors(images: Images, file: DatabaseFile | None, source: Path | str) -> PositionPriors:
    """Read position priors of a table, of EXIF data in a folder, or of the database where the source says so.

    Raises:
        InputError: if the source cannot be read, or has no position of these images.
    """
    from sfm_shapefit.files.colmap.priors import database_priors, exif_priors, table_priors  # few are given

    if str(source) == OF_DATABASE:
        if file is None:
            raise InputError("there is no database whose priors could be taken; give one (database=FILE)")
        return database_priors(file, images)
    return exif_priors(Path(source), images) if Path(source).is_dir() else table_priors(Path(source), images)


def _read_control(images: Images, file: str) -> ControlPoints:
    known = read_control_points(Path(file), images)
    if reason := known.why_too_few():
        raise InputError(f"{file}: {reason}")
    return known


def _read_gravity(images: Images, file: DatabaseFile | None, source: str) -> Gravity:
    from sfm_shapefit.files.colmap.gravity import database_gravity, table_gravity  # few are given

    if source != OF_DATABASE:
        return table_gravity(Path(source), images)
    if file is None:
        raise InputError("there is no database whose gravity could be taken; give a table")
    return database_gravity(file, images)


def read_fixed_images(model: ColmapModel, fix: str) -> BoolArray:
    """Return which images (n,) are to stay where they are: of a file of names, or those that see points.

    Raises:
        InputError: if the file of their names cannot be read, a name is unknown, or nothing is left to place.
    """
    if not fix:
        return np.zeros(model.images.num_images, dtype=np.bool_)
    fixed = _solved_images(model) if fix == SOLVED else _named_images(model, Path(fix))
    if not model.images.is_posed[fixed].all():
        raise InputError("the position of a fixed camera is not known (NaN); fix others, whose position is")
    if fixed.all():
        raise InputError(
            "every posed image of the model would be fixed, so that none is left to place; name fewer, "
            "or give the new images rotations first"
        )
    return fixed


def _solved_images(model: ColmapModel) -> BoolArray:
    rows = model.arrays.images.rows(model.images.ids).tolist()
    solved = np.array([len(model.arrays.observed(row)[0]) > 0 for row in rows], dtype=np.bool_)
    if not solved.any():
        raise InputError("no image of the model observes a 3D point, so none is solved; name those to fix")
    return solved


def _named_images(model: ColmapModel, path: Path) -> BoolArray:
    fixed = np.zeros(model.images.num_images, dtype=np.bool_)
    lines = [(n, line.strip()) for n, line in enumerate(text_of(path).splitlines(), start=1)]
    listed = [(number, name) for number, name in lines if name and not name.startswith("#")]
    places, ambiguity = same_images([name for _, name in listed], model.images.names)
    for (number, name), place in zip(listed, places.tolist(), strict=True):
        if place < 0:
            why = ambiguity or "give one name per line"
            raise InputError(f"{path}, line {number}: the model has no posed image {name!r}; {why}")
        fixed[place] = True
    if not fixed.any():
        raise InputError(f"{path} names no image; give the name of one image per line")
    return fixed
