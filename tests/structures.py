"""Reconstructions adjusted and triangulated through the doors to arrays, as the pipeline does it."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.adjustment import bundle_adjustment
from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.freedom import Freedom
from sfm_shapefit.adjustment.run import begin
from sfm_shapefit.adjustment.sources import Links, collect_matches, collect_tracks
from sfm_shapefit.adjustment.structure import triangulate
from sfm_shapefit.files.colmap.images import images_of, put_images
from sfm_shapefit.files.colmap.point_colors import color_points, read_colors
from sfm_shapefit.files.colmap.points import ModelKeypoints, points2d_of, points_of
from sfm_shapefit.files.colmap.reconstructions import reconstruction_of
from sfm_shapefit.files.colmap.seed import SeededModel
from sfm_shapefit.files.colmap.template import Template
from sfm_shapefit.scene.structure import Structure
from sfm_shapefit.tracks.filter import filter_points
from sfm_shapefit.tracks.structure_options import StructureOptions
from tests.models import arrays


def posed_images(model):
    """The posed images of a model, in the order of their ids, through lenses that are all in doubt."""
    every = images_of(arrays(model))
    own = every.part(np.flatnonzero(every.is_posed))
    own = own.part(np.argsort(own.ids))
    return own.with_lenses([in_doubt(lens) for lens in own.lenses])


def in_doubt(lens, focal_sigma=0.3, distortion_sigma=0.1):
    """A lens that may be off as it stands."""
    return replace(lens, given=lens.parameters, sigmas=(focal_sigma, distortion_sigma))


def copy_without_points(model):
    """A copy that has no 3D points; its points2D stay and observe nothing."""
    copy = pycolmap.Reconstruction(model)
    for point_id in list(copy.point3D_ids()):
        copy.delete_point3D(point_id)
    return copy


def colored(model, original):
    """A copy whose points have the colors of another model's."""
    copy, images = pycolmap.Reconstruction(model), posed_images(model)
    points, pixels = points_of(arrays(model), images), points2d_of(arrays(model), images)
    colors = color_points(points, images.ids.tolist(), pixels, read_colors(arrays(original)))
    for k in np.flatnonzero(colors.any(axis=1)).tolist():
        copy.point3D(int(points.ids[k])).color = colors[k]
    return copy


def pictures_of(model, images):
    """The points2D of a model."""
    return ModelKeypoints(images, points2d_of(arrays(model), images))


def links_of(model, tracks) -> Links:
    """The matches that were collected, or the tracks of another model with the same keypoints."""
    if not isinstance(tracks, pycolmap.Reconstruction):
        return tracks
    images = posed_images(model)
    return collect_tracks(images, pictures_of(model, images), points_of(arrays(tracks), images))


def matches_between(model, image_ids, batches):
    """The matches of the posed images of a model; pairs of the batches index `image_ids`."""
    images = posed_images(model)
    place = np.array([np.flatnonzero(images.ids == i).max(initial=-1) for i in image_ids.tolist()])
    room = np.empty((sum(len(batch.keypoints) for batch in batches), 2), dtype=np.uint32)
    return collect_matches(images, pictures_of(model, images), place, batches, room)


def filtered(model, options=None):
    """A copy without the points that violate the options."""
    return colored(with_points(model, points_of(arrays(model), posed_images(model)), options), model)


def with_points(model, points, options=None):
    """A copy with these points instead of its own, filtered."""
    images = posed_images(model)
    kept = filter_points(Structure(points, images, pictures_of(model, images)), options or StructureOptions())
    return put_points(model, images, kept)


def put_points(model, images, points):
    """A copy with these points instead of its own."""
    seed = SeededModel(
        template=Template(model=arrays(copy_without_points(model))),
        images=images,
        points=points,
        colors=np.zeros((points.num_points, 3), dtype=np.uint8),
        keypoints=(np.zeros((0, 2)),) * images.num_images,
    )
    return seed.reconstruction


def triangulated(seed, tracks, options=None, advance=lambda _done, _total: None):
    """A copy of a seed with the points of its matches, or of another model's tracks."""
    options, images = options or StructureOptions(), posed_images(seed)
    points = triangulate(images, links_of(seed, tracks), options, advance)
    structure = with_points(seed, points, options)
    return colored(structure, tracks) if isinstance(tracks, pycolmap.Reconstruction) else structure


class AdjustedModel(NamedTuple):
    reconstruction: pycolmap.Reconstruction
    estimate: Estimate


def placed(seed, estimate):
    """A copy of a seed where an estimate has it."""
    moved = put_images(arrays(copy_without_points(seed)), estimate.images)
    return AdjustedModel(reconstruction_of(moved), estimate)


def bundle_adjusted(seed, tracks, options=None, freedom=None):
    links, freedom = links_of(seed, tracks), freedom or Freedom()
    options = options or StructureOptions()
    images = posed_images(seed)
    estimate, points = bundle_adjustment.adjust_seed(begin(images, links, options, freedom))
    found = placed(seed, estimate)
    structure = with_points(found.reconstruction, points, options)
    if isinstance(tracks, pycolmap.Reconstruction):
        structure = colored(structure, tracks)
    return found._replace(reconstruction=structure)


def adjusted_thinly(seed, tracks, **freedom):
    """`freedom`: fields of `Freedom`."""
    free, links, images = Freedom(**freedom), links_of(seed, tracks), posed_images(seed)
    run = begin(images, links, StructureOptions(), free)
    found = bundle_adjustment.adjust_thinly(run, lenses_wanted=True)
    return placed(seed, found)


def adjusted_placement(seed, tracks, **freedom):
    """`freedom`: fields of `Freedom`; the matches decide about rotations."""
    free, links = Freedom(pull_rad=None, **freedom), links_of(seed, tracks)
    options, images = StructureOptions(), posed_images(seed)
    return placed(seed, bundle_adjustment.adjust_placement(begin(images, links, options, free)))
