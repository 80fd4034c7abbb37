"""Locations of most evidence under a mixture of noise levels: the refinement where no sigma is believed.

The model. Direction e is right or wrong. A wrong one is uniform on the sphere. A right one is off by normal
errors of standard deviation sqrt(s_k^2 + own variance) per axis, own being the covariance that it states, if
any, and s_k one of a grid of levels: pairs of one graph differ in noise by a factor of ten, and one level for
all either rejects the noisy ones or believes wrong ones. The share of each level, and that of wrong pairs,
are fitted by expectation maximization; no level falls, only shares move. Lengths have a weak prior: cameras
that share matches are about as far apart as others that do, whether or not their direction is right,

    log |d_e|  ~  N(mean, tau^2),    weighted so that all m pairs together count as n observations.

The posterior of the locations is taken for normal, N(T, S), and the bound on the evidence is maximized:

    sum_e log( w_0 + sum_k w_k N(a_e; s_k) / uniform )  -  prior(T)  +  log det(S) / 2,

where each squared residual is its mean under S, E[a_e^2] = a_e^2 + tr(J_e S J_e^T), J_e the derivative of the
angle by the locations. A pair that a loose camera fits exactly is not believed for that: its E[a_e^2] says
how far the camera could go. A step is one of Levenberg and Marquardt on the expected squares; S is the
inverse of its normal matrix, of which the blocks at pairs are all that is needed (selected inverse).

A floor under the levels falls from 3 degrees by a factor of 0.6 a step, so that a far start is drawn in
(graduated non-convexity); the bound decides between ends. Each end is left by `consensus` for places where
more rays meet, as long as the bound grows.

Sources: variational Bayes for a mixture: Bishop, "Pattern recognition and machine learning", 2006, chapter
10; the residual: Zhuang, Cheong and Lee, CVPR 2018. The prior of lengths is our own.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import tangent_bases
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.base.scipy_parts import gammaln, logit
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.laplacian.cholesky import allocate_factor
from sfm_shapefit.laplacian.selected import selected_inverse
from sfm_shapefit.laplacian.symbolic import SymbolicFactor
from sfm_shapefit.refinement.consensus import put_by_consensus
from sfm_shapefit.solver.program import adjoint, differences

_LEVELS_RAD = np.geomspace(1e-7, 0.25, 22)
"""Noise levels, radians, ascending by a factor of 2: below the first all is exact, beyond the last wrong."""
_FIRST_FLOOR_RAD = 0.05  # radians; every right pair of a usable start is within a few of these
_NEXT_FLOOR_RAD = 0.01  # likewise after a consensus, which is near
_FALL = 0.6  # by which the floor falls in a step
_NOISELESS_RAD = 2.5e-4  # radians; below this floor, a descent whose bound stays has ended
_PSEUDO_WRONG, _PSEUDO_LEVEL = 1.0, 0.05  # pairs that each share is fitted with beside the real ones
_FIT_ROUNDS, _FIRST_FIT_ROUNDS = 4, 10  # rounds of the shares per step; the next step goes on
_SETTLED = 1e-4  # change of a share; a smaller one is none
_TAUS = (0.2, 2.0)  # least and largest standard deviation of log lengths
_SPREAD = 1.25  # standard deviations of a normal variable per mean absolute deviation
_SHORTEST = 3e-3  # median lengths; the floor under lengths, below which a baseline has no direction
_RIDGE = 1e-9  # share of each block's trace added to its diagonal, against rounding
_DAMPING = (1e-3, 1e-10, 1e2)  # first, least and most, relative to a typical information
_MOST_STEPS = 60  # steps of one descent; 12 to 30 are needed
_LEAST_GAIN = 0.5  # nats; a smaller change of the bound is none
_MOST_ROUNDS = 4  # descents after the first, each from a consensus
_ROUND_GAIN = 1.0  # nats that such a descent must gain
_TYPICAL = 0.8  # share of the right pairs whose level is at most that of a consensus
_NEGLIGIBLE = 120.0  # squared standard scores; the density of a level is nothing beside those of higher ones
_LARGEST_VARIANCE = 1.0  # rad^2; of directions that nothing determines


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MixtureEnd:
    """Where a descent ends."""

    locations: FloatArray
    """(n, d) centered; the median length of an edge is 1."""
    bound: float
    """Lower bound of the log evidence, up to a constant of the graph."""
    posterior: FloatArray
    """(m,) probability that each direction is right."""
    variances: FloatArray
    """(m,) variance per axis of the error of each direction if it is right, rad^2, own part included."""
    shares: FloatArray
    """(number of classes, K + 1) shares of wrong directions and of each level."""

    @property
    def right_share(self) -> float:
        """Share of the directions between cameras that are right."""
        return float(1.0 - self.shares[0, 0])


class _Residuals(NamedTuple):
    """The directions at some locations."""

    lengths: FloatArray
    """(m,) lengths of the baselines, floored."""
    units: FloatArray
    """(m, d) directions of the baselines."""
    errors: FloatArray
    """(m, d - 1) errors of the directions along the axes of their covariances, radians."""


class Mixture:
    """The mixture model of one graph whose nodes move one by one."""

    def __init__(self, measured: MeasuredGraph, plan: SymbolicFactor) -> None:
        """Take a connected graph and the plan of its factor."""
        graph = self._graph = measured.graph
        d, num_edges = graph.dimension, graph.num_edges
        self._classes = measured.classes
        self._num_classes = int(self._classes.max()) + 1
        bases = tangent_bases(graph.directions)
        if measured.covariance is None:
            self._own, self._axes = np.zeros((num_edges, d - 1)), bases
        else:
            known = np.isfinite(measured.covariance).all(axis=(1, 2), keepdims=True)
            variances, turns = np.linalg.eigh(np.where(known, measured.covariance, 0.0))
            self._own, self._axes = np.maximum(variances, 0.0), np.asarray(bases @ turns)
        sphere = np.log(2.0) + 0.5 * d * np.log(np.pi) - gammaln(0.5 * d)
        self._peak = float(sphere - 0.5 * (d - 1) * np.log(2.0 * np.pi))
        numbers = np.bincount(self._classes, minlength=self._num_classes)
        nodes = np.array([measured.num_cameras, measured.num_points])[: self._num_classes]
        self._weights = (nodes / np.maximum(numbers, 1))[self._classes]  # of each pair's length in the prior
        self._factor = allocate_factor(plan, d)

    def descend(self, start: FloatArray) -> MixtureEnd | None:
        """Return where a descent from (n, d) locations ends; None if its equations are singular."""
        return self._descend(start, _FIRST_FLOOR_RAD, None)

    def improve(self, end: MixtureEnd) -> MixtureEnd:
        """Return the end of most evidence that consensus and descents, in turn, lead to."""
        for _ in range(_MOST_ROUNDS):
            moved = self._put(end)
            found = None
            if not np.array_equal(moved, end.locations):
                found = self._descend(moved, _NEXT_FLOOR_RAD, end.shares)
            if found is None or found.bound <= end.bound + _ROUND_GAIN:
                break
            end = found
        return end

    def _descend(self, start: FloatArray, floor: float, shares: FloatArray | None) -> MixtureEnd | None:
        """Return the end of a descent; None if its equations are singular."""
        t, count = self._scaled(start), len(_LEVELS_RAD)
        variances = np.zeros_like(self._own)  # of the residuals by the locations', per axis
        if shares is None:
            shares = np.tile(np.r_[0.5, np.full(count, 0.5 / count)], (self._num_classes, 1))
        damping, bound, end = _DAMPING[0], -np.inf, None
        for step in range(_MOST_STEPS):
            at = self._residuals(t)
            expected = at.errors**2 + variances
            for _ in range(_FIT_ROUNDS if step else _FIRST_FIT_ROUNDS):
                last, shares = shares, self._fit(expected, shares, floor)
                if np.abs(shares - last).max() <= _SETTLED:
                    break
            information, likelihood, _ = self._expect(expected, shares, floor)
            tau = self._tau(at.lengths)
            cost = self._prior(at.lengths, tau) - float(likelihood.sum())
            blocks, gradient = self._normal_equations(at, information, tau)
            right = -adjoint(gradient, self._graph.edges, self._graph.num_nodes)
            resisting = float(np.median(information)) / at.lengths**2
            moved = None
            while moved is None and damping <= _DAMPING[2]:
                if not self._refactor(blocks, damping * resisting):
                    damping *= 10.0
                    continue
                proposed = t + self._factor.solve(right)
                if self._cost(proposed, variances, shares, floor, tau) < cost:
                    moved = self._scaled(proposed)
                else:
                    damping *= 10.0
            if moved is None and not self._refactor(blocks, _DAMPING[1] * resisting):
                return end
            before, bound = bound, self._log_determinant(blocks, tau) - cost
            posterior, total = self._judge(expected, shares)
            end = MixtureEnd(locations=t, bound=bound, posterior=posterior, variances=total, shares=shares)
            variances = self._propagate(at)
            if floor <= _NOISELESS_RAD and abs(bound - before) < _LEAST_GAIN:
                break
            t = t if moved is None else moved
            damping = max(damping / 10.0, _DAMPING[1]) if moved is not None else _DAMPING[0]
            floor = max(floor * _FALL, float(_LEVELS_RAD[0]))
        return end

    def _scaled(self, t: FloatArray) -> FloatArray:
        """Return locations centered and of median length 1."""
        lengths = np.linalg.norm(differences(t, self._graph.edges), axis=1)
        return np.asarray((t - t.mean(axis=0)) / max(float(np.median(lengths)), np.finfo(float).tiny))

    def _residuals(self, t: FloatArray) -> _Residuals:
        """Return the errors of the directions at locations of median length 1."""
        baselines, v = differences(t, self._graph.edges), self._graph.directions
        lengths = np.maximum(np.linalg.norm(baselines, axis=1), _SHORTEST)
        units = baselines / lengths[:, None]
        angles = 2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(units - v, axis=1), 1.0))
        errors = np.einsum("edk,ed->ek", self._axes, units)
        sines = np.linalg.norm(errors, axis=1)
        # The angle, beyond 90 degrees too; straight behind, any axis will do.
        behind = sines <= np.finfo(float).tiny
        errors[behind, 0], sines[behind] = 1.0, 1.0
        return _Residuals(lengths, units, errors * (angles / sines)[:, None])

    def _expect(
        self, expected: FloatArray, shares: FloatArray, floor: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return information per axis (m, d - 1), log likelihood (m,), sums of the posteriors (C, K + 1).

        Levels below the floor count as the floor, and are one there.
        """
        low = int(np.searchsorted(_LEVELS_RAD, floor, side="right"))  # that many and the next are one
        levels = np.r_[floor, _LEVELS_RAD[low:]] if low else _LEVELS_RAD
        below = shares[:, 1 : low + 1].sum(axis=1, keepdims=True)
        few = np.hstack([shares[:, :1], below, shares[:, low + 1 :]]) if low else shares
        information, likelihood = np.empty_like(expected), np.empty(len(expected))
        sums, peaks = np.zeros_like(few), np.log(few) + self._peak
        peaks[:, 0] -= self._peak
        _expect(expected, self._own, self._classes, levels**2, peaks, (information, likelihood, sums))
        if low:
            parts = sums[:, 1:2] * shares[:, 1 : low + 1] / below
            sums = np.hstack([sums[:, :1], parts, sums[:, 2:]])
        return information, likelihood, sums

    def _fit(self, expected: FloatArray, shares: FloatArray, floor: float) -> FloatArray:
        """Return the shares that the posteriors of the present ones want."""
        sums = self._expect(expected, shares, floor)[2]
        sums += np.r_[_PSEUDO_WRONG, np.full(len(_LEVELS_RAD), _PSEUDO_LEVEL)]
        return np.asarray(sums / sums.sum(axis=1, keepdims=True))

    def _judge(self, expected: FloatArray, shares: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the posterior (m,) that each direction is right, and its variance per axis if it is."""
        information, likelihood, _ = self._expect(expected, shares, 0.0)
        right = -np.expm1(np.minimum(np.log(shares[self._classes, 0]) - likelihood, 0.0))
        typical = np.maximum(right, np.finfo(float).tiny) / np.maximum(
            information.mean(axis=1), np.finfo(float).tiny
        )
        return right, np.clip(typical, _LEVELS_RAD[0] ** 2, None)

    def _tau(self, lengths: FloatArray) -> FloatArray:
        """Return the standard deviation of log lengths of each class, as each edge's (m,)."""
        logs, taus = np.log(lengths), np.ones(self._num_classes)
        for k in range(self._num_classes):
            own = logs[self._classes == k]
            taus[k] = np.clip(_SPREAD * np.mean(np.abs(own - np.median(own))), *_TAUS) if len(own) else 1.0
        return np.asarray(taus[self._classes])

    def _excess_lengths(self, lengths: FloatArray) -> FloatArray:
        """Return log lengths less the mean of their class (m,)."""
        logs, numbers = np.log(lengths), np.bincount(self._classes, minlength=self._num_classes)
        means = np.bincount(self._classes, logs, self._num_classes) / np.maximum(numbers, 1)
        return np.asarray(logs - means[self._classes])

    def _prior(self, lengths: FloatArray, tau: FloatArray) -> float:
        """Return minus the log prior of the lengths."""
        return float(0.5 * np.sum(self._weights * (self._excess_lengths(lengths) / tau) ** 2))

    def _cost(
        self, t: FloatArray, variances: FloatArray, shares: FloatArray, floor: float, tau: FloatArray
    ) -> float:
        """Return minus the log of likelihood and prior at other locations."""
        at = self._residuals(t)
        likelihood = self._expect(at.errors**2 + variances, shares, floor)[1]
        return self._prior(at.lengths, tau) - float(likelihood.sum())

    def _normal_equations(
        self, at: _Residuals, information: FloatArray, tau: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the blocks (m, d, d) of the normal matrix, and the gradient by the baselines (m, d)."""
        across = self._across(at)
        stiffness = self._weights / tau**2
        along = at.units[:, :, None] * at.units[:, None, :]
        blocks = (across * information[:, None, :]) @ across.transpose(0, 2, 1) + stiffness[
            :, None, None
        ] * along
        blocks = blocks / at.lengths[:, None, None] ** 2
        blocks += (_RIDGE * np.trace(blocks, axis1=1, axis2=2))[:, None, None] * np.eye(along.shape[1])
        pull = np.einsum("edk,ek->ed", across, information * at.errors)
        pull += (stiffness * self._excess_lengths(at.lengths))[:, None] * at.units
        return blocks, pull / at.lengths[:, None]

    def _across(self, at: _Residuals) -> FloatArray:
        """Return the axes (m, d, d - 1) less what of them is along the baselines."""
        along = np.einsum("edk,ed->ek", self._axes, at.units)
        return np.asarray(self._axes - at.units[:, :, None] * along[:, None, :])

    def _refactor(self, blocks: FloatArray, resisting: FloatArray) -> bool:
        """Factor the damped normal matrix; return whether it is positive definite."""
        try:
            self._factor.refactor(blocks + resisting[:, None, None] * np.eye(blocks.shape[1]))
        except UnsolvableError:
            return False
        return True

    def _log_determinant(self, blocks: FloatArray, tau: FloatArray) -> float:
        """Return log det(S) / 2 of the present factor, in units of the prior's precision."""
        n, d = self._graph.num_nodes, blocks.shape[1]
        ground = 2.0 * float(np.trace(blocks, axis1=1, axis2=2).sum()) / (d * n)  # what `refactor` adds
        precision = self._weights[0] / tau[0] ** 2
        free = d * np.log(ground) + (d * (n - 1) - 1) * np.log(precision)
        return 0.5 * float(free - self._factor.log_determinant())

    def _propagate(self, at: _Residuals) -> FloatArray:
        """Return the variance of each residual by that of the locations, (m, d - 1), rad^2."""
        i, j = self._graph.edges.T
        inverse = selected_inverse(self._factor, self._graph.edges)
        relative = inverse.nodes[i] + inverse.nodes[j] - inverse.edges - inverse.edges.transpose(0, 2, 1)
        across = self._across(at)
        variances = np.einsum("eak,eab,ebk->ek", across, relative, across) / at.lengths[:, None] ** 2
        return np.clip(variances, 0.0, _LARGEST_VARIANCE)

    def _put(self, end: MixtureEnd) -> FloatArray:
        """Return locations with each node where most of its rays meet."""
        shares = end.shares
        right = np.cumsum(shares[:, 1:], axis=1)
        reached = [np.searchsorted(row, _TYPICAL * row[-1]) for row in right]
        level = _LEVELS_RAD[np.minimum(reached, len(_LEVELS_RAD) - 1)][self._classes]
        odds = logit(1.0 - shares[:, 0])[self._classes]
        return put_by_consensus(self._graph, end.locations, odds, level**2 + self._own.mean(axis=1))


@kernel
def _expect(expected: Any, own: Any, classes: Any, levels2: Any, peaks: Any, out: Any) -> None:
    """Write the information per axis (m, k), the log likelihood (m,), and add up the posteriors (C, K + 1).

    `expected` (m, k) are mean squared errors along the axes of each direction, `levels2` ascending, `peaks`
    (C, K + 1) the log shares, those of levels with the constant of the density.
    """
    information, likelihood, sums = out
    num_levels, num_axes = len(levels2), expected.shape[1]
    terms, logs = np.empty(num_levels + 1), np.log(levels2)
    for e in range(len(expected)):
        c, states_none = classes[e], True
        for a in range(num_axes):
            states_none = states_none and own[e, a] == 0.0
        terms[0] = most = peaks[c, 0]
        lowest = num_levels
        for k in range(num_levels - 1, -1, -1):
            exponent, spread = 0.0, 1.0
            for a in range(num_axes):
                variance = levels2[k] + own[e, a]
                exponent += expected[e, a] / variance
                spread *= variance
            if exponent > _NEGLIGIBLE:  # and more so at lower levels
                break
            lowest = k
            log_spread = num_axes * logs[k] if states_none else np.log(spread)
            terms[k + 1] = peaks[c, k + 1] - 0.5 * (exponent + log_spread)
            most = max(most, terms[k + 1])
        total = np.exp(terms[0] - most)
        for k in range(lowest, num_levels):
            terms[k + 1] = np.exp(terms[k + 1] - most)
            total += terms[k + 1]
        sums[c, 0] += np.exp(terms[0] - most) / total
        information[e] = 0.0
        for k in range(lowest, num_levels):
            share = terms[k + 1] / total
            sums[c, k + 1] += share
            for a in range(num_axes):
                information[e, a] += share / (levels2[k] + own[e, a])
        likelihood[e] = most + np.log(total)
