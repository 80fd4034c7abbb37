"""Models whose cameras other programs wrote, for pycolmap to read."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pycolmap

from sfm_shapefit.base.wording import first_of
from sfm_shapefit.files.colmap.check import check_camera_lines, check_cameras
from sfm_shapefit.files.model_folder import REQUIRED_FILES


@contextmanager
def with_own_cameras(folder: Path, suffix: str) -> Iterator[tuple[Path, tuple[str, ...]]]:
    """Yield a folder with the same model in COLMAP's terms, and what was read otherwise than it stands.

    That is the folder itself unless `camera_variants` reads some camera otherwise.

    Raises:
        InputError: as `check_model_files` for the cameras.
    """
    check = check_cameras if suffix == ".bin" else check_camera_lines
    cameras = check(folder / f"cameras{suffix}")
    ids_of: dict[str, list[str]] = {}
    for camera_id, camera in cameras.items():
        if camera.read.note:
            ids_of.setdefault(camera.read.note, []).append(str(camera_id))
    if not ids_of:
        yield folder, ()
        return
    with tempfile.TemporaryDirectory(prefix="shapefit-") as name:
        own, write = Path(name), pycolmap.Reconstruction()
        for camera_id, ((width, height), read) in cameras.items():
            write.add_camera(
                pycolmap.Camera(
                    camera_id=camera_id, model=read.model, width=width, height=height, params=read.params
                )
            )
        (write.write_binary if suffix == ".bin" else write.write_text)(own)
        for part in ("rigs", "frames", *REQUIRED_FILES[1:]):
            (own / f"{part}{suffix}").unlink(missing_ok=True)
            if (folder / f"{part}{suffix}").exists():
                (own / f"{part}{suffix}").symlink_to((folder / f"{part}{suffix}").resolve())
        yield (
            own,
            tuple(
                f"{'cameras' if len(ids) > 1 else 'camera'} {first_of(ids)} of the model: {note}"
                for note, ids in ids_of.items()
            ),
        )
