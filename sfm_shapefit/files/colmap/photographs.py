"""A COLMAP database of photographs: images and lenses, features, matches and verified pairs, by pycolmap.

Images and lenses are written first, in the order of their names, so that ids do not depend on which thread
ends first. What the database has already is not made again: a run that was interrupted goes on.
"""

import json
import os
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.executors import Advance
from sfm_shapefit.base.paths import PICTURES, TAKE_FRAMES, VIDEOS, refuse_no_folder
from sfm_shapefit.base.record import write_json
from sfm_shapefit.base.settings import flat_values, hint
from sfm_shapefit.base.wording import counted, first_of
from sfm_shapefit.files.colmap.bitmaps import earth_position, read_bitmap
from sfm_shapefit.files.colmap.intrinsics import fisheye_guess
from sfm_shapefit.files.colmap.quiet import quiet_log, quiet_stderr
from sfm_shapefit.files.colmap.reconstructions import bytes_of_name, name_of
from sfm_shapefit.files.matching_options import MATCHING_FILE, MatchingOptions
from sfm_shapefit.files.model_folder import model_folders

_UNREADABLE = frozenset({".heic", ".heif", ".dng", ".cr2", ".cr3", ".nef", ".arw", *VIDEOS})
"""Suffixes of photographs and videos that pycolmap does not read."""
_DEFAULT_FOCAL = 1.2  # picture widths; COLMAP's guess where the EXIF data have no focal length
_BLOCK = 10  # images of a block; the pairs of two blocks are written together, a few seconds' work
_POLL_S = 0.5  # seconds between two looks at how far the database is; each asks for every image
_SEED = 0  # seed of the samples that verify a pair; any will do, if it is always the same


class Photographs(NamedTuple):
    """What a folder and those below it hold."""

    names: list[str]
    """Names of the images, as COLMAP has them, in their order."""
    unread: list[str]
    """How many photographs and videos pycolmap does not read, by suffix."""


def find_photographs(folder: Path) -> Photographs:
    """Return what a folder and those below it hold.

    Raises:
        InputError: if it is no folder, or holds fewer than two images.
    """
    refuse_no_folder(folder)
    names, others = [], Counter[str]()
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for file in files:
            suffix = Path(file).suffix.lower()
            if suffix in PICTURES and not file.startswith("."):
                names.append(Path(place, file).relative_to(folder).as_posix())
            elif suffix in _UNREADABLE and not file.startswith("."):
                others[suffix] += 1
    unread = [f"{number} {suffix}" for suffix, number in sorted(others.items())]
    if len(names) < 2:
        for model in (folder, *model_folders(folder)):
            if any((model / f"images{suffix}").is_file() for suffix in (".bin", ".txt")):
                anew = f"sfm-shapefit locate {model} OUT places its images anew"
                raise InputError(f"{model} is a COLMAP model without a database.db; {anew}")
        found = "no image" if not names else f"only {names[0]}"
        advice = ["give a folder of two images or more"]
        if others:
            found += f" and {first_of(unread)}" if names else f", but {first_of(unread)}"
            advice = ["convert these to .jpg first"] if others.keys() - VIDEOS else []
            advice += [TAKE_FRAMES] if others.keys() & VIDEOS else []
        raise InputError(f"{folder} has no database.db and holds {found}; {'; '.join(advice)}")
    return Photographs(sorted(names), unread)


class _Picture(NamedTuple):
    """What decides the lens of an image, and where it was taken."""

    width: int
    height: int
    device: str | None
    """Maker and model as the EXIF data have them."""
    focal: float | None
    """Pixels, by the EXIF data."""
    position: tuple[float, float, float] | None
    """Latitude, longitude, altitude (NaN if it has none)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotographDatabase:
    """A database in the making, of the images of a folder."""

    folder: Path
    database: Path
    names: Sequence[str]
    options: MatchingOptions
    threads: int

    def write_images(self, advance: Advance) -> list[str]:
        """Write images, lenses and positions that the database lacks; return the names that cannot be read.

        Raises:
            InputError: if the database has images that the folder lacks.
        """
        known = set(self.known_names())
        if strange := sorted(known - set(self.names)):
            raise InputError(
                f"{self.database} has images that {self.folder} lacks, such as {strange[0]}; "
                "remove it, or choose another OUT"
            )
        missing = [name for name in self.names if name not in known]
        pictures = {}
        with quiet_log(), quiet_stderr(), ThreadPoolExecutor(self.threads) as pool:
            try:
                for k, picture in enumerate(pool.map(self._read, missing)):
                    pictures[missing[k]] = picture
                    advance(k + 1, len(missing))
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
            if missing:
                pool.submit(self._write, {name: one for name, one in pictures.items() if one}).result()
        return [name for name, picture in pictures.items() if picture is None]

    def _read(self, name: str) -> "_Picture | None":
        return _read(self.folder / name)

    def _write(self, pictures: dict[str, "_Picture"]) -> None:
        """Write images; in a thread, as an interrupt reaches the main one alone: all are written, or none."""
        rigs = _read_rigs(self.options)
        with quiet_log(), pycolmap.Database.open(self.database) as database:
            lenses = _Lenses(self.options, database, tuple(_prefixes_of(rigs)))
            for camera_id, image in _first_images(database).items():
                if picture := self._read(name_of(image)):
                    lenses.known[lenses.key(name_of(image), picture)] = database.read_camera(camera_id)
            with pycolmap.DatabaseTransaction(database):
                for name, picture in pictures.items():
                    _write_image(database, name, lenses.lens_of(name, picture), picture)
                pycolmap.apply_rig_config(rigs, database)  # a rig for each other lens, too

    def known_names(self) -> list[str]:
        """Return the names of the images of the database by their ids; none where it does not exist."""
        if not self.database.exists():
            return []
        with quiet_log(), pycolmap.Database.open(self.database) as database:
            return [name_of(image) for image in _images_of(database)]

    def detect(self, advance: Advance) -> None:
        """Write features of the images that have none."""
        with quiet_log(), pycolmap.Database.open(self.database) as database:
            images = _images_of(database)
            missing = [name_of(image) for image in images if not database.exists_descriptors(image.image_id)]
        if not missing:
            return
        told, reader = self.options, pycolmap.ImageReaderOptions()
        reader.camera_model = told.camera_model
        if told.mask_path:
            reader.mask_path = told.mask_path
        extraction = pycolmap.FeatureExtractionOptions(
            max_image_size=told.max_image_size, num_threads=self.threads
        )
        extraction.sift.max_num_features = told.max_num_features

        how: dict[str, Any] = {"reader_options": reader, "extraction_options": extraction}
        names: Any = [bytes_of_name(name) for name in missing]
        call = partial(pycolmap.extract_features, self.database, self.folder, names, **how)

        def count(database: pycolmap.Database) -> int:
            return sum(database.exists_descriptors(image.image_id) for image in images)

        self._watch(call, count, len(images), advance)

    def match_exhaustively(self, advance: Advance) -> None:
        """Match and verify all pairs that are not yet matched."""
        pairing = pycolmap.ExhaustivePairingOptions(block_size=_BLOCK)
        count = len(self.names)
        self._match(pycolmap.match_exhaustive, pairing, count * (count - 1) // 2, advance)

    def match_sequentially(self, advance: Advance) -> None:
        """Match and verify images near each other in the order of their names, that are not yet matched."""
        overlap, count = self.options.overlap, len(self.names)
        pairing = pycolmap.SequentialPairingOptions(overlap=overlap, quadratic_overlap=True)
        lags = {*range(1, overlap + 1), *(2**k for k in range(overlap))}
        total = sum(max(count - lag, 0) for lag in lags)
        self._match(pycolmap.match_sequential, pairing, total, advance)

    def match_pairs(self, pairs: IntArray, advance: Advance) -> None:
        """Match and verify pairs (k, 2) of images, as rows of `known_names`, that are not yet matched.

        Raises:
            InputError: if a name has a space, which COLMAP's lists of pairs cannot hold.
        """
        names = self.known_names()
        if spaced := [name for name in names if len(name.split()) != 1]:
            raise InputError(
                f"{counted(len(spaced), 'name')} such as {spaced[0]!r} have spaces, which COLMAP's lists of "
                "pairs cannot hold; rename the images, or give pairing=exhaustive"
            )
        listed = self.database.with_name(f"{self.database.name}.pairs.txt")
        lines = [f"{names[i]} {names[j]}\n" for i, j in pairs.tolist()]
        listed.write_bytes(b"".join(map(os.fsencode, lines)))
        try:
            pairing = pycolmap.ImportedPairingOptions(match_list_path=listed)
            self._match(pycolmap.match_image_pairs, pairing, len(pairs), advance)
        finally:
            listed.unlink()

    def _match(self, how: Callable[..., None], pairing: Any, total: int, advance: Advance) -> None:
        matching = pycolmap.FeatureMatchingOptions(num_threads=self.threads)
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = _SEED
        call = partial(how, self.database, matching, pairing, verification)
        self._watch(call, pycolmap.Database.num_verified_image_pairs, total, advance)

    def _watch(
        self,
        call: Callable[..., None],
        count: Callable[[pycolmap.Database], int],
        total: int,
        advance: Advance,
    ) -> None:
        """Run a call of pycolmap, say how far the database is, and stop the call where that is interrupted.

        The database is looked at by pycolmap too: where another copy of SQLite closes a file in the same
        process, the locks of this one are gone, and the file is damaged.
        """
        token = pycolmap.CancellationToken()
        with (
            quiet_log(),
            quiet_stderr(),
            ThreadPoolExecutor(1) as pool,
            pycolmap.Database.open(self.database) as database,
        ):
            future = pool.submit(call, cancellation_token=token)
            try:
                while not wait([future], _POLL_S).done:
                    advance(min(count(database), total), total)
            except BaseException:
                token.cancel()
                raise
            future.result()


def _images_of(database: pycolmap.Database) -> list[pycolmap.Image]:
    return sorted(database.read_all_images(), key=lambda image: image.image_id)


def _first_images(database: pycolmap.Database) -> dict[int, pycolmap.Image]:
    """Return the first image that each lens took; images of a lens have in common what decides it."""
    return {image.camera_id: image for image in reversed(_images_of(database))}


@dataclass(slots=True)
class _Lenses:
    """The lenses of a database in the making."""

    options: MatchingOptions
    database: pycolmap.Database
    prefixes: tuple[str, ...]
    """How the names of each sensor's images begin, if it is one of a rig."""
    known: dict[Hashable, pycolmap.Camera] = field(default_factory=dict)

    def lens_of(self, name: str, picture: _Picture) -> pycolmap.Camera:
        """Return the lens of an image, which is written if it is new."""
        key = self.key(name, picture)
        if key not in self.known:
            self.known[key] = self._write(picture)
        return self.known[key]

    def key(self, name: str, picture: _Picture) -> Hashable:
        """Return what images of one lens have in common; those of two sizes or sensors never share one."""
        mode, folder = self.options.camera_mode, name.rpartition("/")[0]
        sensor = next((prefix for prefix in self.prefixes if name.startswith(prefix)), None)
        size = sensor, picture.width, picture.height
        if mode == "per-image":
            return name
        if mode == "single":
            return size
        is_known = mode == "auto" and picture.device is not None
        return (*size, picture.device, picture.focal) if is_known else (*size, folder, picture.focal)

    def _write(self, picture: _Picture) -> pycolmap.Camera:
        size, told = (picture.width, picture.height), self.options.camera_params
        focal = picture.focal or _DEFAULT_FOCAL * max(size)
        camera = pycolmap.Camera.create_from_model_name(0, self.options.camera_model, focal, *size)
        is_fisheye = "FISHEYE" in self.options.camera_model
        if is_fisheye and not picture.focal:
            camera.focal_length = fisheye_guess(camera)
        if told:
            camera.params = _numbers(told, len(camera.params))
        camera.has_prior_focal_length = bool(told) or picture.focal is not None or is_fisheye
        camera.camera_id = self.database.write_camera(camera)
        return camera


def _read_rigs(options: MatchingOptions) -> list[pycolmap.RigConfig]:
    """Read the rigs of the options; none where they name no file.

    Raises:
        InputError: if pycolmap cannot read the file.
    """
    if not options.rig_config_path:
        return []
    path = Path(options.rig_config_path)
    if not path.is_file():
        raise InputError(f"{path} does not exist or is no file")
    try:
        with quiet_log():
            return list(pycolmap.read_rig_config(path))
    except (RuntimeError, ValueError) as error:
        raise InputError(f"{path} is no file of rigs as COLMAP's rig_configurator takes: {error}") from None


def refuse_rigs(options: MatchingOptions, names: Sequence[str]) -> None:
    """Refuse rigs that these images cannot be.

    Raises:
        InputError: if no image begins with a sensor's prefix.
    """
    path, rigs = options.rig_config_path, _read_rigs(options)
    for prefix in _prefixes_of(rigs):
        if not any(name.startswith(prefix) for name in names):
            raise InputError(f"{path}: no image begins with {prefix}; the first is {names[0]}")


def _prefixes_of(rigs: Sequence[pycolmap.RigConfig]) -> list[str]:
    """Return how the names of each sensor's images begin."""
    return [str(sensor.image_prefix) for rig in rigs for sensor in rig.cameras]


def refuse_lens(options: MatchingOptions) -> None:
    """Refuse a camera model that COLMAP has not, or parameters that are not its.

    Raises:
        InputError: a sentence that says which there are.
    """
    known = sorted(name for name in pycolmap.CameraModelId.__members__ if name != "INVALID")
    if options.camera_model not in known:
        meant = hint(options.camera_model.upper(), known)
        raise InputError(f"{options.camera_model} is no camera model of COLMAP; {meant}")
    if options.camera_params:
        camera = pycolmap.Camera.create_from_model_name(0, options.camera_model, 1.0, 2, 2)
        _numbers(options.camera_params, len(camera.params))


def _numbers(text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"camera_params must be {count} numbers separated by commas, got {text!r}")
    return values


def _read(path: Path) -> _Picture | None:
    """Read what an image says of its lens and place; None if pycolmap cannot read it."""
    bitmap = read_bitmap(path)
    if bitmap is None:
        return None
    device, focal = bitmap.exif_camera_model(), bitmap.exif_focal_length()
    return _Picture(bitmap.width, bitmap.height, device, focal, earth_position(bitmap))


def _write_image(database: pycolmap.Database, name: str, lens: pycolmap.Camera, picture: _Picture) -> None:
    """Write an image, and its position on Earth as a prior."""
    image = pycolmap.Image(name=bytes_of_name(name), camera_id=lens.camera_id)
    image.image_id = database.write_image(image)
    if picture.position is not None:
        prior = pycolmap.PosePrior(
            position=np.array(picture.position),
            coordinate_system=pycolmap.PosePriorCoordinateSystem.WGS84,
            corr_data_id=image.data_id,
        )
        database.write_pose_prior(prior)


def remember_options(database: Path, options: MatchingOptions) -> None:
    """Write with which options a database is made; InputError if it was begun with others or elsewhere."""
    record, told = database.with_name(MATCHING_FILE), flat_values(options)
    told |= {name: told[name] and os.path.abspath(told[name]) for name in ("mask_path", "rig_config_path")}
    if not database.exists():
        return write_json(told, record)
    try:
        before = json.loads(record.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise InputError(
            f"{database} was not made of images by this program; map it as it is, or choose another place"
        ) from None
    if others := [f"{name}={before.get(name)!r}" for name in told if before.get(name) != told[name]]:
        raise InputError(
            f"{database} was begun with {', '.join(others)}; give the same options, or another place"
        )
    return None
