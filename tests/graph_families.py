"""The view-graph families of `sfm_shapefit.synthetic` as (edges, locations), and weights for them."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from sfm_shapefit.synthetic import (
    GraphProblem,
    box_graph_problem,
    community_graph_problem,
    expander_graph_problem,
    trajectory_graph_problem,
)

Graph = tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]


def _of(make: Callable[..., GraphProblem]) -> Callable[[int, float, int], Graph]:
    """Return the family as a function of (n, mean degree, seed)."""

    def family(n: int, degree: float, seed: int) -> Graph:
        problem = make(n, degree, seed=seed)
        return problem.edges, problem.locations

    return family


geo, er = _of(box_graph_problem), _of(expander_graph_problem)
comm, seq = _of(community_graph_problem), _of(trajectory_graph_problem)
FAMILIES: dict[str, Callable[[int, float, int], Graph]] = {"geo": geo, "er": er, "comm": comm, "seq": seq}


def random_weights(num_edges: int, seed: int) -> npt.NDArray[np.float64]:
    """Return edge weights uniform in [0.5, 1.5]."""
    return np.random.default_rng(seed).uniform(0.5, 1.5, size=num_edges)


def random_blocks(num_edges: int, size: int, seed: int) -> npt.NDArray[np.float64]:
    """Return symmetric positive definite (m, size, size) edge blocks with eigenvalues in about [0.5, 5]."""
    a = np.random.default_rng(seed).normal(size=(num_edges, size, size)) / np.sqrt(size)
    return a @ np.swapaxes(a, 1, 2) + 0.5 * np.eye(size)
