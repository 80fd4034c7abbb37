"""What the literature compares with, on a `ViewGraph`: three other programs, and two filters of wrong pairs.

Programs return (n, d) locations, centered, of unit norm, and pointing the way the directions do. Filters
return (m,) whether a pair is kept; what they leave is a graph for any program, ShapeFit's too.

Sources
    least squares   Brand, Antone, Teller, "Spectral solution of large-scale extrinsic camera calibration as a
                    graph embedding problem", ECCV 2004; reweighted by lengths: Govindu, "Combining two-view
                    constraints for motion estimation", CVPR 2001
    l_inf           Kahl, "Multiple view geometry and the L-infinity norm", ICCV 2005; in this form: Moulon,
                    Monasse, Marlet, "Global fusion of relative motions", ICCV 2013, eq. 7
    LUD             Ozyesil, Singer, "Robust camera location estimation by convex programming", CVPR 2015
    1DSfM           Wilson, Snavely, "Robust global translations with 1DSfM", ECCV 2014, section 4
    triangles       Shi, Lerman, CVPR 2018; the scores are those of `sfm_shapefit.graph.triangle_scores`
"""

import numpy as np
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import splu

from harness.graphs import laplacian_matrix
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.graph.triangle_scores import triangle_scores
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.operators import adjacency
from sfm_shapefit.solver.program import differences, projected_length
from sfm_shapefit.solver.splitting.lud import solve_lud

# Unknowns up to which the smallest eigenvector is that of a dense matrix.
_DENSE_UNKNOWNS = 600
# Share of the mean diagonal that is added to it, so that the singular matrix has a factor.
_SHIFT = 1e-10
_INVERSE_STEPS = 200
# Cosine between two steps of inverse iteration at which it ends.
_ALIGNED = 1e-15
# Least length, as a share of the median: a baseline that shrinks to nothing must not take all weight.
_SHORTEST = 1e-3
# Steps of LUD to its optimum; as a start of a refinement 50 suffice.
_LUD_STEPS = 5000
_AXES = 48
# Standard deviation of the axes about the directions that they are drawn from: others separate no cameras.
_JITTER = 0.3
# Mean length, per axis, of the projections that contradict the order: the paper's threshold.
_CONTRADICTING = 0.1
# Score of a pair in its triangles, rad, between those of wrong pairs, around one, and of noisy ones.
_OFF_TRIANGLES_RAD = 0.2


def locate_least_squares(graph: ViewGraph, reweightings: int = 0) -> FloatArray:
    """Minimize  sum_e w_e ||P_e (t_i - t_j)||^2  subject to  sum_i t_i = 0, sum_i ||t_i||^2 = 1.

    It is the smallest eigenvector, shifts aside, of the projected Laplacian D^T P D. Its residuals are
    lengths, so that long baselines count more; `reweightings` by 1 / ||t_i - t_j||^2, of which 10 are plenty,
    turn them into sines of angles.
    """
    projections = np.eye(graph.dimension) - np.einsum("ea,eb->eab", graph.directions, graph.directions)
    weights = graph.weights
    for left in range(reweightings, -1, -1):
        t = _smallest_eigenvector(graph, weights[:, None, None] * projections)
        if left:
            lengths = np.linalg.norm(differences(t, graph.edges), axis=1)
            weights = graph.weights / np.maximum(lengths, _SHORTEST * np.median(lengths)) ** 2
            weights = weights / weights.mean()
    return _normalize(graph, t)


def _smallest_eigenvector(graph: ViewGraph, blocks: FloatArray) -> FloatArray:
    """Return the eigenvector (n, d) of the smallest eigenvalue of the block Laplacian, shifts aside."""
    n, d = graph.num_nodes, graph.dimension
    matrix = laplacian_matrix(n, graph.edges, blocks)
    shifts = np.tile(np.eye(d), (n, 1)) / np.sqrt(n)
    size = float(matrix.diagonal().mean())
    if n * d <= _DENSE_UNKNOWNS:
        lifted = matrix.toarray() + 10.0 * n * size * shifts @ shifts.T
        return np.linalg.eigh(lifted)[1][:, 0].reshape(n, d)
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
    return x.reshape(n, d)


def locate_linf(graph: ViewGraph) -> FloatArray:
    """Minimize gamma subject to || t_i - t_j - s_e v_e || <= gamma, s_e >= 1: one wrong pair decides.

    A generic cone solver does it, so the graph must be small.
    """
    import cvxpy as cp

    n, m, d = graph.num_nodes, graph.num_edges, graph.dimension
    rows, signs = np.tile(np.arange(m), 2), np.repeat([1.0, -1.0], m)
    incidence = csr_array((signs, (rows, graph.edges.T.ravel())), shape=(m, n))
    t, s, gamma = cp.Variable((n, d)), cp.Variable((m, 1)), cp.Variable()
    bounded = cp.SOC(gamma * np.ones(m), incidence @ t - cp.multiply(s, graph.directions), axis=1)
    cp.Problem(cp.Minimize(gamma), [bounded, s >= 1.0, t[0] == 0.0]).solve(solver=cp.CLARABEL)
    return _normalize(graph, np.asarray(t.value))


def locate_lud(graph: ViewGraph) -> FloatArray:
    """Minimize  sum_e w_e || t_i - t_j - s_e v_e ||  subject to  s_e >= 1, to its optimum."""
    return _normalize(graph, solve_lud(graph, _LUD_STEPS, certified=False).locations)


def _normalize(graph: ViewGraph, locations: FloatArray) -> FloatArray:
    """Return the (n, d) locations centered, of unit norm, and with sum_e w_e <t_i - t_j, v_e> >= 0."""
    centered = locations - locations.mean(axis=0)
    centered = centered / np.linalg.norm(centered)
    return centered if projected_length(graph, centered) >= 0.0 else -centered


def filter_1dsfm(graph: ViewGraph) -> BoolArray:
    """Return the pairs that do not contradict the order of the cameras along most of some random axes."""
    return onedsfm_scores(graph) < _CONTRADICTING


def onedsfm_scores(graph: ViewGraph, seed: int = 0) -> FloatArray:
    """Return each pair's mean projected length on the axes that contradict it, (m,).

    Projected to an axis, a direction says which of its two cameras comes first, the surer the longer its
    projection. An order that most pairs agree with is a minimum feedback arc set of this graph.
    """
    rng = np.random.default_rng(seed)
    chosen = graph.directions[rng.integers(graph.num_edges, size=_AXES)]
    axes = normalized(chosen + _JITTER * rng.standard_normal(chosen.shape))
    scores = np.zeros(graph.num_edges)
    for axis in axes:
        ahead = graph.directions @ axis  # positive: camera i comes after camera j
        place = _greedy_order(graph, ahead)
        before = place[graph.edges[:, 0]] < place[graph.edges[:, 1]]
        scores += np.where(before == (ahead > 0.0), np.abs(ahead), 0.0)
    return scores / len(axes)


def _greedy_order(graph: ViewGraph, ahead: FloatArray) -> IntArray:
    """Return the place (n,) of each camera: next comes the one with the most going out for what comes in."""
    n, arcs = graph.num_nodes, adjacency(graph.num_nodes, graph.edges)
    node = np.repeat(np.arange(n), np.diff(arcs.pointers))
    # The weight of an arc is positive where it leaves the node, that is, where the node comes first.
    weight = np.where(graph.edges[arcs.edge_of, 0] == node, -1.0, 1.0) * ahead[arcs.edge_of]
    leaving = np.bincount(node, np.maximum(weight, 0.0), n)
    entering = np.bincount(node, np.maximum(-weight, 0.0), n)
    place, is_open = np.zeros(n, dtype=np.int64), np.ones(n, dtype=np.bool_)
    for position in range(n):
        ratios = (leaving + 1.0) / (np.maximum(entering, 0.0) + 1.0)
        best = int(np.argmax(np.where(is_open, ratios, -1.0)))
        place[best], is_open[best] = position, False
        around = slice(arcs.pointers[best], arcs.pointers[best + 1])
        entering[arcs.neighbors[around]] -= np.maximum(weight[around], 0.0)
        leaving[arcs.neighbors[around]] -= np.maximum(-weight[around], 0.0)
    return place


def filter_triangles(graph: ViewGraph) -> BoolArray:
    """Return the pairs that do not contradict their triangles; pairs in none are kept."""
    return triangle_scores(graph) < _OFF_TRIANGLES_RAD


LOCATORS = {"least-squares": locate_least_squares, "linf": locate_linf, "lud": locate_lud}
FILTERS = {"1dsfm": filter_1dsfm, "triangles": filter_triangles}
