"""Relative rotations of the frames of rigs, from those of their images.

With S_i the rotation of image i's sensor in its rig, cam_i_from_world is S_i F_a for the frame a of i. A pair
of images of two frames says of these

    F_b F_a^T = S_j^T R_ij S_i,        information S_j^T Omega S_j (w in axes of the rig of b).

Several pairs of images see the same two frames. The one with most support leads; those within 5 degrees of it
are joined with it by their information, the others have no part: of two bodies of opinion, one is kept.
Images need no pair inside their frame: sensors that look opposite ways are tied by their rig alone.
"""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, sum_by
from sfm_shapefit.base.geometry import rotation_angles_deg
from sfm_shapefit.base.quaternions import rotation_vectors, rotations_of
from sfm_shapefit.pairs.relative_rotations import AGREEMENT_DEG, RelativeRotations


def relative_rotations_of_frames(
    relative: RelativeRotations, frame_of_image: IntArray, sensor_rotations: FloatArray
) -> RelativeRotations:
    """Return the relative rotations of frames, each pair once; pairs inside a frame say nothing of frames.

    `frame_of_image` is (n,) in 0..f-1, `sensor_rotations` (n, 3, 3) sensor_from_rig of each image. Where each
    image is its own frame, `relative` is the answer as it is.
    """
    is_rigged = (frame_of_image != np.arange(len(frame_of_image))).any()
    if not (is_rigged or (sensor_rotations != np.eye(3)).any()):
        return relative
    frames = frame_of_image[relative.pairs]
    between = relative.subset(frames[:, 0] != frames[:, 1])
    i, j = between.pairs.T
    rotations = sensor_rotations[j].transpose(0, 2, 1) @ between.rotations @ sensor_rotations[i]
    information = sensor_rotations[j].transpose(0, 2, 1) @ between.information @ sensor_rotations[j]
    pairs = frame_of_image[between.pairs]
    back = pairs[:, 0] > pairs[:, 1]
    # (exp(w) R)^T = exp(-R^T w) R^T
    inverse = rotations.transpose(0, 2, 1)
    turned = inverse @ information @ rotations
    return _join(
        RelativeRotations(
            pairs=np.sort(pairs, axis=1),
            rotations=np.where(back[:, None, None], inverse, rotations),
            information=np.where(back[:, None, None], turned, information),
            num_matches=between.num_matches,
            weight_shares=between.weight_shares,
        )
    )


def _join(several: RelativeRotations) -> RelativeRotations:
    supports = several.weight_shares * several.num_matches
    ordered = several.subset(np.lexsort((-supports, several.pairs[:, 1], several.pairs[:, 0])))
    pairs, first, group = np.unique(ordered.pairs, axis=0, return_index=True, return_inverse=True)
    group = group.ravel()
    lead = ordered.rotations[first]
    off = ordered.rotations @ lead[group].transpose(0, 2, 1)
    agreeing = rotation_angles_deg(off) <= AGREEMENT_DEG
    weight = np.where(agreeing[:, None, None], ordered.information, 0.0)
    vectors = rotation_vectors(off)
    information = sum_by(group, weight.reshape(-1, 9), len(pairs)).reshape(-1, 3, 3)
    pull = sum_by(group, np.einsum("kab,kb->ka", weight, vectors), len(pairs))
    turns = np.linalg.solve(information, pull[:, :, None])[:, :, 0]
    counts = np.where(agreeing, ordered.num_matches, 0)
    num_matches = np.bincount(group, counts, len(pairs)).astype(np.int64)
    return RelativeRotations(
        pairs=pairs,
        rotations=rotations_of(np.asarray(turns, dtype=np.float64)) @ lead,
        information=information,
        num_matches=num_matches,
        weight_shares=np.bincount(group, counts * ordered.weight_shares, len(pairs)) / num_matches,
    )
