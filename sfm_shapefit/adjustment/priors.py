"""Priors on rotations, centers and lenses: their cost, gradient and curvature.

With d = log(R R_prior^T) and R <- exp(w) R, the derivative of d by w is the inverse left Jacobian of SO(3),

    J^-1 = I - [d]/2 + (1/t^2 - (1 + cos t) / (2 t sin t)) [d]^2,      t = |d|

(Sola, Deray, Atchuthan 2018, "A micro Lie theory for state estimation in robotics", eq. 146).
"""

import numpy as np

from sfm_shapefit.adjustment.layout import Layout
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.residuals import NormalEquations, Values
from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.quaternions import rotation_vectors

_SMALL_RAD = 1e-4  # below, the series: its next term is t^2 / 720 of the first


def sum_priors(problem: AdjustmentProblem, values: Values, noise_px: float) -> float:
    """Return the cost of all priors in px^2; those of fixed frames are constants and left out."""
    moves = ~problem.fixed
    total = 0.0
    if problem.rotation_prior is not None:
        d = _turns(problem, values)
        total += float(np.einsum("n,na,nab,nb->", moves, d, problem.rotation_prior.information, d))
    if problem.center_prior is not None:
        total += float(moves[problem.center_prior.indices] @ problem.center_prior.chi2(values.centers))
    if problem.lens_prior is not None:
        d = values.lenses - problem.lens_prior.values
        total += float(np.sum(_lens_information(problem) * d**2))
    return 0.5 * noise_px**2 * total


def add_priors(
    problem: AdjustmentProblem, layout: Layout, values: Values, noise_px: float, normal: NormalEquations
) -> None:
    """Add all priors to the normal equations, but for those of rotations where these are held."""
    if (centers := problem.center_prior) is not None:
        pulled = noise_px**2 * centers.information
        gradients = np.einsum("kab,kb->ka", pulled, centers.off(values.centers))
        _add(layout.node_of_frame[centers.indices], slice(0, 3), pulled, gradients, normal)
    if problem.rotation_prior is not None and layout.turns:
        d = _turns(problem, values)
        jacobian = _inverse_left_jacobians(d)
        pulled = noise_px**2 * jacobian.transpose(0, 2, 1) @ problem.rotation_prior.information
        gradients = np.einsum("nab,nb->na", pulled, d)
        _add(layout.node_of_frame, slice(3, 6), pulled @ jacobian, gradients, normal)
    if problem.lens_prior is None:
        return
    information = noise_px**2 * _lens_information(problem)
    lens, value = np.nonzero((layout.lens_slots >= 0) & (information > 0.0))
    node, slot = layout.node_of_lens[lens], layout.lens_slots[lens, value]
    pulled = information[lens, value]
    normal.nodes[node, slot, slot] += pulled
    normal.node_gradients[node, slot] += pulled * (values.lenses - problem.lens_prior.values)[lens, value]


def _add(
    nodes: IntArray, slots: slice, blocks: FloatArray, gradients: FloatArray, normal: NormalEquations
) -> None:
    """Add blocks (k, 3, 3) and gradients (k, 3) to some slots of the nodes of k frames, -1 for fixed ones."""
    moves = nodes >= 0
    normal.nodes[nodes[moves], slots, slots] += blocks[moves]
    normal.node_gradients[nodes[moves], slots] += gradients[moves]


def _lens_information(problem: AdjustmentProblem) -> FloatArray:
    """Return the information of the lens prior, (l, 8), where a parameter is one of its lens by itself."""
    assert problem.lens_prior is not None
    own = np.array([lens.own_values() for lens in problem.lenses])
    return np.where(own, problem.lens_prior.information, 0.0)


def _turns(problem: AdjustmentProblem, values: Values) -> FloatArray:
    """Return the rotation vectors from the prior's rotations, (n, 3)."""
    assert problem.rotation_prior is not None
    return rotation_vectors(values.rotations @ problem.rotation_prior.rotations.transpose(0, 2, 1))


def _inverse_left_jacobians(d: FloatArray) -> FloatArray:
    angle = np.linalg.norm(d, axis=1)
    safe = np.maximum(angle, _SMALL_RAD)
    exact = 1.0 / safe**2 - (1.0 + np.cos(safe)) / (2.0 * safe * np.sin(safe))
    factor = np.where(angle < _SMALL_RAD, 1.0 / 12.0, exact)
    cross = cross_matrices(d)
    jacobians: FloatArray = np.eye(3) - 0.5 * cross + factor[:, None, None] * (cross @ cross)
    return jacobians


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """Return the matrices [v] with [v] x = v x x, (n, 3, 3)."""
    out = np.zeros((len(vectors), 3, 3))
    out[:, 2, 1], out[:, 0, 2], out[:, 1, 0] = vectors.T
    return out - out.transpose(0, 2, 1)
