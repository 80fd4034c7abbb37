"""Seeded models: cameras, rigs and image names of the input, our poses and points."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt
import pycolmap

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.files.colmap.binary_records import COUNT, IMAGE, NO_POINT, POINT2D, POINT3D
from sfm_shapefit.files.colmap.check import check_model_files
from sfm_shapefit.files.colmap.images import put_images
from sfm_shapefit.files.colmap.model import PYCOLMAP_ERRORS
from sfm_shapefit.files.colmap.picture_colors import PictureFolder, color_model, colors_of_pictures
from sfm_shapefit.files.colmap.point_colors import color_points
from sfm_shapefit.files.colmap.points import Keypoints, add_points, points2d_xy
from sfm_shapefit.files.colmap.template import Template
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points

_POINTS_AT_ONCE = 2**16  # points whose bytes are put together at once; all of 10,000 images take 70 MB


class PickedPoints(NamedTuple):
    """Some of a model's points, p of which are drawn; a `Drawing` leaves out those far outside."""

    xyz: FloatArray
    """(p, 3)"""
    colors: npt.NDArray[np.uint8]
    """(p, 3)"""
    lengths: IntArray
    """(q,) observations of those that were picked, q >= p."""
    errors_px: FloatArray
    """(q,) mean reprojection errors of these; where unknown negative, NaN in a `Drawing`."""
    num_all: int
    """Number of points that the model has."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SeededModel:
    """A model in arrays, which writes itself: as a reconstruction it takes ten times as long.

    Cameras, rigs, frames and images keep their ids and names; rotations and intrinsics that did not change
    keep their bits. Images whose frame is not placed, and images that had no pose, are unregistered.
    """

    template: Template
    """The input, without its colors."""
    images: Images
    """Images of the input, where they are placed; frames that are not are NaN."""
    points: Points
    """Points of these images; with ids of their own, ascending."""
    colors: npt.NDArray[np.uint8]
    """(x, 3)"""
    keypoints: tuple[FloatArray | npt.NDArray[np.float32], ...]
    """Pixels (k, 2) of what becomes the points2D of each image; if none, it keeps those of the template."""

    @classmethod
    def of(cls, template: Template, images: Images, points: Points, keypoints: Keypoints | None) -> Self:
        """Return a seed, with the colors that the input's points have where they are seen.

        Args:
            template, images, points: as above.
            keypoints: for matches of a database to refer to; None: those of the template.
        """
        keypoints = keypoints or (lambda _: None)
        own = tuple(_narrowed(keypoints(k)) for k in range(images.num_images))
        colors, bare = np.zeros((points.num_points, 3), dtype=np.uint8), replace(template, colors=None)
        seed = cls(template=bare, images=images, points=points, colors=colors, keypoints=own)
        return replace(seed, colors=color_points(points, images.ids.tolist(), seed._pixels, template.colors))

    @cached_property
    def _pixels(self) -> Callable[[int], FloatArray]:
        """What returns the points2D (k, 2) of an image by its row."""
        there = {image.image_id: image for image in self.template.images}
        own, ids = self.keypoints, self.images.ids.tolist()
        return lambda k: own[k].astype(np.float64) if len(own[k]) else points2d_xy(there[ids[k]])

    def colored(self, pictures: PictureFolder) -> tuple[Self, tuple[str, ...]]:
        """Return the model whose points without a color have that of pictures, and unreadable ones' names."""
        if "reconstruction" in vars(self):  # whoever asked for it may have changed it
            model, unread = color_model(self.reconstruction, pictures)
            fresh = replace(self)
            vars(fresh)["reconstruction"] = model
            return fresh, unread
        known = self.points, self.images, self._pixels, self.colors
        colors, unread = colors_of_pictures(*known, pictures)
        return replace(self, colors=colors), unread

    def num_reg_images(self) -> int:
        """Return how many images have a pose; this and the next two are as of a reconstruction."""
        return int(self.images.is_posed.sum())

    def num_points3D(self) -> int:  # noqa: N802
        """Return the number of points."""
        return self.points.num_points

    def compute_mean_reprojection_error(self) -> float:
        """Return the mean of the points' errors in pixels, 0 if there are none."""
        errors_px = self.points.errors_px
        return 0.0 if errors_px is None or not len(errors_px) else float(errors_px.mean())

    @property
    def as_it_is(self) -> Self | pycolmap.Reconstruction:
        """The reconstruction, which may have been changed, if somebody asked for it; else these arrays."""
        return self.reconstruction if "reconstruction" in vars(self) else self

    @cached_property
    def reconstruction(self) -> pycolmap.Reconstruction:
        """A new reconstruction; the input is not touched."""
        model = self._without_points()
        for image_id, xy in zip(self.images.ids.tolist(), self.keypoints, strict=True):
            if len(xy):
                image = model.image(image_id)
                image.points2D.clear()  # the setter insists on it
                image.points2D = pycolmap.Image(keypoints=xy.astype(np.float64)).points2D
        add_points(model, self.images.ids, self.points, self.colors)
        return model

    def write(self, folder: Path) -> None:
        """Write what `reconstruction` is into an existing folder, in the same bytes.

        Raises:
            InputError, OSError: if the files cannot be written, or not completely.
        """
        write_model(self._without_points(), folder)
        bare = (folder / "images.bin").read_bytes()
        with (folder / "images.bin").open("wb") as stream:
            stream.writelines(self._images_with_points(bare))
        with (folder / "points3D.bin").open("wb") as stream:
            stream.write(COUNT.pack(self.points.num_points))
            for first in range(0, self.points.num_points, _POINTS_AT_ONCE):
                stream.write(self._bytes_of_points(first, first + _POINTS_AT_ONCE))

    def _without_points(self) -> pycolmap.Reconstruction:
        """Return the model as the template has it, without points and with its own points2D."""
        model = self.template.build()
        put_images(model, self.images)
        return model

    def _images_with_points(self, bare: bytes) -> Iterator[bytes]:
        """Yield the parts of images.bin, given what it is without points."""
        row_of = {image_id: row for row, image_id in enumerate(self.images.ids.tolist())}
        rows_of, ids = self.points.rows_of_images(self.images.num_images), self.points.ids
        seen, at = self.points.points_seen(), COUNT.size
        yield bare[:at]
        while at < len(bare):
            row = row_of[int.from_bytes(bare[at : at + 4], "little")]
            end = bare.index(b"\0", at + IMAGE.size) + 1
            (count,) = COUNT.unpack_from(bare, end)
            points2d = np.frombuffer(bare, POINT2D, count, end + COUNT.size).copy()
            if len(self.keypoints[row]):
                points2d = np.empty(len(self.keypoints[row]), POINT2D)
                points2d["xy"] = self.keypoints[row]
            points2d["point3d_id"] = NO_POINT
            points2d["point3d_id"][self.points.keypoints[rows_of[row]]] = ids[seen[rows_of[row]]]
            yield from (bare[at:end], COUNT.pack(len(points2d)), points2d.tobytes())
            at = end + COUNT.size + count * POINT2D.itemsize

    def _bytes_of_points(self, first: int, last: int) -> bytes:
        """Return the records of some points in points3D.bin."""
        points, offsets = self.points, self.points.offsets[first : last + 1]
        seen, lengths = slice(int(offsets[0]), int(offsets[-1])), np.diff(offsets)
        heads = np.empty(len(lengths), POINT3D)
        heads["id"], heads["xyz"] = points.ids[first:last], points.xyz[first:last]
        heads["rgb"] = self.colors[first:last]
        heads["error"] = -1.0 if points.errors_px is None else points.errors_px[first:last]
        heads["length"] = lengths
        tracks = np.empty((seen.stop - seen.start, 2), dtype="<u4")
        tracks[:, 0], tracks[:, 1] = self.images.ids[points.images[seen]], points.keypoints[seen]
        sizes = np.column_stack([np.full(len(lengths), POINT3D.itemsize), 8 * lengths]).ravel()
        is_head = np.repeat(np.tile([True, False], len(lengths)), sizes)
        data = np.empty(len(is_head), dtype=np.uint8)
        data[is_head], data[~is_head] = heads.view(np.uint8), tracks.view(np.uint8).ravel()
        return data.tobytes()


def _narrowed(xy: FloatArray | None) -> FloatArray | npt.NDArray[np.float32]:
    """Return pixels (k, 2) in 32 bits where these hold them, as they do those of a database; none of None."""
    if xy is None:
        return np.zeros((0, 2))
    narrow = xy.astype(np.float32)
    return narrow if (narrow == xy).all() else xy


def transform_model(
    reconstruction: pycolmap.Reconstruction, similarity: Similarity
) -> pycolmap.Reconstruction:
    """Return the model under a similarity: cameras and points, and sensors in rigs if it scales."""
    copy = pycolmap.Reconstruction(reconstruction)
    rotation = pycolmap.Rotation3d(similarity.rotation)
    copy.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation))
    return copy


def pick_points(model: SeededModel | pycolmap.Reconstruction, most: int) -> PickedPoints:
    """Return at most so many points, evenly picked by id."""
    num_all = model.num_points3D()
    count = min(num_all, most)
    rows = np.arange(count) * num_all // max(count, 1)
    if isinstance(model, SeededModel):
        points, unknown = model.points, np.full(num_all, -1.0)
        return PickedPoints(
            xyz=points.xyz[rows],
            colors=model.colors[rows],
            lengths=points.lengths()[rows],
            errors_px=(unknown if points.errors_px is None else points.errors_px)[rows],
            num_all=num_all,
        )
    ids = sorted(model.point3D_ids())
    chosen = [model.point3D(ids[k]) for k in rows.tolist()]
    return PickedPoints(
        xyz=np.array([point.xyz for point in chosen]).reshape(-1, 3),
        colors=np.array([point.color for point in chosen], dtype=np.uint8).reshape(-1, 3),
        lengths=np.array([point.track.length() for point in chosen], dtype=np.int64),
        errors_px=np.array([point.error for point in chosen], dtype=np.float64),
        num_all=num_all,
    )


def write_model(model: SeededModel | pycolmap.Reconstruction, folder: Path, *, text: bool = False) -> None:
    """Write a model in COLMAP's binary or text format into an existing folder, and walk the files once more.

    pycolmap does not notice a disk that is full, hence the second look.

    Raises:
        InputError: if the files cannot be written, or are not complete afterwards.
    """
    if isinstance(model, SeededModel):
        model.write(folder)
        return
    try:
        (model.write_text if text else model.write_binary)(folder)
    except PYCOLMAP_ERRORS as error:
        raise InputError(f"{folder} cannot be written; check its permissions and the free space") from error
    try:
        check_model_files(folder)
    except InputError as error:
        raise InputError(
            f"the model in {folder} could not be written completely; check the free space"
        ) from error
