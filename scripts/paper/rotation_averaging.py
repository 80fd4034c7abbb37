"""pycolmap's rotation averaging on plain arrays, as its global mapper runs it.

    minimize  sum_e rho( angle( R_ij, R_j R_i^T ) )        R_i = cam_from_world of camera i

from a maximum spanning tree, by an L1 phase and iteratively reweighted least squares. Pairs more than 10
degrees off the result are left out and what stays connected is averaged once more; cameras outside that
component have no rotation.

Source: Chatterjee, Govindu, "Efficient and robust large-scale rotation averaging", ICCV 2013, as in GLOMAP.
"""

import numpy as np
import pycolmap

from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.rotations.averaged import AveragedRotations


def average_by_pycolmap(num_images: int, relative: RelativeRotations) -> AveragedRotations:
    """Return rotations of images; how far they can be believed is not known, and NaN.

    Raises:
        RuntimeError: if pycolmap reports that the averaging failed.
    """
    graph, model = pycolmap.PoseGraph(), pycolmap.Reconstruction()
    for (i, j), rotation, count in zip(
        relative.pairs.tolist(), relative.rotations, relative.num_matches.tolist(), strict=True
    ):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.zeros(3))
        graph.add_edge(i + 1, j + 1, pycolmap.PoseGraphEdge(cam2_from_cam1=pose, num_matches=count))
    camera = pycolmap.Camera(camera_id=1, model="SIMPLE_PINHOLE", width=1, height=1, params=[1, 0, 0])
    model.add_camera_with_trivial_rig(camera)
    for image_id in range(1, num_images + 1):
        image = pycolmap.Image(name=str(image_id), camera_id=1, image_id=image_id)
        model.add_image_with_trivial_frame(image)
    options = pycolmap.RotationEstimatorOptions()
    options.random_seed, options.max_rotation_error_deg = 0, 10.0
    options.weight_type = pycolmap.RotationWeightType.GEMAN_MCCLURE
    for again in (False, True):
        options.filter_unregistered = again
        if not pycolmap.run_rotation_averaging(options, graph, model, []):
            raise RuntimeError("pycolmap.run_rotation_averaging reports failure")
    images = [model.image(image_id) for image_id in range(1, num_images + 1)]
    registered = np.array([image.has_pose for image in images], dtype=np.bool_)
    rotations = np.tile(np.eye(3), (num_images, 1, 1))
    for k in np.flatnonzero(registered).tolist():
        rotations[k] = images[k].cam_from_world().rotation.matrix()
    unknown = np.full(num_images, np.nan)
    return AveragedRotations(
        rotations=rotations,
        registered=registered,
        sigmas_deg=unknown,
        agreements=unknown,
        best_agreements=unknown,
        share=np.nan,
        num_pairs=len(relative.pairs),
    )
