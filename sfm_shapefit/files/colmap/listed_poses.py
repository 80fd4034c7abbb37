"""Lists of poses, of NeRF's programs or SLAM, as models of a database's images.

The images are found by their names. Rigs and lenses are those of the database; where it guessed a lens, the
focal length is that of the list, the median of its images, which is a guess too.
"""

from collections import Counter
from contextlib import closing
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import mean_rotation_l1
from sfm_shapefit.files.colmap.database_images import read_images
from sfm_shapefit.files.colmap.images import put_images
from sfm_shapefit.files.colmap.intrinsics import find_uncalibrated
from sfm_shapefit.files.colmap.model import ColmapModel, ModelSource, read_model
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.files.nerf import read_nerf
from sfm_shapefit.files.tum import read_tum
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.listed_poses import ListedPoses

_READERS = {".json": read_nerf, ".txt": read_tum, ".tum": read_tum}


def is_list(source: object) -> bool:
    """Return whether a source of a model is the file of a list."""
    is_named_so = isinstance(source, Path | str) and Path(source).suffix.lower() in _READERS
    return is_named_so and not Path(str(source)).is_dir()


def read_source(source: ModelSource, database: Path | str | None) -> tuple[ColmapModel, frozenset[int]]:
    """Return the model that a source is, or that a list of poses makes of the images of a database.

    With it come the ids of the cameras whose focal lengths are those of the list.

    Raises:
        InputError: as `read_model` and `read_list`.
    """
    if isinstance(source, Path | str) and is_list(source):
        model, guessed = read_list(Path(source), database)
        return read_model(model), guessed
    return read_model(source, rotations_suffice=True), frozenset()


def read_list(file: Path, database: Path | str | None) -> tuple[pycolmap.Reconstruction, frozenset[int]]:
    """Return the images of a database with the poses of a list, and ids of cameras as `read_source`.

    Images that the list lacks have no pose.

    Raises:
        InputError: if a file cannot be used, or hardly an image is in both.
    """
    if not file.is_file():
        raise InputError(f"{file} does not exist; give a COLMAP folder, transforms.json or a trajectory")
    poses = _READERS[file.suffix.lower()](file)
    if database is None:
        raise InputError(f"{file} has poses but no matches; give the database that has them (database=FILE)")
    with closing(DatabaseFile(database)) as opened:
        read = read_images(opened)
        images = read.images
        uncalibrated = find_uncalibrated(opened, images)
    rows = _find(poses.names, images.names)
    if np.sum(rows >= 0) < 2:
        raise InputError(
            f"{file} and {database} have fewer than two images in common: "
            f"{poses.names[0] if poses.names else 'none'} in the one, {images.names[0]} in the other"
        )
    model = read.template(images).build()
    put_images(model, _pose(images, rows, poses))
    lens_of = np.where(rows >= 0, images.lens_of[rows], -1)
    guessed = {
        images.lenses[k].id
        for k in uncalibrated
        if _set_focal_length(model.camera(images.lenses[k].id), poses.focal_shares[lens_of == k])
    }
    return model, frozenset(guessed)


def _pose(images: Images, rows: IntArray, poses: ListedPoses) -> Images:
    """Return images with their frames where a list (n,) has images of them, NaN where it has none.

    Args:
        images: in their frames.
        rows: (n,) which of them each pose is of; -1 where none.
        poses: n of them.
    """
    found = np.flatnonzero(rows >= 0)
    lenses, frames = images.lens_of[rows[found]], images.frame_of[rows[found]]
    turns, shifts = images.sensors.rotations[lenses], images.sensors.translations[lenses]
    own = np.swapaxes(turns, 1, 2) @ poses.rotations[found]
    places = poses.centers[found] + np.einsum("kba,kb->ka", poses.rotations[found], shifts)
    rotations, centers = (np.full_like(a, np.nan) for a in (images.frames.rotations, images.frames.centers))
    order = np.argsort(frames, kind="stable")
    known, first = np.unique(frames[order], return_index=True)
    for frame, part in zip(known.tolist(), np.split(order, first[1:]), strict=True):
        rotations[frame] = own[part[0]] if len(part) == 1 else mean_rotation_l1(own[part])
        centers[frame] = places[part].mean(axis=0)
    return images.posed(rotations, centers)


def _set_focal_length(camera: pycolmap.Camera, shares: FloatArray) -> bool:
    """Give a camera the median focal length of its images, if any is known, and return whether one is.

    `shares` (n, 2) are of width and height.
    """
    across = shares[:, 0][shares[:, 0] > 0.0]
    if not len(across):
        return False
    x = float(np.median(across)) * camera.width
    down = shares[:, 1][shares[:, 1] > 0.0]
    y = float(np.median(down)) * camera.height if len(down) else x
    params, places = camera.params.tolist(), list(camera.focal_length_idxs())
    for place, length in zip(places, (x, y) if len(places) == 2 else (0.5 * (x + y),), strict=True):
        params[place] = length
    camera.params = params
    return True


def _find(listed: tuple[str, ...], names: tuple[str, ...]) -> IntArray:
    """Return which image (n,) each listed name is of; -1 where none, or not one alone.

    By the name without more leading folders than needed, else without suffix, else, where all images have
    different numbers for names, by the number that it is. The first of two entries of an image counts.
    """
    found = np.full(len(listed), -1)
    numbers = {_number(name)[0] for name in names}
    are_numbers = len(numbers) == len(names) and not any(np.isnan(number) for number in numbers)
    for keys_of in (_tails, _stem, _number) if are_numbers else (_tails, _stem):
        keys = [keys_of(name)[0] for name in names]
        once = {key for key, count in Counter(keys).items() if count == 1}
        row_of = {key: row for row, key in enumerate(keys) if key in once}
        for k in np.flatnonzero(found < 0).tolist():
            found[k] = next((row_of[key] for key in keys_of(listed[k]) if key in row_of), -1)
    _, first = np.unique(found, return_index=True)
    found[np.setdiff1d(np.arange(len(found)), first)] = -1
    return found


def _tails(name: str) -> list[str]:
    """Return a name, and it without one leading folder after the other."""
    parts = PurePosixPath(name).parts
    return ["/".join(parts[k:]) for k in range(len(parts))]


def _stem(name: str) -> list[str]:
    """Return a name without folders and suffix; a number keeps what follows its point."""
    last = PurePosixPath(name)
    return [last.name if last.suffix[1:].isdigit() else last.stem]


def _number(name: str) -> list[float]:
    """Return the number that a name is, if it is one."""
    try:
        return [float(*_stem(name))]
    except ValueError:
        return [np.nan]  # which equals nothing
