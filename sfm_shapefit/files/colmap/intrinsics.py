"""Intrinsics that were never measured: which they are, and focal lengths of them from the view graph.

COLMAP sets a focal length to 1.2 times the larger side of the image where it knows none, and to that of the
EXIF data where there is one. The database calls the second a prior, but such a camera has never been
calibrated either: all else is as COLMAP makes a camera, the principal point the very middle of the image and
the distortion, of a model that has some, 0 (FOV .01, EUCM 0 and 1). Where most cameras of a database were
calibrated, all were.

A fundamental matrix knows the focal lengths of its two images (Fetzer, Reisert, Kanatani, "Stable intrinsic
auto-calibration from fundamental matrices of devices with uncorrelated camera parameters", WACV 2020).
pycolmap solves for those of all pairs at once. It works on a database of its own here, with the matrices and
nothing else of the user's. Pairs whose matches fit a homography say nothing, so a camera needs others.
"""

import sqlite3
import tempfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.files.colmap.database_cameras import read_cameras
from sfm_shapefit.files.colmap.database_pairs import MAX_NUM_IMAGES
from sfm_shapefit.files.colmap.quiet import quiet_stderr
from sfm_shapefit.files.colmap.reconstructions import PYCOLMAP_ERRORS
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Lens, Origin
from sfm_shapefit.scene.matches import PairNames, indices_of_pairs
from sfm_shapefit.scene.same_images import same_images

# COLMAP's TwoViewGeometryConfiguration: essential or fundamental matrix, not a homography.
_WITH_DEPTH = (2, 3)
_FEWEST_PAIRS, _LEAST_SHARE = 5, 0.3  # pairs of a camera with depth, and their share; fewer say nothing
# Pairs of most matches that take part: 100 bytes each, and the time is in proportion to them.
_MOST_PAIRS = 50_000
_DIGITS = 8
"""Digits of the factors that pycolmap finds which are kept: it adds up in the order in which its threads end,
so the thirteenth digit differs from run to run, and an adjustment from there in more."""


class Uncalibrated(NamedTuple):
    """A camera that was never calibrated."""

    origin: Origin
    """Where its intrinsics come from."""
    database_id: int
    """Its id in the database."""
    ratio: float
    """Focal length in the database over that of the lens."""


def find_uncalibrated(
    database: DatabaseFile, images: Images, listed: frozenset[int] = frozenset()
) -> dict[int, Uncalibrated]:
    """Return the lenses of images that are the very ones which a database guessed, by their rows (l,).

    Args:
        database: has them.
        images: those of the database by name.
        listed: ids of lenses that are those of the database but for their focal lengths.

    Raises:
        InputError: if the database cannot be read.
    """
    uncalibrated: dict[int, Uncalibrated] = {}
    for number, camera in _cameras_of_lenses(database, images):
        lens = images.lenses[number]
        if number in uncalibrated or camera.model_name != lens.model:
            continue
        focal = camera.focal_length_idxs()[:1]  # none of a panorama
        if focal and (lens.parameters == tuple(camera.params.tolist()) or lens.id in listed):
            ratio = float(camera.params[focal[0]] / lens.parameters[focal[0]])
            uncalibrated[number] = Uncalibrated(_origin(camera), camera.camera_id, ratio)
    origins = [one.origin for one in uncalibrated.values()]
    known = {Origin.CALIBRATION}
    if origins.count(Origin.EXIF) < origins.count(Origin.CALIBRATION):
        # A calibration leaves the distortion as it was where the images do not tell it; EXIF does everywhere.
        known.add(Origin.EXIF)
    return {number: one for number, one in uncalibrated.items() if one.origin not in known}


def calibrated_focals(database: DatabaseFile, images: Images) -> dict[int, float]:
    """Return the focal lengths in pixels that a database has by calibration, by the rows of their lenses.

    Lenses of another size, or of another kind of projection, are those of other pictures.

    Raises:
        InputError: if the database cannot be read.
    """
    found: dict[int, float] = {}
    for number, camera in _cameras_of_lenses(database, images):
        lens = images.lenses[number]
        is_alike = (camera.width, camera.height) == (lens.width, lens.height) and (
            camera.model_name == lens.model or (lens.is_plane and Lens(camera.model_name, ()).is_plane)
        )
        if number in found or lens.is_panorama or not is_alike:
            continue
        if _origin(camera) is Origin.CALIBRATION:
            found[number] = float(camera.mean_focal_length())
    return found


def _cameras_of_lenses(database: DatabaseFile, images: Images) -> Iterator[tuple[int, pycolmap.Camera]]:
    """Yield for each image that a database has the row of its lens, and the camera there."""
    columns = ("name", "camera_id")
    rows = database.rows("images", {columns: "SELECT name, camera_id FROM images"})
    places = same_images([str(name) for name, _ in rows], images.names).places.tolist()
    camera_ids = {place: camera_id for place, (_, camera_id) in zip(places, rows, strict=True)}
    cameras = read_cameras(database).usable
    for image, number in enumerate(images.lens_of.tolist()):
        if (camera := cameras.get(camera_ids.get(image, -1))) is not None:
            yield number, camera


def fisheye_guess(camera: pycolmap.Camera) -> float:
    """Return the focal length in pixels with which 180 degrees fill the picture.

    It is written as a prior: without one COLMAP verifies pairs by a fundamental matrix of pixels, which
    fisheyes have not.
    """
    return float(max(camera.width, camera.height) / np.pi)


def _origin(camera: pycolmap.Camera) -> Origin:
    """Return where the intrinsics of a camera of a database come from, by itself alone."""
    if not camera.has_prior_focal_length or camera.mean_focal_length() == fisheye_guess(camera):
        return Origin.GUESS
    fresh = pycolmap.Camera.create_from_model_id(1, camera.model, 1.0, camera.width, camera.height)
    others = slice(len(camera.focal_length_idxs()), None)  # principal point, and coefficients if it has any
    is_untouched = bool((camera.params[others] == fresh.params[others]).all())
    return Origin.EXIF if is_untouched and len(camera.extra_params_idxs()) else Origin.CALIBRATION


def calibrate_view_graph(
    database: DatabaseFile, cameras: Collection[int], left_out: PairNames = frozenset()
) -> dict[int, float]:
    """Return by which factors the fundamental matrices of a database want other focal lengths, by camera.

    Args:
        database: has the matrices.
        cameras: that are asked, by their id there; all others are held.
        left_out: pairs of images that say nothing.

    Returns:
        The factors of those cameras whose pairs determine one.

    Raises:
        InputError: if the database cannot be read.
    """
    tables = _read_tables(database, left_out)
    doubted = _with_enough_pairs(tables, set(cameras))
    if not doubted:
        return {}
    with tempfile.TemporaryDirectory(prefix="shapefit-") as folder:
        private = Path(folder) / "database.db"
        pycolmap.Database.open(private).close()
        _fill(private, tables, doubted)
        earlier = _focal_lengths(private)
        options = pycolmap.ViewGraphCalibrationOptions()
        options.random_seed, options.reestimate_relative_pose = 0, False
        options.cross_validate_prior_focal_lengths = False
        try:
            with quiet_stderr():
                done = pycolmap.calibrate_view_graph(private, options)
        except PYCOLMAP_ERRORS:
            return {}
        after = _focal_lengths(private)
    factors = {camera: round(after[camera] / earlier[camera], _DIGITS) for camera in doubted}
    return {i: f for i, f in sorted(factors.items()) if done and np.isfinite(f) and f not in (0.0, 1.0)}


Rows = list[tuple[Any, ...]]


def _read_tables(database: DatabaseFile, left_out: PairNames) -> dict[str, Rows]:
    """Return the rows that the view graph is made of: cameras, images, and the pairs of most matches.

    Images of cameras that cannot be, and their pairs, are none of these.
    """
    most = _MOST_PAIRS + len(left_out)
    is_whole = (
        "typeof(F) = 'blob' AND length(F) = 72 AND typeof(pair_id) = 'integer' AND typeof(rows) = 'integer'"
    )
    which = f"WHERE {is_whole} ORDER BY rows DESC, pair_id LIMIT {most}"
    tables = {
        table: database.rows(table, {columns: f"SELECT {', '.join(columns)} FROM {table} {chosen}"})
        for table, columns, chosen in (
            ("images", ("image_id", "name", "camera_id"), ""),
            ("two_view_geometries", ("pair_id", "rows", "config", "F"), which),
        )
    }
    cameras = read_cameras(database).usable
    images = [row for row in tables["images"] if row[2] in cameras]
    ids = {name: image_id for image_id, name, _ in images}
    unwanted = {MAX_NUM_IMAGES * min(ends) + max(ends) for ends in indices_of_pairs(ids, left_out).tolist()}
    known = {*ids.values()}
    kept = [
        row
        for row in tables["two_view_geometries"]
        if row[0] not in unwanted and known.issuperset(divmod(row[0], MAX_NUM_IMAGES))
    ]
    rows: Rows = [
        (i, int(c.model), c.width, c.height, c.params.astype("<f8").tobytes(), 0) for i, c in cameras.items()
    ]
    return {"cameras": rows, "images": images, "two_view_geometries": kept[:_MOST_PAIRS]}


def _with_enough_pairs(tables: Mapping[str, Rows], doubted: set[int]) -> set[int]:
    """Return the cameras among those asked whose pairs have depth often enough."""
    camera_of = {image: camera for image, _, camera in tables["images"]}
    all_pairs, deep = dict.fromkeys(doubted, 0), dict.fromkeys(doubted, 0)
    for pair_id, _, config, _ in tables["two_view_geometries"]:
        for camera in doubted.intersection(camera_of.get(i, -1) for i in divmod(pair_id, MAX_NUM_IMAGES)):
            all_pairs[camera] += 1
            deep[camera] += config in _WITH_DEPTH
    return {c for c in doubted if deep[c] >= max(_FEWEST_PAIRS, _LEAST_SHARE * all_pairs[c])}


def _fill(private: Path, tables: Mapping[str, Rows], doubted: set[int]) -> None:
    """Write the view graph into an empty database of our own; what is not asked is a prior there."""
    cameras = [(*row[:5], int(row[0] not in doubted)) for row in tables["cameras"]]
    pairs = [(p, 0, 2, b"", c, f) for p, _, c, f in tables["two_view_geometries"] if c in _WITH_DEPTH]
    with closing(sqlite3.connect(private)) as opened, opened:
        opened.executemany("INSERT INTO cameras VALUES (?, ?, ?, ?, ?, ?)", cameras)
        opened.executemany(
            "INSERT INTO images (image_id, name, camera_id) VALUES (?, ?, ?)", tables["images"]
        )
        columns = "(pair_id, rows, cols, data, config, F)"
        opened.executemany(f"INSERT INTO two_view_geometries {columns} VALUES (?, ?, ?, ?, ?, ?)", pairs)


def _focal_lengths(private: Path) -> dict[int, float]:
    """Return the mean focal length of each camera of a database of our own."""
    opened = pycolmap.Database.open(private)
    try:
        return {camera.camera_id: float(camera.mean_focal_length()) for camera in opened.read_all_cameras()}
    finally:
        opened.close()
