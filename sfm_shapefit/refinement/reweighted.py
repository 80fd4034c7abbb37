"""ShapeFit at the weights of a posterior: a further start where most pairs are wrong.

Every convex program collapses where more than about half of the pairs are wrong. What collapses is not the
program but its weights: at the posterior of each pair, in the place of 1, the truth is its optimum again. So
the certified program is solved at weights, its residuals say more about the pairs, and so on:

1. *From the usual answer.* The posteriors of its residuals are the weights, after a consensus has put each
   node where most of its rays meet. Where it moves none, the usual answer stays: other weights change it by
   less than the noise then.
2. *From triangles*, where even that explains few of the pairs: their posteriors are the first weights; after
   each solve and refinement the residuals of a consensus are heard too, at a level that shrinks.

Each goes on as 1 does while the evidence of `consensus` grows. Every answer is refined in angles from the
certified optimum at weights that are kept with it: the certificate is that of the program at those weights,
and says nothing of the weights themselves.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.scipy_parts import expit, logit
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.refinement.angular import AngularResult
from sfm_shapefit.refinement.consensus import (
    ResidualMixture,
    fit_mixture,
    log_ratio,
    put_by_consensus,
    residual_angles,
)
from sfm_shapefit.refinement.posterior import TriangleEvidence, weigh_by_triangles
from sfm_shapefit.solver.program import projected_length
from sfm_shapefit.solver.solve import solve
from sfm_shapefit.solver.solver_options import PAIRS_AT_SCALE, SolverOptions, SolverResult

POOR_SHARE = 0.7
"""Share of right pairs that the usual answer explains; from here on it is believed, since nothing gained."""
_FEW = 0.35  # share of right pairs; answers that explain fewer are looked for among triangles too
# Likewise, where a consensus has moved cameras and pairs are not too many: the usual answer was off there.
_FEW_OF_MOVED = 0.5
_FEWEST_NODES = 10  # nodes; the residuals of fewer say nothing of noise and shares
_LEAST_REDUNDANCY = 2.0  # equations per unknown; with fewer any answer explains about half of the pairs
_LEAST_WEIGHT = 1e-4  # relative weight of a pair that is certainly wrong; 0 would leave cameras loose
_TRIANGLE_ROUNDS = 10  # solves from triangles, at most; three or four do where the truth is plain
_CONSENSUS_ROUNDS = 4  # solves from residuals, at most; two do mostly
_GAIN = 0.1  # evidence in nats; a smaller gain is none
_GAIN_SHARE = 1e-4  # share of the evidence; on large graphs a smaller gain is worth no further solve
_FIRST_LEVEL_RAD = 0.3  # radians; a larger level tells nothing from a wrong direction
_LEAST_LEVEL_RAD = 1e-4  # radians; exact directions are still told by a finite level
_LEVEL = 1.5  # medians of right residuals, twice as many at first; 0.85 is normal, but not all are right
_PRIORS = (0.03, 0.97)  # least and largest share of right pairs; at 0 and 1 nothing is learned any more
_HEARD = (-4.0, 6.0)  # nats that a residual may say; locations are uncertain as yet
_STILL = 0.01  # mean change of weights; a smaller one is none

Refine = Callable[[ViewGraph, FloatArray, FloatArray], AngularResult]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reweighted:
    """ShapeFit at other weights, and what the refinement makes of it."""

    graph: ViewGraph
    """The graph with the weights of the program."""
    solved: SolverResult
    """Its certified optimum: of the program at these weights."""
    refined: AngularResult | None
    """The optimum refined in angles, at these weights; None where the optimum itself has more evidence."""
    mixture: ResidualMixture
    """How likely either makes all directions."""
    triangles: TriangleEvidence | None = None
    """What triangles say of the pairs, where the weights are theirs."""

    @property
    def locations(self) -> FloatArray:
        """(n, d) the refined optimum, or the optimum."""
        return self.solved.locations if self.refined is None else self.refined.locations


def solve_reweighted(
    measured: MeasuredGraph, usual: FloatArray, options: SolverOptions, refine: Refine
) -> Reweighted | None:
    """Return the best reweighted ShapeFit; None if no weights give more evidence, or all may be wrong.

    None too where most directions, weighed as usual, point against it: it has no scale then.

    Args:
        measured: a parallel-rigid piece of nodes, or rigid groups that are tied to one another.
        usual: (n, d) the usual answer.
        options: of the solver.
        refine: refines locations in the angles of a graph's directions.
    """
    search = _Search(measured, options, refine)
    mixture = fit_mixture(measured, usual, options.num_threads())
    found = search.climb(usual, mixture)
    few = _FEW if found is None or measured.graph.num_edges > PAIRS_AT_SCALE else _FEW_OF_MOVED
    if (mixture if found is None else found.mixture).shares[0] < few:
        from_triangles = search.follow(weigh_by_triangles(measured.graph, options.num_threads()))
        if found is None or from_triangles.mixture.evidence > found.mixture.evidence:
            found = from_triangles
    if found is None or found.mixture.evidence <= max(_more(mixture.evidence), 0.0):
        return None
    return found if projected_length(measured.graph, found.locations) > 0.0 else None


def solve_at_triangles(measured: MeasuredGraph, options: SolverOptions) -> Reweighted:
    """Return ShapeFit at the posteriors that the triangles of a graph give its pairs, certified."""
    graph = measured.graph
    triangles = weigh_by_triangles(graph, options.num_threads())
    weighted = graph.with_weights(graph.weights * np.maximum(triangles.posterior, _LEAST_WEIGHT))
    solved = solve(weighted, options, groups=measured.groups)
    mixture = fit_mixture(measured, solved.locations, options.num_threads())
    return Reweighted(graph=weighted, solved=solved, refined=None, mixture=mixture, triangles=triangles)


def can_be_reweighted(measured: MeasuredGraph) -> bool:
    """Return whether a graph has so many pairs that a minority of them may determine all that moves."""
    graph, groups = measured.graph, measured.groups
    d, count = graph.dimension, graph.num_nodes if groups is None else groups.num_groups
    unknowns = d * (count - 1) - 1
    return count >= _FEWEST_NODES and (d - 1) * graph.num_edges >= _LEAST_REDUNDANCY * unknowns


class _Search:
    """Solves of one graph at weights that change."""

    def __init__(self, measured: MeasuredGraph, options: SolverOptions, refine: Refine) -> None:
        self._measured, self._options, self._refine = measured, options, refine

    def climb(self, locations: FloatArray, mixture: ResidualMixture) -> Reweighted | None:
        """Return the answer of most evidence from locations (n, d) on, which may have less than they.

        None if each of their nodes is where most of its rays meet.
        """
        best = None
        for _ in range(_CONSENSUS_ROUNDS if self._measured.graph.num_edges <= PAIRS_AT_SCALE else 1):
            moved = self._put(locations, mixture.log_odds, mixture.variances)
            if best is None and np.array_equal(moved, locations):
                return None
            there, least = self._fit(moved), _more(mixture.evidence)
            if best is not None and there.evidence <= least:
                break
            placed = self._place(there.posterior, moved)
            if best is None or placed.mixture.evidence > best.mixture.evidence:
                best = placed
            locations, mixture = moved, there
            if placed.mixture.evidence >= there.evidence:
                locations, mixture = placed.locations, placed.mixture
            if mixture.evidence <= least:
                break
        return best

    def follow(self, triangles: TriangleEvidence) -> Reweighted:
        """Return the answer of most evidence that weights of triangles lead to."""
        graph, prior, weights = self._measured.graph, triangles.prior, triangles.posterior
        level, factor, candidates = _FIRST_LEVEL_RAD, 2.0 * _LEVEL, list[tuple[FloatArray, ResidualMixture]]()
        for _ in range(_TRIANGLE_ROUNDS):
            weighted = self._weighted(weights)
            # Unrefined, noise draws the optimum together, and what it says of the pairs is too weak.
            solved = self._solve(weighted).locations
            placed = self._refine(weighted, solved, solved).locations
            residual = _weighted_median(residual_angles(graph, placed), weights)
            level, factor = float(np.clip(factor * residual, _LEAST_LEVEL_RAD, level)), _LEVEL
            odds, variances = np.full(graph.num_edges, logit(prior)), np.full(graph.num_edges, level**2)
            moved = self._put(placed, odds, variances, sweeps=1)
            candidates += [(t, self._fit(t)) for t in (placed, moved)]
            heard = np.clip(log_ratio(residual_angles(graph, moved), variances, graph.dimension), *_HEARD)
            new = expit(triangles.log_odds + odds + heard)
            prior = float(np.clip(np.mean(new), *_PRIORS))
            change, weights = float(np.mean(np.abs(new - weights))), new
            if change < _STILL:
                break
        best, mixture = max(candidates, key=lambda candidate: candidate[1].evidence)
        return self.climb(best, mixture) or self._place(mixture.posterior, best)

    def _put(self, t: FloatArray, odds: FloatArray, variances: FloatArray, **how: int) -> FloatArray:
        """Return the locations by consensus; those of groups, where these lie nearest to them."""
        groups = self._measured.groups
        moved = put_by_consensus(self._measured.graph, t, odds, variances, **how)
        stays = groups is None or np.array_equal(moved, t)
        return moved if groups is None or stays else groups.expand(groups.fit(moved)[0])

    def _fit(self, t: FloatArray) -> ResidualMixture:
        return fit_mixture(self._measured, t, self._options.num_threads())

    def _solve(self, graph: ViewGraph) -> SolverResult:
        return solve(graph, self._options, groups=self._measured.groups)

    def _weighted(self, posterior: FloatArray) -> ViewGraph:
        """Return the graph with the weights of a posterior (m,) on top of its own."""
        graph = self._measured.graph
        return graph.with_weights(graph.weights * np.maximum(posterior, _LEAST_WEIGHT))

    def _place(self, posterior: FloatArray, near: FloatArray) -> Reweighted:
        """Return the certified optimum at the weights of a posterior (m,), refined.

        A camera all but one of whose pairs have no weight may be anywhere along that one: it stays where it
        is in `near` (n, d).
        """
        graph = self._weighted(posterior)
        solved = self._solve(graph)
        refined = self._refine(graph, solved.locations, near)
        mixture = self._fit(refined.locations)
        unrefined = self._fit(solved.locations)
        if unrefined.evidence >= mixture.evidence:
            return Reweighted(graph=graph, solved=solved, refined=None, mixture=unrefined)
        return Reweighted(graph=graph, solved=solved, refined=refined, mixture=mixture)


def _more(evidence: float) -> float:
    """Return the evidence above which another answer counts as better."""
    return evidence + max(_GAIN, _GAIN_SHARE * abs(evidence))


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    """Return the least value (m,) that values of half of all weight do not exceed."""
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(reached, 0.5 * reached[-1])])
