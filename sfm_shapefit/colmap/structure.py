"""Structure: where tracks come from, and 3D points filtered, and colored like the input's."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pycolmap

from sfm_shapefit.arrays import IntArray
from sfm_shapefit.colmap.model import UInt64Array, observed_points, points2d_xy
from sfm_shapefit.colmap.structure_options import StructureOptions
from sfm_shapefit.directions.matches import KeypointMatches
from sfm_shapefit.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageMatches:
    """The matches between images by their ids, M in all, eight bytes each."""

    image_pairs: IntArray
    """(k, 2) ids of the images of each pair."""
    offsets: IntArray
    """(k + 1,) the matches of pair p are rows offsets[p] to offsets[p + 1]."""
    keypoints: npt.NDArray[np.uint32]
    """(M, 2) index of the keypoint in the first image and in the second."""


TrackSource = ImageMatches | pycolmap.Reconstruction
"""Where tracks come from: matches, or the points of another model with the same points2D."""

Advance = Callable[[int, int], None]
"""Called with the work done so far and the work in all."""


def collect_matches(
    seed: pycolmap.Reconstruction, image_ids: IntArray, batches: Iterable[KeypointMatches]
) -> ImageMatches:
    """Return all matches between registered images; batches are consumed one at a time.

    Args:
        seed: the placed images, with the points2D that the matches refer to.
        image_ids: (n,) ids of the images that the batches' pairs index (`PosedModel.image_ids`).
        batches: matches; pairs with an image that is not registered in `seed` are skipped.

    Raises:
        InputError: if a match refers to a keypoint that its image does not have.
    """
    registered = np.isin(image_ids, sorted(seed.reg_image_ids()))
    images = [
        seed.image(i) if is_in else None for i, is_in in zip(image_ids.tolist(), registered, strict=True)
    ]
    num_keypoints = np.array([0 if image is None else image.num_points2D() for image in images])
    pairs, counts, keypoints = [], [], list[npt.NDArray[np.uint32]]()
    for batch in batches:
        kept = registered[batch.pairs].all(axis=1)
        lengths = np.diff(batch.offsets)
        ends, own = batch.pairs[kept], batch.keypoints
        if not kept.all():
            own = own[np.repeat(kept, lengths)]
        counts.append(lengths[kept])
        missing = (own >= np.repeat(num_keypoints[ends], counts[-1], axis=0)).any(axis=1)
        if missing.any():
            pair = np.repeat(np.arange(len(ends)), counts[-1])[np.argmax(missing)]
            names = " and ".join(seed.image(i).name for i in image_ids[ends[pair]].tolist())
            raise InputError(
                f"the pair {names} has matches of keypoints that do not exist; match the images again"
            )
        pairs.append(image_ids[ends])
        keypoints.append(own.astype(np.uint32))
    return ImageMatches(
        image_pairs=np.concatenate([np.zeros((0, 2), dtype=np.int64), *pairs]),
        offsets=np.append(0, np.cumsum(np.concatenate([np.zeros(0, dtype=np.int64), *counts]))),
        keypoints=_concatenate(keypoints),
    )


def _concatenate(parts: list[npt.NDArray[np.uint32]]) -> npt.NDArray[np.uint32]:
    """Return all rows (M, 2). Each part is given up once it is copied, for matches take much memory twice."""
    rows = np.empty((sum(map(len, parts)), 2), dtype=np.uint32)
    end = len(rows)
    while parts:
        part = parts.pop()
        rows[end - len(part) : end] = part
        end -= len(part)
    return rows


def filter_points(
    reconstruction: pycolmap.Reconstruction, options: StructureOptions | None = None
) -> pycolmap.Reconstruction:
    """Return a copy without the observations and points that violate `options`, its point errors updated.

    In this order: observations behind their camera or with a large reprojection error; points left with one
    observation; points without triangulation angle (the angle of a point that is not finite is NaN, which
    is none); short tracks.
    """
    result = pycolmap.Reconstruction(reconstruction)
    filter_in_place(result, options or StructureOptions())
    return result


def color_points(
    reconstruction: pycolmap.Reconstruction, source: pycolmap.Reconstruction, *, in_place: bool = False
) -> pycolmap.Reconstruction:
    """Return a copy whose points take the mean color of the source's points seen at the same points2D.

    Images take part if their points2D are the same in both, in number and coordinates. Points without
    any common observation keep their color. A source without any color costs no copy: the
    `reconstruction` itself is returned. So it is `in_place`, colored: a copy of a large one is large.
    """
    if not any(point.color.any() for point in source.points3D.values()):
        return reconstruction
    result = reconstruction if in_place else pycolmap.Reconstruction(reconstruction)
    ids, source_ids = (np.array(sorted(model.point3D_ids()), dtype=np.uint64) for model in (result, source))
    colors = np.array([source.point3D(i).color for i in source_ids.tolist()], dtype=np.float64).reshape(-1, 3)
    sums, counts = np.zeros((len(ids), 3)), np.zeros(len(ids), dtype=np.int64)
    for our, their in _common_observations(result, source):
        rows = np.searchsorted(ids, our)
        np.add.at(sums, rows, colors[np.searchsorted(source_ids, their)])
        np.add.at(counts, rows, 1)
    seen = counts > 0
    our_ids, means = ids[seen], np.rint(sums[seen] / counts[seen, None]).astype(np.uint8)
    for point_id, mean in zip(our_ids.tolist(), means, strict=True):
        result.point3D(point_id).color = mean
    return result


def filter_in_place(structure: pycolmap.Reconstruction, options: StructureOptions) -> None:
    """Do to our own `structure` what `filter_points` does to a copy; update the errors of points."""
    manager = pycolmap.ObservationManager(structure)
    manager.filter_all_points3D(options.max_reprojection_error_px, options.min_triangulation_angle_deg)
    manager.filter_points3D_with_short_tracks(options.min_track_length)


def _common_observations(
    result: pycolmap.Reconstruction, source: pycolmap.Reconstruction
) -> Iterator[tuple[UInt64Array, UInt64Array]]:
    """Yield the ids of the two points that each points2D of an image observes, if it does in both models."""
    for image_id in sorted(result.reg_image_ids()):
        if not source.exists_image(image_id):
            continue
        our, their = result.image(image_id), source.image(image_id)
        if not np.array_equal(points2d_xy(our), points2d_xy(their)):
            continue
        our_keypoints, our_ids = observed_points(our)
        their_keypoints, their_ids = observed_points(their)
        _, left, right = np.intersect1d(
            our_keypoints, their_keypoints, assume_unique=True, return_indices=True
        )
        yield our_ids[left], their_ids[right]
