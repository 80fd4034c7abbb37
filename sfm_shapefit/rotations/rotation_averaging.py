"""Rotations of cameras from relative rotations of pairs: pycolmap's rotation averaging, on plain arrays.

    minimize  sum_e rho( angle( R_ij, R_j R_i^T ) )        R_i = cam_from_world of camera i

from a maximum spanning tree, by an L1 phase and iteratively reweighted least squares. Pairs more than 10
degrees off the result are left out and what stays connected is averaged once more, as pycolmap's global
mapper does; cameras outside that component have no rotation.

Source: Chatterjee, Govindu, "Efficient and robust large-scale rotation averaging", ICCV 2013, as in GLOMAP.
"""

from typing import Literal

import numpy as np
import numpy.typing as npt
import pycolmap

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.files.colmap.database_images import rotations_of
from sfm_shapefit.files.colmap.quiet import quiet_output

Loss = Literal["geman-mcclure", "half-norm"]
"""Of the residual angles of pairs, as pycolmap names them."""

_LOSSES = {
    "geman-mcclure": pycolmap.RotationWeightType.GEMAN_MCCLURE,
    "half-norm": pycolmap.RotationWeightType.HALF_NORM,
}
# Pairs that are farther off after the first averaging are left out of the second; this is pycolmap's default.
_MAX_ERROR_DEG = 10.0


def average_rotations(
    num_images: int,
    pairs: IntArray,
    rotations: FloatArray,
    weights: npt.ArrayLike | None = None,
    *,
    loss: Loss = "geman-mcclure",
) -> tuple[FloatArray, BoolArray]:
    """Return a rotation for each image that the pairs tie to the largest consistent component.

    Args:
        num_images: n.
        pairs: (k, 2) images (i, j), i != j, each pair once.
        rotations: (k, 3, 3) cam_j_from_cam_i.
        weights: (k,) numbers of matches, rounded, of which the spanning tree takes pairs of many; all alike
            if None. Residuals count alike: so a few false pairs of many matches do less harm.
        loss: of the residual angles; "half-norm" (their square root) is finer, but fails more often.

    Returns:
        Rotations (n, 3, 3) cam_from_world, the identity where there is none, and (n,) who has one.

    Raises:
        InputError: if there are no pairs, or a pair is outside 0..n-1.
        UnsolvableError: if pycolmap finds no rotations.
    """
    if len(pairs) == 0:
        raise InputError("rotations cannot be averaged without relative rotations of pairs")
    if pairs.min() < 0 or pairs.max() >= num_images:
        raise InputError(f"relative rotations join images outside 0..{num_images - 1}")
    graph, model = pycolmap.PoseGraph(), pycolmap.Reconstruction()
    counts = np.maximum(np.rint(np.broadcast_to(1.0 if weights is None else weights, len(pairs))), 1.0)
    for (i, j), rotation, count in zip(pairs.tolist(), rotations, counts.tolist(), strict=True):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.zeros(3))
        graph.add_edge(i + 1, j + 1, pycolmap.PoseGraphEdge(cam2_from_cam1=pose, num_matches=int(count)))
    camera = pycolmap.Camera(camera_id=1, model="SIMPLE_PINHOLE", width=1, height=1, params=[1, 0, 0])
    model.add_camera_with_trivial_rig(camera)
    for image_id in range(1, num_images + 1):
        image = pycolmap.Image(name=str(image_id), camera_id=1, image_id=image_id)
        model.add_image_with_trivial_frame(image)
    options = pycolmap.RotationEstimatorOptions()
    options.random_seed = 0
    options.max_rotation_error_deg = _MAX_ERROR_DEG
    options.weight_type = _LOSSES[loss]
    with quiet_output():
        for again in (False, True):
            options.filter_unregistered = again
            if not pycolmap.run_rotation_averaging(options, graph, model, []):
                raise UnsolvableError(
                    "pycolmap's rotation averaging failed; check the relative rotations, or give rotations"
                )
    return rotations_of(model, list(range(1, num_images + 1)))
