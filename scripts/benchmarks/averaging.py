"""Rotations from pycolmap's rotation averaging, for runs that start from the matches alone.

The relative rotations are those that COLMAP's geometric verification stored for the pairs; intrinsics are
taken from a given model, so that runs on averaged and on given rotations differ in the rotations only. All
centres of the model that is made are 0. pycolmap changes a database when it opens one, so a copy is opened.

Source: Chatterjee, Govindu, "Efficient and robust large-scale rotation averaging", ICCV 2013, as in GLOMAP.
"""

import tempfile
from pathlib import Path

import numpy as np
import pycolmap

from benchmarks.glomap import copy_database, keep_frames, quiet, take_rotations

MIN_NUM_MATCHES = 15


def averaged_model(
    database: Path, model: Path, min_num_matches: int = MIN_NUM_MATCHES
) -> pycolmap.Reconstruction:
    """Return a model of the images of `model` with averaged rotations, its intrinsics and centres 0.

    Args:
        database: the COLMAP database; only a copy of it is opened.
        model: folder of the model that gives the intrinsics and the images; its poses are not used.
        min_num_matches: pairs with fewer verified matches are not averaged.

    Raises:
        RuntimeError: if pycolmap reports that the averaging failed.
    """
    reference = pycolmap.Reconstruction(str(model))
    with quiet(), tempfile.TemporaryDirectory() as folder:
        copied = pycolmap.Database.open(str(copy_database(database, Path(folder))))
        options = pycolmap.DatabaseCacheOptions()
        options.min_num_matches = min_num_matches
        cache = pycolmap.DatabaseCache.create(copied, options)
        copied.close()
        reconstruction = pycolmap.Reconstruction()
        reconstruction.load(cache)
        take_rotations(reconstruction, reference)  # for the intrinsics; the rotations are estimated anew
        keep_frames(reconstruction, ())
        graph = pycolmap.PoseGraph()
        graph.load(cache.correspondence_graph)
        settings = pycolmap.RotationEstimatorOptions()
        settings.random_seed = 0
        if not pycolmap.run_rotation_averaging(settings, graph, reconstruction, []):
            raise RuntimeError("pycolmap.run_rotation_averaging reports failure")
    for image_id in reconstruction.reg_image_ids():
        image = reconstruction.image(image_id)
        rotation = image.cam_from_world().rotation
        reconstruction.frame(image.frame_id).set_cam_from_world(
            image.camera_id, pycolmap.Rigid3d(rotation, np.zeros(3))
        )
    return reconstruction
