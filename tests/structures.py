"""Reconstructions adjusted and triangulated through the doors to arrays, as the pipeline does it."""

from typing import NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.adjustment import bundle_adjustment
from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.run import GivenPoses
from sfm_shapefit.adjustment.sources import Links, collect_matches, collect_tracks
from sfm_shapefit.adjustment.structure import triangulate as triangulate_matches
from sfm_shapefit.files.colmap.filter import PointRules, filter_in_place
from sfm_shapefit.files.colmap.images import images_of, put_images
from sfm_shapefit.files.colmap.own_tracks import triangulate_own_tracks
from sfm_shapefit.files.colmap.points import ModelPictures, add_points, points_of
from sfm_shapefit.files.colmap.seed import copy_without_points
from sfm_shapefit.tracks.options import StructureOptions


def posed_images(model):
    """The posed images of a model, in the order of their ids."""
    every = images_of(model)
    own = every.part(np.flatnonzero(every.is_posed))
    return own.part(np.argsort(own.ids))


def links_of(model, tracks) -> Links:
    """The matches that were collected, or the tracks of another model with the same keypoints."""
    if not isinstance(tracks, pycolmap.Reconstruction):
        return tracks
    images = posed_images(model)
    return collect_tracks(images, ModelPictures(model, images), points_of(tracks, images))


def matches_between(model, image_ids, batches):
    """The matches of the posed images of a model; pairs of the batches index `image_ids`."""
    images = posed_images(model)
    place = np.array([np.flatnonzero(images.ids == i).max(initial=-1) for i in image_ids.tolist()])
    num_matches = sum(len(batch.keypoints) for batch in batches)
    return collect_matches(images, ModelPictures(model, images), place, batches, num_matches)


def filtered(model, options=None):
    """A copy without the points that violate the options."""
    options, copy = options or StructureOptions(), pycolmap.Reconstruction(model)
    filter_in_place(copy, rules_of(options))
    return copy


def rules_of(options):
    return PointRules(
        options.max_reprojection_error_px, options.min_triangulation_angle_deg, options.min_track_length
    )


def triangulated(seed, tracks, options=None, advance=lambda _done, _total: None, executor=None):
    """A copy of a seed with the points of its matches, or of another model's tracks."""
    options, images = options or StructureOptions(), posed_images(seed)
    own = tracks if isinstance(tracks, pycolmap.Reconstruction) else None
    if own is None:
        points = triangulate_matches(images, tracks, options, advance, executor)
    else:
        points = triangulate_own_tracks(seed, images, own, rules_of(options), advance, executor)
    copy = copy_without_points(seed)
    add_points(copy, images, points, own)
    return filtered(copy, options)


class AdjustedModel(NamedTuple):
    reconstruction: pycolmap.Reconstruction
    estimate: Estimate


def placed(seed, estimate, points=None, colors=None):
    """A copy of a seed where an estimate has it."""
    copy = copy_without_points(seed)
    put_images(copy, estimate.images)
    if points is not None:
        add_points(copy, estimate.images, points, colors)
    return AdjustedModel(copy, estimate)


def bundle_adjusted(seed, tracks, options=None, given=None):
    links = links_of(seed, tracks)
    estimate, points = bundle_adjustment.bundle_adjust(posed_images(seed), links, options, given)
    colors = tracks if isinstance(tracks, pycolmap.Reconstruction) else None
    found = placed(seed, estimate, points, colors)
    return found._replace(reconstruction=filtered(found.reconstruction, options))


def adjusted_thinly(seed, tracks, **given):
    """`given`: fields of `GivenPoses`."""
    links = links_of(seed, tracks)
    return placed(
        seed, bundle_adjustment.adjust_thinly(posed_images(seed), lambda: links, None, GivenPoses(**given))
    )


def adjusted_placement(seed, tracks, **given):
    """`given`: fields of `GivenPoses`."""
    options, links = StructureOptions(), links_of(seed, tracks)
    return placed(
        seed,
        bundle_adjustment.adjust_placement(posed_images(seed), links, options, None, GivenPoses(**given)),
    )
