"""Colors of 3D points from pictures, by COLMAP's rule: the mean of all pixels that see a point."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pycolmap

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.paths import file_of
from sfm_shapefit.files.colmap.bitmaps import read_bitmap
from sfm_shapefit.files.colmap.images import images_of
from sfm_shapefit.files.colmap.points import Keypoints, points2d_of, points_of
from sfm_shapefit.files.colmap.quiet import quiet_log, quiet_stderr
from sfm_shapefit.files.colmap.reconstructions import arrays_of
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points

Rgb = npt.NDArray[np.uint8]


class PictureFolder(NamedTuple):
    """Where the pictures of a model are, and how many threads read them."""

    folder: Path
    threads: int


def read_picture(file: Path) -> Rgb | None:
    """Return a picture (height, width, 3), red first, as COLMAP reads it; None if it is none."""
    bitmap = read_bitmap(file)
    return None if bitmap is None else np.asarray(bitmap.to_array(), dtype=np.uint8)


def colors_of_pictures(
    points: Points, images: Images, keypoints: Keypoints, known: Rgb, pictures: PictureFolder
) -> tuple[Rgb, tuple[str, ...]]:
    """Return the colors (x, 3) of points, and the names of pictures that are there but cannot be read.

    Args:
        points: of these images.
        images, keypoints: the pixels are those of the images' lenses; smaller pictures are as good.
        known: (x, 3) colors that points have; black ones have none yet.
        pictures: where they are; images without one give no color.
    """
    seen, is_open = points.points_seen(), (known == 0).all(axis=1)
    rows_of = points.rows_of_images(images.num_images)
    wanted = [(k, rows[is_open[seen[rows]]]) for k, rows in enumerate(rows_of)]
    files = {k: file_of(pictures.folder, images.names[k]) for k, rows in wanted if len(rows)}
    jobs = [(k, file, rows) for k, rows in wanted if (file := files.get(k)) is not None]
    sizes_px = images.sizes_px

    def look(job: tuple[int, Path, npt.NDArray[np.int64]]) -> FloatArray | None:
        image, file, rows = job
        xy = keypoints(image)
        picture = None if xy is None else read_picture(file)
        if xy is None or picture is None:
            return None
        return _sample(picture, xy[points.keypoints[rows]], sizes_px[image])

    sums, counts, unread = np.zeros(known.shape), np.zeros(len(known)), []
    with quiet_log(), quiet_stderr(), ThreadPoolExecutor(pictures.threads) as pool:
        for (image, _, rows), colors in zip(jobs, pool.map(look, jobs), strict=True):
            if colors is None:
                unread.append(images.names[image])
                continue
            inside = np.isfinite(colors[:, 0])
            np.add.at(sums, seen[rows[inside]], colors[inside])
            np.add.at(counts, seen[rows[inside]], 1.0)
    means = np.floor(sums / np.maximum(counts, 1.0)[:, None] + 0.5).astype(np.uint8)
    return np.where(is_open[:, None], means, known), tuple(unread)


def _sample(picture: Rgb, keypoints: FloatArray, lens_px: FloatArray) -> FloatArray:
    """Return the colors (k, 3), between centers of pixels interpolated, at keypoints (k, 2).

    Keypoints are in pixels of a lens whose pictures are `lens_px` (2,) wide and high, 0 if unknown; the
    picture may be smaller. NaN stands for those beyond the centers of the outer pixels.
    """
    size = np.array([picture.shape[1], picture.shape[0]])
    xy = keypoints * (size / lens_px if lens_px.all() else 1.0) - 0.5
    low = np.floor(xy).astype(np.int64)
    inside = np.asarray(((low >= 0) & (low + 1 < size)).all(axis=1))
    colors = np.full((len(xy), 3), np.nan)
    (x, y), (right, below) = low[inside].T, (xy - low)[inside].T[:, :, None]
    top = picture[y, x] * (1.0 - right) + picture[y, x + 1] * right
    bottom = picture[y + 1, x] * (1.0 - right) + picture[y + 1, x + 1] * right
    colors[inside] = top * (1.0 - below) + bottom * below
    return colors


def color_model(
    model: pycolmap.Reconstruction, pictures: PictureFolder
) -> tuple[pycolmap.Reconstruction, tuple[str, ...]]:
    """Return a copy whose black points have colors of pictures, and the names of unreadable ones."""
    copy, (arrays, _) = pycolmap.Reconstruction(model), arrays_of(model)
    images = images_of(arrays)
    points = points_of(arrays, images)
    known = np.array([model.point3D(i).color for i in points.ids.tolist()], dtype=np.uint8).reshape(-1, 3)
    colors, unread = colors_of_pictures(points, images, points2d_of(arrays, images), known, pictures)
    for point_id, color in zip(points.ids.tolist(), colors, strict=True):
        copy.point3D(point_id).color = color
    return copy, unread
