"""Least squares on the parts of the baselines that are orthogonal to their directions.

    minimize  sum_e w_e ||P_e (t_i - t_j)||^2    subject to  sum_i t_i = 0,  sum_i ||t_i||^2 = 1

is the smallest eigenvector, shifts aside, of the projected Laplacian D^T P D. Its residuals are lengths, so
that long baselines count more; reweighting by 1 / ||t_i - t_j||^2 turns them into sines of angles.

Sources: Brand, Antone and Teller, "Spectral solution of large-scale extrinsic camera calibration as a graph
embedding problem", ECCV 2004; the reweighting: Govindu, "Combining two-view constraints for motion
estimation", CVPR 2001.
"""

import numpy as np
from scipy.sparse import csc_array, eye_array
from scipy.sparse.linalg import splu

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.baselines.normalize import normalize_locations
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.operators import laplacian_matrix
from sfm_shapefit.solver.program import differences

_DENSE_UNKNOWNS = 600
# This share of the mean diagonal is added to it, so that the singular matrix has a factor.
_SHIFT = 1e-10
_INVERSE_STEPS = 200
# Inverse iteration ends when the cosine between two steps is so near to one.
_ALIGNED = 1e-15
# Lengths count as at least this share of the median: a baseline that shrinks to nothing must not take all
# weight.
_SHORTEST = 1e-3


def locate_least_squares(graph: ViewGraph, reweightings: int = 0) -> FloatArray:
    """Return the least squares locations.

    Args:
        graph: n cameras, any dimension; its pairs should be parallel rigid.
        reweightings: solves after the first, with weights of the last lengths (Govindu); 10 is plenty.

    Returns:
        (n, d) locations, centered and of unit norm.
    """
    projections = np.eye(graph.dimension) - np.einsum("ea,eb->eab", graph.directions, graph.directions)
    weights = graph.weights
    for left in range(reweightings, -1, -1):
        t = _smallest_eigenvector(graph, weights[:, None, None] * projections)
        if left:
            lengths = np.linalg.norm(differences(t, graph.edges), axis=1)
            weights = graph.weights / np.maximum(lengths, _SHORTEST * np.median(lengths)) ** 2
            weights = weights / weights.mean()
    return normalize_locations(graph, t)


def _smallest_eigenvector(graph: ViewGraph, blocks: FloatArray) -> FloatArray:
    """Return the eigenvector (n, d) of the smallest eigenvalue of the block Laplacian, shifts aside."""
    n, d = graph.num_nodes, graph.dimension
    matrix = csc_array(laplacian_matrix(n, graph.edges, blocks))
    shifts = np.tile(np.eye(d), (n, 1)) / np.sqrt(n)
    size = float(matrix.diagonal().mean())
    if n * d <= _DENSE_UNKNOWNS:
        lifted = matrix.toarray() + 10.0 * n * size * shifts @ shifts.T
        return np.asarray(np.linalg.eigh(lifted)[1][:, 0].reshape(n, d))
    factor = splu(
        (matrix + _SHIFT * size * eye_array(n * d, format="csc")).tocsc(), permc_spec="MMD_AT_PLUS_A"
    )

    x = np.random.default_rng(0).standard_normal(n * d)
    for _ in range(_INVERSE_STEPS):
        last = x
        x = factor.solve(x - shifts @ (shifts.T @ x))
        x = x / np.linalg.norm(x)
        if abs(abs(float(x @ last)) - 1.0) < _ALIGNED:
            break
    return np.asarray(x.reshape(n, d))
