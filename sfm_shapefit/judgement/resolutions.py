"""Observations in another resolution than their cameras, recognized by the points that they see.

Programs that shrink pictures write the pixels of one size and the cameras of another. Pixels count from the
corner, so that each observation is then the projection of its point times a factor that all images share; a
wrong focal length scales from the middle instead.

Keypoints outside their picture are of another one: larger, or turned by 90 degrees, as where one program
followed the orientation in the EXIF data and another did not. Models that were undistorted have observations
outside their pictures, too, but no database with these.
"""

from collections.abc import Iterator

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.judgement.conventions import Recognized
from sfm_shapefit.judgement.evidence import OddImages
from sfm_shapefit.judgement.limits import FITTING_PX
from sfm_shapefit.judgement.reasons import Kind
from sfm_shapefit.scene.structure import Structure

_GROSS_PX = 2.0  # median reprojection error in pixels; smaller ones are no matter of the resolution
_VANISHES = 0.25  # largest share of this error that is left at the right scale; noise is less
_LEAST_CHANGE = 0.01  # relative change of the scale; sizes rounded to whole pixels make less
_FAR = 0.25  # share of the picture; nearer to its corner, noise counts for more than the scale
_OUTSIDE = 0.01  # share of observations; features are found inside, and a turn moves 4 % or more out
_MOST_IMAGES = 200  # images that are asked; a median needs no more


def recognize_sizes(sizes_px: FloatArray, database_px: FloatArray) -> Recognized | None:
    """Return in what size a database has the pictures; None if most are of the size (n, 2) of the cameras."""
    differ = np.abs(database_px / sizes_px - 1.0).max(axis=1) > _LEAST_CHANGE  # false for NaN
    if 2 * np.count_nonzero(differ) <= len(differ):
        return None
    first = int(np.argmax(differ))
    own, other = (" x ".join(f"{length:.0f}" for length in sizes[first]) for sizes in (sizes_px, database_px))
    return Recognized(
        f"the database has keypoints of pictures {other} where the camera has {own} "
        f"({np.count_nonzero(differ)} of {len(differ)} images)",
        "bring both to one resolution",
    )


def recognize_resolution(structure: Structure) -> Recognized | None:
    """Return by what factors observations are scaled; None if by none that explains their errors."""
    points, images, pictures = structure.points, structure.images, structure.pictures
    seen, rows_of, found = points.points_seen(), list(structure.rows_of_images), []
    rotations, centers, sizes_px = images.rotations, images.centers, images.sizes_px
    for k in range(0, images.num_images, -(-images.num_images // _MOST_IMAGES)):
        rows = rows_of[k]
        in_camera = (points.xyz[seen[rows]] - centers[k]) @ rotations[k].T
        both = np.stack([pictures.pixels(k, points.keypoints[rows]), pictures.project(k, in_camera)], axis=1)
        found.append(np.append(both, np.broadcast_to(sizes_px[k], (len(rows), 1, 2)), axis=1))
    pixels, projected, sizes = np.concatenate(found).transpose(1, 0, 2)
    far = (projected > _FAR * sizes) & (projected < sizes)  # false for NaN
    if not far.any(axis=0).all():
        return None
    scales = np.array([np.median(pixels[far[:, a], a] / projected[far[:, a], a]) for a in (0, 1)])
    before, after = (
        np.nanmedian(np.linalg.norm(pixels / s - projected, axis=1)) for s in (np.ones(2), scales)
    )
    if not (
        before > _GROSS_PX and after <= _VANISHES * before and np.abs(scales - 1.0).max() > _LEAST_CHANGE
    ):
        return None
    width, height = np.round(sizes[0]).astype(int).tolist()
    by = f"{scales.mean():.3g}" if np.ptp(scales) <= _LEAST_CHANGE else f"{scales[0]:.3g} and {scales[1]:.3g}"
    own = " x ".join(map(str, np.round(scales * sizes[0]).astype(int).tolist()))
    return Recognized(
        f"points2D look scaled by {by}, as those of pictures {own} where the camera has {width} x {height}: "
        f"their median reprojection error is {before:.3g} px, and {after:.1f} px at its scale",
        "bring both to one resolution",
    )


def find_outside(structure: Structure) -> Iterator[OddImages]:
    """Yield the images of lenses more than 1 % of whose observations are outside the picture."""
    images, image_of, sizes_px = structure.images, structure.points.images, structure.images.sizes_px
    asked, is_out = images.is_posed & (sizes_px > 0).all(axis=1), np.zeros(len(image_of), dtype=np.bool_)
    for axis in range(2):
        along = structure.pixels[:, axis]
        is_out |= (along < -FITTING_PX) | (along > (sizes_px[:, axis] + FITTING_PX)[image_of])
    numbers = (np.bincount(image_of[part], minlength=len(asked)) for part in (is_out, slice(None)))
    outside, every = (
        np.bincount(images.lens_of[asked], number[asked], len(images.lenses)) for number in numbers
    )
    shares = (outside / np.maximum(every, 1))[images.lens_of]
    if (odd := np.flatnonzero(images.is_posed & (shares > _OUTSIDE))).size:
        sentence = (
            "keypoints outside the picture, {} % of them: is that of another size, or turned by 90 degrees?"
        )
        yield OddImages.of_values(Kind.INPUT, images.names_of(odd), 100.0 * shares[odd], sentence)
