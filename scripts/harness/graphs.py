"""Bare graphs of known truth: families by name, and the paper's error."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import bsr_array, coo_array, csc_array, eye_array, kron

from sfm_shapefit import synthetic
from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.synthetic.graphs import GraphProblem

SEED = 1
_FAMILIES = {"geo": "box", "comm": "community", "er": "expander", "ring": "ring", "lawn": "lawn"} | {
    "seq": "trajectory",
    "seqv": "trajectory",
    "corr": "corridor",
}
"""Functions of `sfm_shapefit.synthetic`."""


@dataclass(frozen=True, slots=True)
class GraphSpec:
    """A random graph problem that can be drawn again anywhere."""

    family: str
    """er2 is G(n, 1/2), the paper's; seqv is seq with a speed that varies by a factor of 4."""
    n: int
    degree: float = 0.0
    """Mean degree asked for; not used by er2."""
    sigma: float = 0.0
    q: float = 0.2

    def __str__(self) -> str:
        return f"{self.family} {self.n}, sigma {self.sigma:g}"


def draw(spec: GraphSpec, **changes: Any) -> GraphProblem:
    """Return the problem, always the same one; `changes` are further arguments of the family."""
    noise: dict[str, Any] = {"sigma": spec.sigma, "q": spec.q, "seed": SEED} | changes
    if spec.family == "er2":
        return synthetic.random_graph_problem(spec.n, 0.5, **noise)
    if spec.family == "seqv":
        noise |= {"speed_ratio": 4.0}
    make = getattr(synthetic, f"{_FAMILIES[spec.family]}_graph_problem")
    problem: GraphProblem = make(spec.n, spec.degree, **noise)
    return problem


def relative_error(locations: FloatArray, truth: FloatArray) -> float:
    """Return the paper's error: the distance of the two sets, each centered and scaled to unit norm.

    Source: Hand, Lee, Voroninski (2015), section 4.
    """
    return float(np.linalg.norm(to_unit_norm(locations) - to_unit_norm(truth)))


def to_unit_norm(locations: FloatArray) -> FloatArray:
    """Return locations (n, d) about their centroid, scaled to a norm of 1."""
    centered = locations - locations.mean(axis=0)
    unit: FloatArray = centered / np.linalg.norm(centered)
    return unit


def laplacian_matrix(num_nodes: int, edges: IntArray, weights: FloatArray) -> csc_array:
    """Return the Laplacian of edge weights (m,), (n, n), or of symmetric blocks (m, b, b), (nb, nb)."""
    blocks = weights.reshape(len(edges), 1, 1) if weights.ndim == 1 else weights
    m, b = blocks.shape[:2]
    signs = (np.repeat([1.0, -1.0], m), (np.tile(np.arange(m), 2), edges.T.ravel()))
    differences = kron(coo_array(signs, shape=(m, num_nodes)), eye_array(b), format="csr")
    return csc_array(differences.T @ bsr_array((blocks, np.arange(m), np.arange(m + 1))) @ differences)
