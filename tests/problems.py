"""View graphs for tests: which pairs, directions of known locations, and how far an answer is off."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import combinations
from typing import Any
from unittest.mock import patch

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.pairs.pair_directions import DirectionStatus, PairDirections
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.refinement import starts
from sfm_shapefit.scene.given import PositionPriors
from sfm_shapefit.scene.known_positions import KnownPositions
from sfm_shapefit.solver.program import differences
from sfm_shapefit.solver.reduction import Reduction
from sfm_shapefit.solver.solver_options import OnIteration
from sfm_shapefit.solver.splitting.engine import Goal
from sfm_shapefit.solver.splitting.linear import ONE_THREAD, Resources, laplacian_factor
from sfm_shapefit.solver.splitting.lud import solve_lud
from sfm_shapefit.solver.splitting.split_then_newton import AdmmResult, Splitting

Floats = npt.NDArray[np.float64]


def all_pairs(nodes: int | Iterable[int]) -> list[tuple[int, int]]:
    """Return all pairs (i, j), i before j, of the given nodes, or of the nodes 0 .. nodes - 1."""
    return list(combinations(range(nodes) if isinstance(nodes, int) else nodes, 2))


@contextmanager
def no_mixture() -> Iterator[None]:
    """Place bare graphs as those with points, groups or the evidence of matches: by one level of noise."""
    with patch.object(starts, "_find_most_evident", return_value=None):
        yield


def random_rotations(rng: np.random.Generator, n: int, d: int = 3) -> Floats:
    """Return n random rotations, (n, d, d)."""
    q = np.linalg.qr(rng.normal(size=(n, d, d)))[0]
    q[:, :, 0] *= np.sign(np.linalg.det(q))[:, None]
    return q


def turn(axis: npt.ArrayLike, angle_deg: float) -> Floats:
    """Return the rotation by an angle about an axis (3,), by Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(angle_deg)
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def exact_graph(locations: Floats, edges: npt.ArrayLike | None = None) -> ViewGraph:
    """Return the graph of the true directions between locations (n, d), along all pairs if none are given."""
    edges = np.array(all_pairs(len(locations)) if edges is None else edges)
    return ViewGraph(len(locations), edges, normalized(differences(locations, edges)))


def made_directions(pairs: npt.ArrayLike, directions: Floats, **told: Any) -> PairDirections:
    """Return directions (k, 3) of pairs (k, 2), usable, of 100 matches and a milliradian, unless told."""
    k = len(directions)
    usual = {
        "status": [DirectionStatus.USABLE] * k,
        "num_matches": np.full(k, 100),
        "num_inliers": np.full(k, 100),
        "num_rivals": np.zeros(k, dtype=np.int64),
        "cheirality_fraction": np.ones(k),
        "median_residual_px": np.full(k, 0.1),
        "parallax_deg": np.full(k, 10.0),
        "covariance": np.tile(1e-6 * np.eye(2), (k, 1, 1)),
    }
    return PairDirections(pairs=np.array(pairs), directions=directions, **(usual | told))


def made_rotations(pairs: npt.ArrayLike, rotations: Floats, **told: Any) -> RelativeRotations:
    """Return relative rotations (k, 3, 3) of pairs (k, 2), of 100 matches and 1e-4 radians, unless told."""
    k = len(rotations)
    usual = {
        "information": np.tile(1e8 * np.eye(3), (k, 1, 1)),
        "num_matches": np.full(k, 100),
        "weight_shares": np.ones(k),
    }
    return RelativeRotations(pairs=np.array(pairs), rotations=rotations, **(usual | told))


def made_priors(
    positions: Floats, sigma: float = np.nan, rows: npt.ArrayLike | None = None
) -> PositionPriors:
    """Return priors at positions (n, 3), or at some rows of them; without a sigma it is not known."""
    rows = np.arange(len(positions)) if rows is None else np.asarray(rows)
    covariances = np.broadcast_to(sigma**2 * np.eye(3), (len(rows), 3, 3))
    known = KnownPositions.measured(rows, positions[rows], covariances)
    return PositionPriors(known=known, statement="made")


def draw_graph(
    seed: int, *, n: int = 16, d: int = 3, p: float = 0.8, q: float = 0.2, sigma: float = 0.0, weighted=False
) -> tuple[ViewGraph, Floats]:
    """Return a random rigid graph with noisy and corrupted directions, and the true locations (n, d)."""
    rng = np.random.default_rng(seed)
    truth = rng.normal(size=(n, d))
    i, j = np.triu_indices(n, 1)
    kept = (rng.random(len(i)) < p) | (j <= i + 2)  # consecutive cameras keep the graph rigid
    edges = np.stack([i[kept], j[kept]], axis=1)
    v = _measure(differences(truth, edges), sigma, q, rng)
    weights = rng.uniform(0.2, 3.0, len(edges)) if weighted else None
    return ViewGraph(n, edges, v, weights), truth


def measure_graph(
    edges: npt.NDArray[np.int64], truth: Floats, *, sigma: float, q: float, seed: int
) -> ViewGraph:
    """Return noisy and corrupted directions between locations (n, 3), with uneven weights."""
    rng = np.random.default_rng(seed)
    v = _measure(differences(truth, edges), sigma, q, rng)
    return ViewGraph(len(truth), edges, v, rng.uniform(0.5, 2.0, len(edges)))


def rig_problem(
    seed: int, frames: int = 8, sensors: int = 3, wrong: float = 0.2, noise: float = 0.0, share: float = 0.5
) -> tuple[ViewGraph, RigidGroups, Floats]:
    """Return the directions of a share of all pairs, the rigid groups, and the true locations (n, 3).

    Frames stand about 4 apart, turned at random, with their sensors about 0.7 from their origin.
    """
    rng = np.random.default_rng(seed)
    turns = np.linalg.qr(rng.normal(size=(frames, 3, 3)))[0]
    own = 0.7 * rng.normal(size=(sensors, 3))
    centers = 4.0 * rng.normal(size=(frames, 3))
    labels = np.repeat(np.arange(frames), sensors)
    offsets = np.einsum("fab,sb->fsa", turns, own).reshape(-1, 3)
    t = centers[labels] + offsets
    n = len(t)
    edges = np.array(all_pairs(n))
    edges = edges[rng.random(len(edges)) < share]
    v = normalized(differences(t, edges))
    v = normalized(v + noise * rng.normal(size=v.shape))
    bad = rng.random(len(edges)) < wrong
    v[bad] = normalized(rng.normal(size=v.shape))[bad]
    graph = ViewGraph(n, edges, v, rng.uniform(0.5, 2.0, len(edges)))
    return graph, RigidGroups(group_of=labels, offsets=offsets), t


def outer(graph: ViewGraph, groups: RigidGroups) -> tuple[ViewGraph, npt.NDArray[np.bool_]]:
    """Return the graph without the pairs inside a rigid group, and which pairs are left."""
    kept = groups.joins(graph.edges)
    return ViewGraph(graph.num_nodes, graph.edges[kept], graph.directions[kept], graph.weights[kept]), kept


def _measure(baselines: Floats, sigma: float, q: float, rng: np.random.Generator) -> Floats:
    """Return directions of baselines, each off by sigma or, with probability q, a random one."""
    v = normalized(normalized(baselines) + sigma * normalized(rng.normal(size=baselines.shape)))
    corrupted = rng.random(len(v)) < q
    v[corrupted] = normalized(rng.normal(size=v.shape))[corrupted]
    return v


def shape(locations: Floats) -> Floats:
    """Return locations (n, d) moved and scaled to centroid 0 and norm 1."""
    centered = locations - locations.mean(axis=0)
    return np.asarray(centered / np.linalg.norm(centered))


def shape_error(locations: Floats, truth: Floats) -> float:
    """Return the distance of two shapes: the relative error of Hand et al. (2015), section 4."""
    return float(np.linalg.norm(shape(locations) - shape(truth)))


def fit_angles(t: Floats, edges: npt.NDArray[np.int64], directions: Floats, steps: int) -> Floats:
    """Return t (n, d) after Gauss-Newton steps on the sum of |u_e - v_e|^2, by dense algebra.

    Translation and scale, which no direction tells, do not move.
    """
    n, d = t.shape
    i, j = edges.T
    for _ in range(steps):
        u = normalized(t[i] - t[j])
        lengths = np.linalg.norm(t[i] - t[j], axis=1)
        across = np.eye(d) - u[:, :, None] * u[:, None, :]
        blocks, normal, pull = across / lengths[:, None, None] ** 2, np.zeros((n, n, d, d)), np.zeros((n, d))
        for first, second, sign in ((i, i, 1.0), (j, j, 1.0), (i, j, -1.0), (j, i, -1.0)):
            np.add.at(normal, (first, second), sign * blocks)
        off = np.einsum("eab,eb->ea", across, u - directions) / lengths[:, None]
        np.add.at(pull, i, off)
        np.subtract.at(pull, j, off)
        # Nothing pulls at the shifts and the scale, which are held so that the rest can be solved for.
        free = np.column_stack([np.tile(np.eye(d), (n, 1)), (t - t.mean(axis=0)).ravel()])
        free /= np.linalg.norm(free, axis=0)
        matrix = normal.swapaxes(1, 2).reshape(n * d, n * d)
        t = t - np.linalg.solve(matrix + matrix.max() * free @ free.T, pull.ravel()).reshape(n, d)
    return t


def solve_admm(
    graph: ViewGraph,
    tol: float,
    max_iterations: int,
    resources: Resources = ONE_THREAD,
    on_iteration: OnIteration | None = None,
) -> AdmmResult:
    """ShapeFit by the splitting alone, until the relative error of the objective is estimated below `tol`."""
    splitting = Splitting(graph, resources)
    try:
        return splitting.run(Goal(tol, 0.0, max_iterations), on_iteration)
    finally:
        splitting.close()


class CountedFactor:
    """A factor of a graph's scalar Laplacian that counts what is asked of it."""

    def __init__(self, graph: ViewGraph) -> None:
        self._factor = laplacian_factor(graph)
        self.refactored = self.solved = 0

    def refactor(self, weights: Floats) -> None:
        self.refactored += 1
        self._factor.refactor(weights)

    def solve(self, rhs: Floats) -> Floats:
        self.solved += 1
        return self._factor.solve(rhs)


def lud_over(graph: ViewGraph, groups: RigidGroups, steps: int = 150) -> Floats:
    """LUD's locations over groups, which its splitting sees through the linear solve alone."""
    factor = Reduction.over(graph.edges, groups.normalize())
    return solve_lud(graph, steps, certified=False, resources=Resources(factor=factor)).locations
