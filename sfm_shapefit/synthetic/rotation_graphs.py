"""Relative rotations of bare graphs whose truth is known: noisy ones of known covariance, and wrong ones.

A pair has 15 matches or more. A right one has errors of about 0.3 deg for 100 matches, less for more, of
different size along three random axes, and states their covariance. A wrong one is a random rotation; it has
fewer matches, of which it explains less, and its information says as much as that of a right one.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.pairs.relative_rotations import RelativeRotations

_NOISE_OF_100_MATCHES_DEG = 0.3  # degrees, of a relative rotation; falls with the root of the matches


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RotationProblem:
    """Relative rotations with the answer."""

    relative: RelativeRotations
    rotations: FloatArray
    """(n, 3, 3) the true cam_from_world."""
    wrong: BoolArray
    """(k,) which pairs are wrong."""


def rotation_problem(
    num_images: int, pairs: IntArray, *, wrong_share: float = 0.2, noise: float = 1.0, seed: int = 0
) -> RotationProblem:
    """Return relative rotations of the pairs of a graph.

    Args:
        num_images: n.
        pairs: (k, 2) such as the edges of `ring_graph_problem(n).view_graph`; each pair once.
        wrong_share: share of the pairs that are wrong.
        noise: factor of the errors of right pairs; the information always is that of factor 1.
        seed: seed of all draws.
    """
    rng, k = np.random.default_rng(seed), len(pairs)
    pairs = np.sort(np.asarray(pairs, dtype=np.int64), axis=1)
    truth = Rotation.random(num_images, random_state=rng)
    wrong = rng.uniform(size=k) < wrong_share
    matches = 15 + np.exp(np.where(wrong, 3.6, 4.6) + 0.6 * rng.normal(size=k)).astype(np.int64)
    shares = np.where(wrong, rng.uniform(0.5, 0.9, k), rng.uniform(0.75, 1.0, k))
    axes = Rotation.random(k, random_state=rng).as_matrix()
    level = (
        np.radians(_NOISE_OF_100_MATCHES_DEG) * np.sqrt(100.0 / matches) * np.exp(0.3 * rng.normal(size=k))
    )
    sigmas = level[:, None] * np.exp(0.5 * rng.normal(size=(k, 3)))
    errors = np.einsum("kab,kb->ka", axes, noise * sigmas * rng.normal(size=(k, 3)))
    right = Rotation.from_rotvec(errors) * truth[pairs[:, 1]] * truth[pairs[:, 0]].inv()
    rotations = right.as_matrix()
    rotations[wrong] = Rotation.random(int(wrong.sum()), random_state=rng).as_matrix() if wrong.any() else 0.0
    relative = RelativeRotations(
        pairs=pairs,
        rotations=rotations,
        information=np.einsum("kab,kb,kcb->kac", axes, sigmas**-2, axes),
        num_matches=matches,
        weight_shares=shares,
    )
    return RotationProblem(relative=relative, rotations=truth.as_matrix(), wrong=wrong)
