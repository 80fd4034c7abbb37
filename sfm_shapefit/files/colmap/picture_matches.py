"""Features of a model's pictures and matches of chosen pairs, by pycolmap on the CPU, in a database.

Pictures are found under the names that the model has for them, else under the last part of these where only
one file has it. They are read as COLMAP reads them, no larger than 1,600 pixels. Keypoints are stored in
pixels of the model's lens; a picture of another shape than that lens is left out. Lenses are the model's, and
count as calibrated. Ids are those of the model, so that the order in which threads end decides nothing.
"""

import copy
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.executors import Advance
from sfm_shapefit.base.paths import file_of
from sfm_shapefit.files.colmap.model import ColmapModel
from sfm_shapefit.files.colmap.quiet import quiet_log
from sfm_shapefit.files.colmap.reconstructions import bytes_of_name, reconstruction_of

_LONGEST_PX = 1600  # pixels, longer side of a picture as it is read; twice as many take four times as long
_MOST_FEATURES = 4096  # keypoints of a picture, the largest ones; half of COLMAP's, in half of its time
_PICTURES_AT_ONCE = 16  # pictures between two looks at the clock: about 10 s
_PAIRS_AT_ONCE = 200  # pairs between two looks at the clock: about 10 s; the index of a picture serves many
_SAME_SHAPE = 0.01  # relative difference of aspect ratios; pictures that are shrunk differ by less
_SEED = 0  # seed of the samples that verify a pair; any will do, if it is always the same

IsOver = Callable[[], bool]
"""Whether the time that may be taken is over."""

PictureState = Literal["asked", "missing", "unreadable", "of another shape", "not asked"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureMatches:
    """A database of the pictures of a model's posed images."""

    model: ColmapModel
    database: Path
    """It is made anew."""
    threads: int
    """Threads that detect and match."""

    def detect(self, folder: Path, is_over: IsOver, advance: Advance) -> list[PictureState]:
        """Write features of the pictures, and return what became of each image.

        Pictures are read in an order that leaves those which the time allows spread over all.
        """
        names = self.model.images.names
        files = find_pictures(folder, names)
        states: list[PictureState] = ["missing" if file is None else "not asked" for file in files]
        readable = [k for k, file in enumerate(files) if file is not None]
        readable = [readable[k] for k in np.random.default_rng(_SEED).permutation(len(readable)).tolist()]
        with quiet_log(), pycolmap.Database.open(self.database) as database:
            self._write_images(database)
            for begin in range(0, len(readable), _PICTURES_AT_ONCE):
                if begin and is_over():
                    break
                some = {k: os.fsencode(files[k] or "") for k in readable[begin : begin + _PICTURES_AT_ONCE]}
                with pycolmap.DatabaseTransaction(database):
                    for k, state in zip(some, self._detect_some(database, folder, some), strict=True):
                        states[k] = state
                advance(begin + len(some), len(readable))
        return states

    def _write_images(self, database: pycolmap.Database) -> None:
        """Write lenses, rigs, images and frames as the model has them, under their ids as names."""
        arrays = self.model.arrays
        model = reconstruction_of(arrays.without_points(np.ones(len(arrays.images.ids), dtype=np.bool_)))
        ids = self.model.images.ids.tolist()
        with pycolmap.DatabaseTransaction(database):
            for camera in map(copy.copy, model.cameras.values()):
                camera.has_prior_focal_length = True
                database.write_camera(camera, use_camera_id=True)
            for rig in model.rigs.values():
                database.write_rig(rig, use_rig_id=True)
            for image_id in ids:
                camera_id = model.image(image_id).camera_id
                image = pycolmap.Image(name=str(image_id), camera_id=camera_id, image_id=image_id)
                database.write_image(image, use_image_id=True)
            for frame_id in dict.fromkeys(model.image(image_id).frame_id for image_id in ids):
                database.write_frame(model.frame(frame_id), use_frame_id=True)

    def _detect_some(
        self, database: pycolmap.Database, folder: Path, files: Mapping[int, Any]
    ) -> Iterator[PictureState]:
        """Write features of some pictures, and yield what became of each."""
        scratch = self.database.with_name("some.db")
        scratch.unlink(missing_ok=True)
        options = pycolmap.FeatureExtractionOptions(max_image_size=_LONGEST_PX, num_threads=self.threads)
        options.sift.max_num_features = _MOST_FEATURES
        pycolmap.extract_features(
            scratch,
            folder,
            list(files.values()),
            camera_mode=pycolmap.CameraMode.PER_IMAGE,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        images = self.model.images
        with pycolmap.Database.open(scratch) as found:
            for k, file in files.items():
                image = found.read_image_with_name(file)
                if image is None or not found.exists_keypoints(image.image_id):
                    yield "unreadable"
                    continue
                taken, lens = found.read_camera(image.camera_id), images.lenses[images.lens_of[k]]
                scale = np.array([lens.width / taken.width, lens.height / taken.height])
                if abs(scale[0] / scale[1] - 1.0) > _SAME_SHAPE:
                    yield "of another shape"
                    continue
                keypoints = found.read_keypoints(image.image_id)[:, :2] * scale
                database.write_keypoints(int(images.ids[k]), keypoints.astype(np.float32))
                database.write_descriptors(int(images.ids[k]), found.read_descriptors(image.image_id))
                yield "asked"

    def match(self, pairs: IntArray, is_over: IsOver, advance: Advance) -> int:
        """Match pairs (k, 2) of images, verify them by the model's lenses, and return how many were asked."""
        listed, ids = self.database.with_name("pairs.txt"), self.model.images.ids
        matching = pycolmap.FeatureMatchingOptions(num_threads=self.threads, use_gpu=False)
        pairing = pycolmap.ImportedPairingOptions(match_list_path=listed)
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = _SEED
        for begin in range(0, len(pairs), _PAIRS_AT_ONCE):
            if begin and is_over():
                return begin
            some = pairs[begin : begin + _PAIRS_AT_ONCE]
            listed.write_text("".join(f"{i} {j}\n" for i, j in ids[some].tolist()))
            with quiet_log():
                pycolmap.match_image_pairs(
                    self.database, matching, pairing, verification, device=pycolmap.Device.cpu
                )
            advance(begin + len(some), len(pairs))
        return len(pairs)

    def name_images(self) -> None:
        """Give the images of the database their names; a list of pairs takes none with spaces."""
        with quiet_log(), pycolmap.Database.open(self.database) as database:
            for image_id, name in zip(self.model.images.ids.tolist(), self.model.images.names, strict=True):
                image = database.read_image(image_id)
                image.name = bytes_of_name(name)  # type: ignore[assignment]
                database.update_image(image)


def read_descriptors(path: Path, most: int, ids: Sequence[int] | None = None) -> list[IntArray]:
    """Return the SIFT descriptors (k, 128) of images, of all by ids if None, those of large features."""
    with quiet_log(), pycolmap.Database.open(path) as database:
        every = sorted(image.image_id for image in database.read_all_images()) if ids is None else ids
        return [
            database.read_descriptors(i).data[:most].astype(np.int64)
            if database.exists_descriptors(i)
            else np.zeros((0, 128), dtype=np.int64)
            for i in every
        ]


def find_pictures(folder: Path, names: tuple[str, ...]) -> list[Path | None]:
    """Return the file of each image, relative to the folder; None without one, or if others have it too."""
    root = folder.resolve()
    found = [file_of(folder, name) for name in names]
    by_name: dict[str, list[Path]] = {}
    if None in found:
        for place, _, files in os.walk(root):
            for file in files:
                by_name.setdefault(file, []).append(Path(place, file))
    alone = {name: paths[0] for name, paths in by_name.items() if len(paths) == 1}
    found = [
        file or alone.get(name.replace("\\", "/").rsplit("/", 1)[-1])
        for file, name in zip(found, names, strict=True)
    ]
    counts = {file: found.count(file) for file in set(found)}
    return [None if file is None or counts[file] > 1 else file.relative_to(root) for file in found]
