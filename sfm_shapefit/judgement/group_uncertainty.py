"""How uncertain the locations of rigid groups are, and how much each direction decides for itself.

As in `uncertainty`, with the centers f of the groups as unknowns and their scale s held: it is the unit in
which positions are given. The information about f is the Laplacian of the graph of groups, its null space the
translations alone. C = S K^-1 S^T with S = I - 1 F^T is the covariance with F^T f held fixed: the mean of the
cameras, or one group that stays where it is. All nodes of a group share its covariance.
"""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.judgement.uncertainty import CameraUncertainty, inform, scatter
from sfm_shapefit.laplacian.cholesky import CholeskyFactor, analyze, factorize
from sfm_shapefit.laplacian.selected import selected_inverse
from sfm_shapefit.laplacian.symbolic import DEFAULT_FACTOR_BYTES
from sfm_shapefit.solver.program import adjoint

_RIDGE = 1e-12  # share of each block's trace that is added; keeps the inverse finite


class GroupGauge(NamedTuple):
    """Rigid groups, and what of them is held fixed."""

    groups: RigidGroups
    share: FloatArray
    """(B,) F, not negative, with sum 1: the groups whose weighted mean is held fixed."""


def propagate_groups(
    locations: FloatArray,
    edges: IntArray,
    information: FloatArray,
    gauge: GroupGauge,
    errors: FloatArray | None = None,
    max_bytes: int = DEFAULT_FACTOR_BYTES,
) -> CameraUncertainty | None:
    """Return the uncertainty of groups from that of the directions; None if the factor is too large.

    Args:
        locations: (n, d) at the solution.
        edges: (m, 2) pairs that tie the groups, each between two of them.
        information: (m, d, d) of each direction, rad^-2; only what lies across the baseline counts.
        gauge: the groups of the nodes, and what of them is held fixed.
        errors: (m, s, d) samples of the errors of the directions in radians; independent ones if None.
        max_bytes: limit of the factor.

    Raises:
        UnsolvableError: if the groups hang loose.
    """
    groups, share = gauge
    tied = inform(locations, edges, information)
    ends = np.ascontiguousarray(groups.group_of[edges])
    plan = analyze(groups.num_groups, ends)
    if plan.num_bytes(locations.shape[1]) > max_bytes:
        return None
    factor = factorize(plan, tied.ridged(_RIDGE))
    inverse = selected_inverse(factor, ends)
    covariances = _with_fixed_mean(factor, inverse.nodes, share)
    if errors is not None:
        forces = (tied.across @ errors.transpose(0, 2, 1)) / tied.lengths[:, None, None]
        covariances = scatter(_moved(factor, ends, forces, share))
    return CameraUncertainty(
        covariances=covariances[groups.group_of],
        leverages=tied.leverages(inverse, ends),
        gauge=share[groups.group_of] > 0.0,
    )


def _with_fixed_mean(factor: CholeskyFactor, nodes: FloatArray, share: FloatArray) -> FloatArray:
    """Return the diagonal blocks of S K^-1 S^T, (B, d, d); K is regular by its grounding."""
    d = nodes.shape[1]
    fixed = share[:, None, None] * np.eye(d)
    product = factor.solve(fixed)
    middle = np.einsum("nak,nal->kl", fixed, product)
    return np.asarray(nodes - product - product.transpose(0, 2, 1) + middle)


def _moved(factor: CholeskyFactor, ends: IntArray, forces: FloatArray, share: FloatArray) -> FloatArray:
    """Return S K^-1 D^T f for each of the samples in the forces f (m, d, s), shape (B, d, s)."""
    count, d = len(share), forces.shape[1]
    flat = adjoint(np.ascontiguousarray(forces.reshape(len(ends), -1)), ends, count)
    moved = factor.solve(np.ascontiguousarray(flat.reshape(count, d, -1)))
    return np.asarray(moved - np.einsum("n,nas->as", share, moved))
