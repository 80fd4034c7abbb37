"""A model as it stands: its points and their tracks, adjusted or asked for errors; points of its pictures."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.freedom import Freedom
from sfm_shapefit.adjustment.run import begin, solve_known_points
from sfm_shapefit.adjustment.sources import collect_matches, collect_tracks
from sfm_shapefit.adjustment.structure import triangulate
from sfm_shapefit.base.executors import Crew
from sfm_shapefit.files.colmap.images import images_of
from sfm_shapefit.files.colmap.model import ColmapModel
from sfm_shapefit.files.colmap.model_arrays import ModelArrays
from sfm_shapefit.files.colmap.points import ModelKeypoints, points2d_of, points_of
from sfm_shapefit.files.colmap.reconstructions import arrays_of, moved_reconstruction
from sfm_shapefit.judgement.pair_fits import PairFits
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import is_among
from sfm_shapefit.scene.points import Points
from sfm_shapefit.scene.structure import Structure
from sfm_shapefit.tracks.filter import filter_points
from sfm_shapefit.tracks.links import ObservedTracks
from sfm_shapefit.tracks.structure_options import StructureOptions
from sfm_shapefit.tracks.triangulation import TriangulatedPoints

if TYPE_CHECKING:
    import pycolmap


def adjust_joined(reconstruction: "pycolmap.Reconstruction", threads: int) -> "pycolmap.Reconstruction":
    """Return a model whose parts were joined, poses and points of all adjusted together.

    The scale of the loss is the one that the errors call for, as in the adjustments of `locate`: photographs
    that were adjusted with a finer one than the default of `bundle_adjust` would get worse by that.
    """
    read, _ = arrays_of(reconstruction)
    images, points, tracks = read_bundle(read)
    run = begin(images, tracks, StructureOptions(), Freedom(), crew=Crew(threads))
    run, last = solve_known_points(run, points.xyz)
    return moved_reconstruction(read, run.images, replace(points, xyz=last.points))


def read_bundle(model: ModelArrays) -> tuple[Images, Points, ObservedTracks]:
    """Return the posed images of a model in the order of their ids, its points, and the tracks of these."""
    every = images_of(model)
    images = every.part(np.flatnonzero(every.is_posed))
    images = images.part(np.argsort(images.ids))
    points = points_of(model, images)
    return (
        images,
        points,
        collect_tracks(images, ModelKeypoints(images, points2d_of(model, images)), points),
    )


def estimate_errors(model: ColmapModel) -> tuple[Images, Points, Estimate | None]:
    """Return posed images and points of a model, and what its observations tell of the errors of these."""
    if not model.num_points:
        return model.images, points_of(model.arrays, model.images), None
    images, points, tracks = read_bundle(model.arrays)
    options = StructureOptions()
    run = begin(images, tracks, options, Freedom())
    problem = run.problem(tracks, TriangulatedPoints.of_tracks(tracks, points.xyz))
    scale_px = run.choose_scale(problem) * options.max_reprojection_error_px
    return images, points, replace(run, loss_scale_px=scale_px).estimate(problem)


def points_of_pictures(source: MatchSource, fits: PairFits) -> Structure:
    """Return the points that matches make where the cameras stand, but for those of contradicting pairs."""
    images, view = source.images, source.view
    pictures = ModelKeypoints(images, view.keypoints, view.num_keypoints)
    links = view.links(chosen=~is_among(view.pairs, fits.sides[1]))
    room = np.empty((view.num_matches, 2), dtype=np.uint32)
    matches = collect_matches(images, pictures, np.arange(images.num_images), links, room)
    options = StructureOptions()
    points = triangulate(images, matches, options)
    structure = Structure(points, images, pictures)
    return replace(structure, points=filter_points(structure, options))
