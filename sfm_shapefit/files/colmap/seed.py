"""Seeded models: cameras, rigs and image names of the input, our poses and points."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt
import pycolmap

from sfm_shapefit.base.arrays import FloatArray, IntArray, UInt32Array
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.files.colmap.binary_records import NO_POINT, POINT2D, POINT3D
from sfm_shapefit.files.colmap.images import put_images
from sfm_shapefit.files.colmap.model_arrays import AT_ONCE, ModelArrays, Records
from sfm_shapefit.files.colmap.picture_colors import PictureFolder, color_model, colors_of_pictures
from sfm_shapefit.files.colmap.point_colors import color_points
from sfm_shapefit.files.colmap.points import Keypoints, ModelKeypoints
from sfm_shapefit.files.colmap.read_binary import read_folder
from sfm_shapefit.files.colmap.reconstructions import PYCOLMAP_ERRORS, arrays_of, reconstruction_of
from sfm_shapefit.files.colmap.template import Template
from sfm_shapefit.files.colmap.write_binary import write_binary
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points
from sfm_shapefit.scene.structure import Structure


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
        pixels = tuple(_narrowed(keypoints(k)) for k in range(images.num_images))
        colors, bare = np.zeros((points.num_points, 3), dtype=np.uint8), replace(template, colors=None)
        seed = cls(template=bare, images=images, points=points, colors=colors, keypoints=pixels)
        return replace(seed, colors=color_points(points, images.ids.tolist(), seed.pixels, template.colors))

    @cached_property
    def pixels(self) -> Callable[[int], FloatArray]:
        """What returns the points2D (k, 2) of an image by its row."""
        model, own = self.template.model, self.keypoints
        rows = model.images.rows(self.images.ids).tolist()

        def pixels(k: int) -> FloatArray:
            return (
                own[k].astype(np.float64)
                if len(own[k])
                else np.ascontiguousarray(model.keypoints(rows[k])["xy"])
            )

        return pixels

    @property
    def structure(self) -> Structure:
        """The points, and what they are seen with."""
        return Structure(self.points, self.images, ModelKeypoints(self.images, self.pixels))

    def colored(self, pictures: PictureFolder) -> tuple[Self, tuple[str, ...]]:
        """Return the model whose points without a color have that of pictures, and unreadable ones' names."""
        if "reconstruction" in vars(self):  # whoever asked for it may have changed it
            model, unread = color_model(self.reconstruction, pictures)
            fresh = replace(self)
            vars(fresh)["reconstruction"] = model
            return fresh, unread
        known = self.points, self.images, self.pixels, self.colors
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
        return reconstruction_of(self.arrays())

    def arrays(self) -> ModelArrays:
        """Return the model with its points."""
        model, keypoints = put_images(self.template.model, self.images), self._keypoints()
        every = [keypoints(row) for row in range(len(model.images.ids))]
        heads, tracks = zip((np.zeros(0, POINT3D), np.zeros((0, 2), np.uint32)), *self._blocks(), strict=True)
        return replace(
            model,
            offsets=offsets_of([len(one) for one in every]),
            points2d=np.concatenate(every),
            points=np.concatenate(heads),
            tracks=np.concatenate(tracks),
        )

    def write(self, folder: Path) -> None:
        """Write what `reconstruction` is into an existing folder, in the same bytes.

        Raises:
            InputError: if the files cannot be written, or not completely.
        """
        model = put_images(self.template.model, self.images)
        write_binary(model, folder, self._blocks(), self._keypoints())

    def _keypoints(self) -> Callable[[int], Records]:
        """Return what makes the points2D of the template's images by their rows."""
        model = self.template.model
        own = dict(
            zip(model.images.rows(self.images.ids).tolist(), range(self.images.num_images), strict=True)
        )
        rows_of, ids = list(self.points.rows_of_images(self.images.num_images)), self.points.ids
        seen = self.points.points_seen()

        def of_image(row: int) -> Records:
            k = own.get(row)
            if k is None:
                return model.keypoints(row)
            if len(xy := self.keypoints[k]):
                records = np.empty(len(xy), POINT2D)
                records["xy"], records["point3d_id"] = xy, NO_POINT
            else:
                records = model.keypoints(row).copy()
            records["point3d_id"][self.points.keypoints[rows_of[k]]] = ids[seen[rows_of[k]]]
            return records

        return of_image

    def heads(self, rows: IntArray) -> Records:
        """Return some points (r,) as `POINT3D`."""
        heads, points = np.empty(len(rows), POINT3D), self.points
        heads["id"], heads["xyz"], heads["rgb"] = points.ids[rows], points.xyz[rows], self.colors[rows]
        heads["error"] = -1.0 if points.errors_px is None else points.errors_px[rows]
        heads["length"] = points.lengths()[rows]
        return heads

    def _blocks(self) -> Iterator[tuple[Records, UInt32Array]]:
        points = self.points
        for first in range(0, points.num_points, AT_ONCE):
            rows = np.arange(first, min(first + AT_ONCE, points.num_points))
            seen = slice(int(points.offsets[first]), int(points.offsets[rows[-1] + 1]))
            tracks = np.empty((seen.stop - seen.start, 2), dtype=np.uint32)
            tracks[:, 0], tracks[:, 1] = self.images.ids[points.images[seen]], points.keypoints[seen]
            yield self.heads(rows), tracks


def _narrowed(xy: FloatArray | None) -> FloatArray | npt.NDArray[np.float32]:
    """Return pixels (k, 2) in 32 bits where these hold them, as they do those of a database; none of None."""
    if xy is None:
        return np.zeros((0, 2))
    narrow = xy.astype(np.float32)
    return narrow if (narrow == xy).all() else xy


def pick_points(model: SeededModel | ModelArrays | pycolmap.Reconstruction, most: int) -> PickedPoints:
    """Return at most so many points, evenly picked by id."""
    if isinstance(model, pycolmap.Reconstruction):
        model, _ = arrays_of(model)
    num_all = model.num_points3D() if isinstance(model, SeededModel) else len(model.points)
    count = min(num_all, most)
    rows = np.arange(count) * num_all // max(count, 1)
    heads = model.heads(rows) if isinstance(model, SeededModel) else model.points[rows]
    return PickedPoints(
        xyz=heads["xyz"].copy(),
        colors=heads["rgb"].copy(),
        lengths=heads["length"].astype(np.int64),
        errors_px=heads["error"].copy(),
        num_all=num_all,
    )


def write_model(
    model: SeededModel | ModelArrays | pycolmap.Reconstruction, folder: Path, *, text: bool = False
) -> None:
    """Write a model in COLMAP's binary format, or as text, into an existing folder.

    Text is read once more, for pycolmap, which writes it, does not notice a disk that is full.

    Raises:
        InputError: if the files cannot be written, or not completely.
    """
    if isinstance(model, SeededModel):
        model.write(folder)
        return
    if isinstance(model, pycolmap.Reconstruction):
        model, _ = arrays_of(model)
    if not text:
        write_binary(model, folder)
        return
    if broken := [name for name in model.images.names if "\n" in name or "\r" in name]:
        raise InputError(
            f"the name of image {broken[0]!r} has a line break, which a text model cannot hold; "
            "rename it, or write a binary model"
        )
    try:
        reconstruction_of(model).write_text(folder)
        read_folder(folder)
    except (InputError, *PYCOLMAP_ERRORS) as error:
        reason = f"the model in {folder} could not be written completely"
        raise InputError(f"{reason}; check the free space and permissions") from error
