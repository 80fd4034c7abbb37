"""Private copies of models that pycolmap cannot read as they stand."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pycolmap

from sfm_shapefit.base.atomic_folder import private_folder
from sfm_shapefit.files.colmap.binary_records import COUNT, IMAGE, NO_POINT, POINT2D
from sfm_shapefit.files.colmap.camera_variants import cameras_alike
from sfm_shapefit.files.colmap.check import ModelFiles, check_cameras, write_binary_file


@contextmanager
def with_own_cameras(files: ModelFiles) -> Iterator[ModelFiles]:
    """Yield a model with cameras in COLMAP's terms: itself unless `camera_variants` reads some otherwise.

    Raises:
        InputError: as `walk_files` for the cameras.
    """
    cameras = check_cameras(files)
    changed = {camera_id: camera.read.note for camera_id, camera in cameras.items() if camera.read.note}
    if not changed:
        yield files
        return
    write = pycolmap.Reconstruction()
    for camera_id, ((width, height), read) in cameras.items():
        write.add_camera(
            pycolmap.Camera(
                camera_id=camera_id, model=read.model, width=width, height=height, params=read.params
            )
        )
    with private_folder() as own:
        write.write_binary(own)
        _link(files, own, "images", "points3D", "rigs", "frames")
        notes = (f"{alike} of the model: {note}" for alike, _, note in cameras_alike(changed))
        yield files._replace(folder=own, notes=(*files.notes, *notes))


@contextmanager
def without_points(files: ModelFiles, reason: str) -> Iterator[ModelFiles]:
    """Yield the poses of a model, whose keypoints observe nothing, with a note for that reason.

    Raises:
        InputError: if the images cannot be read.
    """
    with private_folder() as own:
        _link(files, own, "cameras", "rigs", "frames")
        write_binary_file(own / "images.bin", _bare_images(files))
        write_binary_file(own / "points3D.bin", ())
        note = f"{reason}; points and observations are left aside, poses alone are read"
        yield files._replace(folder=own, notes=(*files.notes, note))


def _bare_images(files: ModelFiles) -> Iterator[bytes]:
    """Yield the records of images, in which no keypoint observes a point."""
    file = files.open("images")
    for _ in range(file.take_count(IMAGE.size, "images")):
        head, name = file.read(IMAGE.size, "an image"), file.take_name("a name")
        count = file.take_count(POINT2D.itemsize, "points of an image")
        points = np.frombuffer(file.read(count * POINT2D.itemsize, "an image"), dtype=POINT2D).copy()
        points["point3d_id"] = NO_POINT
        yield b"".join((head, name, b"\0", COUNT.pack(count), points.tobytes()))
    file.finish()


def _link(files: ModelFiles, own: Path, *names: str) -> None:
    """Let a private folder have some files of a model."""
    for name in names:
        (own / f"{name}.bin").unlink(missing_ok=True)
        if files.has(name):
            (own / f"{name}.bin").symlink_to((files.folder / f"{name}.bin").resolve())
