"""Bare graphs of known truth: families by name, and the paper's error."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sfm_shapefit.base.arrays import FloatArray
    from sfm_shapefit.graph.viewgraph import ViewGraph
    from sfm_shapefit.synthetic import GraphProblem

SEED = 1


@dataclass(frozen=True, slots=True)
class GraphSpec:
    """A random graph problem that can be drawn again anywhere."""

    family: str
    """er2 is G(n, 1/2), the paper's; the others are those of `sfm_shapefit.synthetic`; seqv is seq with
    a speed that varies by a factor of 4."""
    n: int
    degree: float = 0.0
    """Mean degree asked for; not used by er2."""
    sigma: float = 0.0
    q: float = 0.2

    def __str__(self) -> str:
        return f"{self.family} {self.n}, sigma {self.sigma:g}"


def draw(spec: GraphSpec, **changes: Any) -> "GraphProblem":
    """Return the problem, always the same one; `changes` are further arguments of the family."""
    from sfm_shapefit import synthetic

    noise: dict[str, Any] = {"sigma": spec.sigma, "q": spec.q, "seed": SEED} | changes
    if spec.family == "er2":
        return synthetic.random_graph_problem(spec.n, 0.5, **noise)
    if spec.family == "seqv":
        return synthetic.trajectory_graph_problem(spec.n, spec.degree, speed_ratio=4.0, **noise)
    families = {
        "geo": synthetic.box_graph_problem,
        "comm": synthetic.community_graph_problem,
        "er": synthetic.expander_graph_problem,
        "seq": synthetic.trajectory_graph_problem,
        "ring": synthetic.ring_graph_problem,
        "lawn": synthetic.lawn_graph_problem,
        "corr": synthetic.corridor_graph_problem,
    }
    return families[spec.family](spec.n, spec.degree, **noise)


def view_graph(problem: "GraphProblem") -> "ViewGraph":
    """Return the measurements of a problem."""
    from sfm_shapefit import ViewGraph

    return ViewGraph(len(problem.locations), problem.edges, problem.directions)


def relative_error(locations: "FloatArray", truth: "FloatArray") -> float:
    """Return the paper's error: the distance of the two sets, each centered and scaled to unit norm.

    Source: Hand, Lee, Voroninski (2015), section 4.
    """
    import numpy as np

    return float(np.linalg.norm(to_unit_norm(locations) - to_unit_norm(truth)))


def to_unit_norm(locations: "FloatArray") -> "FloatArray":
    """Return locations (n, d) about their centroid, scaled to a norm of 1."""
    import numpy as np

    centered = locations - locations.mean(axis=0)
    unit: FloatArray = centered / np.linalg.norm(centered)
    return unit
