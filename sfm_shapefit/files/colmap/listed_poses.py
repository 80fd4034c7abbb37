"""Lists of poses, of NeRF's programs or SLAM, as models of a database's images.

The images are found by their names. Rigs and lenses are those of the database; where it guessed a lens, that
of the list counts: as a whole if it was calibrated, else its focal length, which is a guess too.
"""

import re
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import mean_rotation_l1
from sfm_shapefit.base.wording import counted, first_of
from sfm_shapefit.files.colmap.database_images import read_images
from sfm_shapefit.files.colmap.images import put_images
from sfm_shapefit.files.colmap.intrinsics import find_uncalibrated
from sfm_shapefit.files.colmap.lenses import camera_of, lens_of
from sfm_shapefit.files.colmap.model import ColmapModel, ModelSource, read_model
from sfm_shapefit.files.colmap.model_arrays import ModelArrays
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.files.listed_names import find_images
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.scene.listed_poses import ListedPoses

_SUFFIXES = {".json", ".txt", ".tum", ".csv"}
_UNKNOWN = Lens("SIMPLE_PINHOLE", (1.0, 0.0, 0.0))  # without a size
_FOLDER = re.compile(r"^(\./)?(images/)?")
"""Where transforms.json has the images of COLMAP's workspaces."""
_MIDDLE_PX = 0.75  # pixels; the middle is half a pixel off where the first pixel's center is 0
_SAME_SHAPE = 0.01  # relative difference of aspect ratios; pictures that are shrunk differ by less


def is_list(source: object) -> bool:
    """Return whether a source of a model is a file of another program's, not a folder."""
    is_named_so = isinstance(source, Path | str) and Path(source).suffix.lower() in _SUFFIXES
    return is_named_so and not Path(str(source)).is_dir()


def read_source(
    source: ModelSource, database: Path | str | None, *, rotations_suffice: bool = False
) -> tuple[ColmapModel, frozenset[int]]:
    """Return the model that a source is, or that a list of poses makes of the images of a database.

    With it come the ids of the cameras whose focal lengths are those of the list.

    Raises:
        InputError: as `read_model` and `read_list`.
    """
    if not (isinstance(source, Path | str) and is_list(source)):
        return read_model(source, rotations_suffice=rotations_suffice), frozenset()
    model, guessed, notes = read_list(Path(source), database)
    read = read_model(model)
    return replace(read, notes=(*notes, *read.notes)), guessed


def read_by_itself(source: ModelSource, *, with_lenses: bool = False) -> ColmapModel:
    """Return the model that a source is: COLMAP's, OpenSfM's, or a list of poses, without points.

    Raises:
        InputError: as `read_model` and the readers of the formats; and if a list lacks whole lenses, which
            are wanted. Else an image without one has a lens of width 0.
    """
    if not (isinstance(source, Path | str) and is_list(source)):
        return read_model(source)
    from sfm_shapefit.files.colmap.other_programs import model_of_images, model_of_opensfm
    from sfm_shapefit.files.json_node import read_json
    from sfm_shapefit.files.opensfm import read_opensfm

    file = Path(source)
    if file.suffix.lower() == ".json" and isinstance(read_json(file), list):
        return read_model(model_of_opensfm(read_opensfm(file)))
    poses = _read_poses(file)
    lenses = [lens or _UNKNOWN for lens in poses.lenses]
    if with_lenses and _UNKNOWN in lenses:
        name = poses.names[lenses.index(_UNKNOWN)]
        raise InputError(
            f"{file} has no whole lens of {name} (w, h, fl_x and a camera_model that is read); add it"
        )
    known = list(dict.fromkeys(lenses))
    names = [_FOLDER.sub("", name.replace("\\", "/")) for name in poses.names]
    lens_of = [known.index(lens) for lens in lenses]
    images = Images.listed(names, (poses.rotations, poses.centers), lens_of, known)
    read = read_model(model_of_images(images))
    return replace(read, notes=(*poses.notes, *read.notes))


def _read_poses(file: Path) -> ListedPoses:
    from sfm_shapefit.files.nerf import read_nerf  # here: few models are lists
    from sfm_shapefit.files.tum import read_tum

    return read_nerf(file) if file.suffix.lower() == ".json" else read_tum(file)


def read_list(file: Path, database: Path | str | None) -> tuple[ModelArrays, frozenset[int], tuple[str, ...]]:
    """Return the images of a database with the poses of a list, ids of cameras as `read_source`, and notes.

    Images that the list lacks come only where another of their frame is in it.

    Raises:
        InputError: if a file cannot be used, hardly an image is in both, or two poses are of one image.
    """
    if not file.is_file():
        raise InputError(f"{file} does not exist; give a COLMAP folder, transforms.json or a trajectory")
    poses = _read_poses(file)
    if database is None:
        raise InputError(f"{file} has poses but no matches; give the database that has them (database=FILE)")
    with closing(DatabaseFile(database)) as opened:
        read = read_images(opened)
        uncalibrated = find_uncalibrated(opened, read.images)
    rows = find_images(file, poses.names, read.images.names)
    if np.sum(rows >= 0) < 2:
        raise InputError(
            f"{file} and {database} have fewer than two images in common: "
            f"{poses.names[0] if poses.names else 'none'} in the one, {read.images.names[0]} in the other"
        )
    listed = np.isin(read.images.frame_of, read.images.frame_of[rows[rows >= 0]])
    images, place = read.images.part(np.flatnonzero(listed)), np.append(np.cumsum(listed) - 1, -1)
    model = put_images(read.template(images).model, _pose(images, place[rows], poses))
    numbers = np.where(rows >= 0, read.images.lens_of[rows], -1)
    lenses, guessed = {lens.id: lens for lens in model.lenses}, set[int]()
    for k in uncalibrated:
        lens = read.images.lenses[k]
        if lens.id in lenses:
            lenses[lens.id], is_guess = _lens_by(poses, lens, np.flatnonzero(numbers == k))
            guessed |= {lens.id} if is_guess else set()
    model = replace(model, lenses=tuple(lenses.values()))
    lost = [name for name, row in zip(poses.names, rows.tolist(), strict=True) if row < 0]
    note = f"the database lacks {counted(len(lost), 'image')} of {file.name}: {first_of(lost)}"
    return model, frozenset(guessed), (*poses.notes, note) if lost else poses.notes


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
    turned = np.swapaxes(turns, 1, 2) @ poses.rotations[found]
    places = poses.centers[found] + np.einsum("kba,kb->ka", poses.rotations[found], shifts)
    rotations, centers = (np.full_like(a, np.nan) for a in (images.frames.rotations, images.frames.centers))
    order = np.argsort(frames, kind="stable")
    known, first = np.unique(frames[order], return_index=True)
    for frame, part in zip(known.tolist(), np.split(order, first[1:]), strict=True):
        rotations[frame] = turned[part[0]] if len(part) == 1 else mean_rotation_l1(turned[part])
        centers[frame] = places[part].mean(axis=0)
    return images.posed(rotations, centers)


def _lens_by(poses: ListedPoses, lens: Lens, rows: IntArray) -> tuple[Lens, bool]:
    """Return the lens that some poses of a list have in place of one, and whether that is a guess still.

    A list that has distortion, or a principal point outside of the middle, was calibrated: its lens is taken
    as a whole. Any other tells the focal length alone. Where several differ, the median counts.
    """
    lenses = [scaled for k in rows.tolist() if (scaled := _scaled(poses.lenses[k], lens)) is not None]
    same = [one.parameters for one in lenses if one.model == lenses[0].model]
    if len(lenses) == len(rows) and any(map(_is_calibrated, lenses)):
        parameters = tuple(np.median(same, axis=0).tolist())
        return replace(lens, model=lenses[0].model, parameters=parameters), False
    return _with_focal_length(lens, poses.focal_shares[rows])


def _scaled(lens: Lens | None, like: Lens) -> Lens | None:
    """Return a lens at the size of another one's pictures; None if more than their size differs."""
    if lens is None or (lens.width, lens.height) == (like.width, like.height):
        return lens
    scales = like.width / lens.width, like.height / lens.height
    if abs(scales[0] / scales[1] - 1.0) > _SAME_SHAPE:
        return None
    scaled = camera_of(lens)
    scaled.rescale(like.width, like.height)
    return lens_of(scaled)


def _is_calibrated(lens: Lens) -> bool:
    """Return whether a lens is more than a focal length."""
    if "FISHEYE" in lens.model or lens.is_panorama:
        return True
    camera = camera_of(lens)
    off_px = np.abs(camera.params[camera.principal_point_idxs()] - [0.5 * lens.width, 0.5 * lens.height])
    return bool(camera.params[camera.extra_params_idxs()].any() or off_px.max() > _MIDDLE_PX)


def _with_focal_length(lens: Lens, shares: FloatArray) -> tuple[Lens, bool]:
    """Return a lens with the median focal length of its images, if any is known, and whether one is.

    `shares` (n, 2) are of width and height.
    """
    across = shares[:, 0][shares[:, 0] > 0.0]
    if not len(across):
        return lens, False
    x = float(np.median(across)) * lens.width
    down = shares[:, 1][shares[:, 1] > 0.0]
    y = float(np.median(down)) * lens.height if len(down) else x
    parameters, places = list(lens.parameters), list(camera_of(lens).focal_length_idxs())
    for place, length in zip(places, (x, y) if len(places) == 2 else (0.5 * (x + y),), strict=True):
        parameters[place] = length
    return replace(lens, parameters=tuple(parameters)), True
