"""Locations of most evidence under a mixture of noise levels: a refinement for pairs that differ in noise.

The model. Direction e is right or wrong. A wrong one is uniform on the sphere. A right one is off by normal
errors a_e of variance s_e^2 + own variance per axis: its own covariance where it states one, and a level s_e
that is log-normal, since pairs of one graph differ in noise by a factor of ten, and one level for all either
rejects the noisy ones or believes wrong ones. Shares of each level that are free would call a second hump of
coherently wrong pairs, ten times as far off, right and noisy. The density of log s_e is summed at nodes s_k
of weight w_k, which move with its mean and standard deviation; w_0 is the share of wrong pairs.
Lengths have a weak prior: cameras that share matches are about as far apart as others that do, whether or not
their direction is right. All m pairs together count as n / f observations of it, one a camera where these
differ independently; f is their design effect (`length_prior`):

    (n / m f)  sum_e log N(log |d_e|; mean, tau^2),    mean and tau those of the pairs themselves.

What is maximized. Take the posterior of the locations for normal, N(T, S), and independent of which pair has
which level. The best posterior of the levels for given T and S leaves the variational bound of the evidence

    sum_e log( w_0 + sum_k w_k N(E a_e^2; s_k) / uniform )  +  prior(T)  +  log det(S) / 2,

up to a constant, where each density has the mean E a_e^2 = a_e^2 + J_e S J_e' in the place of the square, J_e
being the derivative of the error by the locations. A pair that a loose camera fits exactly is not believed
for that: J_e S J_e' is how far that camera can go. At the end, a pair is right if its error is likely both as
it is and as the other pairs predict it: with h_e the pair's share of the information on its own residual, the
error is a_e / (1 - h_e) then, and J_e S J_e' / (1 - h_e) its variance. A descent takes, in turn, the levels
by expectation maximization; T by a step of Levenberg and Marquardt at the information per pair that the
posteriors of the levels give; and S, the inverse of the matrix of that step, of which the blocks of the pairs
are needed alone (`laplacian.selected`). The mean level is that at which the squares E a_e^2 are as large as
expected, those of the loosest cameras included: it cannot collapse onto the few pairs that fit best.

A floor under the levels falls from step to step, which draws a far start in (graduated non-convexity). Two
ends are compared by their bounds at the noise of the noisier one: the larger consistent set wins, not the
sharper one. The best end is left, as long as the bound grows, by `consensus` for places where more rays meet,
and by opening pairs: one that was rejected while the locations were poor adds no information, so that these
stay as loose as it found them, and it is never asked again. If its error is likely as the other pairs predict
it, all variances J_e S J_e' / (1 - h_e) are added to the levels, and fall to 0 from step to step.

A step takes the mean of 1 / s_e^2 by the posteriors for the information of a pair. That is what a pair of
known level would say; levels and wrong pairs are known by the residuals alone, and the likelihood curves less
for that, by the variance of this posterior (Louis 1982). Standard deviations of the locations would be too
small, by a factor of 1.5 for a spread of .85, so the variances of an end are enlarged by the share that is
left, summed over all right pairs, since a single pair may curve the likelihood the other way.

Sources: Louis, "Finding the observed information matrix when using the EM algorithm", JRSS B 1982; Bishop,
"Pattern Recognition and Machine Learning", 2006, sections 10.1 and 10.2, for variational mixtures; Yang et
al., "Graduated non-convexity for robust spatial perception", RA-L 2020. The prior of lengths is our own.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.damping import DampingRange, take_damped_step
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import tangent_bases
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.base.scipy_parts import gammaln, logit
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.laplacian.factor import FactorPlan, allocate_factor
from sfm_shapefit.laplacian.operators import Workers
from sfm_shapefit.refinement.consensus import put_by_consensus
from sfm_shapefit.refinement.length_prior import LengthPrior
from sfm_shapefit.solver.program import SLICE, adjoint, measure_baselines

_LEVELS_RAD = (1e-7, 0.25)  # radians; noise below is none, and beyond nothing is known of a direction
_NODES = np.linspace(-4.0, 4.0, 13)  # standard scores of log levels; finer sums of their density say the same
_FIRST_FLOOR_RAD = 0.05  # radians; right pairs of a usable start are off by a few of these
_MOST_OPENED_RAD = 0.25  # radians; wider, a direction says nothing
_NEXT_FLOOR = 2.0  # typical levels; after a consensus, which is nearer than a start
_FALL = 0.6  # factor of the floor in a step; slower finds no better ends, and takes longer
_NOISELESS_RAD = 2.5e-4  # radians; below this floor, a descent whose bound stays has ended
_SPREADS = (
    0.05,
    1.3,
)  # standard deviation of log levels, least and largest; 0 could not grow, graphs have .7 to 1.2
_PSEUDO_WRONG = 1.0  # pairs added to the wrong ones; their share may not become 0
_FIT_ROUNDS = 4  # rounds of the shares in a step; the next step goes on with them
_SETTLED = 1e-4  # change of a share; a smaller one is none
_SHORTEST = 3e-3  # median lengths; the directions of shorter baselines turn with every step
_LONGEST = 50.0  # median lengths, geometric mean of a node's pairs; e^4, twice the largest spread of lengths
_RIDGE = 1e-9  # share of each block's trace that is added to its diagonal; above rounding
_DAMPING = DampingRange(1e-3, 1e-10, 1e2)  # shares of the median information; more moves nothing
_MOST_STEPS = 60  # steps of one descent; 20 to 40 are taken
_LEAST_GAIN, _LEAST_GAIN_A_CAMERA = 0.5, 0.003  # nats; a smaller change of the bound is none
_SMALL_STEP = 1e-3  # nats that a step promises; below, it is taken unseen, since rounding may hide the gain
_MET = 0.1  # levels; a descent that has all baselines of another, so closely, ends where that did
_MOST_ROUNDS = 4  # descents that follow the first, each from a consensus; most graphs want one
_FAR = 3.0  # typical levels, at a node's mean log length; a consensus that moves none so far gains nothing
_ROUND_GAIN = 1.0  # nats; such a descent that gains less is the last
_TYPICAL = 0.84  # standard score of a log level; the level that four of five have at most
_NEGLIGIBLE = 120.0  # squared standard scores; the density is nothing beside that of higher levels
_UNKNOWN = 1e-6  # probability of being right; a direction of less has the usual variance
_MOST_LEVERAGE = 0.9  # share of a residual's variance; nothing but the pair holds such a camera
_PROBE = 1e-3  # relative change of squared errors; the derivative of the information is good to as much
_LEAST_TOLD = 0.1  # share of the information; .37 to .97 were seen, and 0 would know nothing
_WEIGH_ROUNDS = 3  # rounds of share and variances at locations that stay; they settle in as many
_TINY = float(np.finfo(np.float64).tiny)
_LARGEST_VARIANCE = 1.0  # rad^2; a direction that nothing determines has no more
_NODE_SHARES = np.exp(-0.5 * _NODES**2) / np.exp(-0.5 * _NODES**2).sum()


class Levels(NamedTuple):
    """Share and noise of right directions."""

    right: float
    """Share of the directions that are right."""
    mean: float
    """Mean of the log levels, in radians, of these."""
    spread: float
    """Their standard deviation."""

    def at_nodes(self, floor: float) -> FloatArray:
        """Return levels (K,), radians, ascending, at which their density is summed; none below a floor."""
        lowest, highest = _LEVELS_RAD
        return np.clip(np.exp(self.mean + self.spread * _NODES), max(floor, lowest), highest)

    @property
    def typical(self) -> float:
        """The level, radians, that four of five right directions have at most."""
        return float(np.clip(np.exp(self.mean + _TYPICAL * self.spread), *_LEVELS_RAD))


_FIRST_LEVELS = Levels(right=0.5, mean=float(np.log(_FIRST_FLOOR_RAD)), spread=1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MixtureEnd:
    """Where a descent ends."""

    locations: FloatArray
    """(n, d) centered; the median length of an edge is 1."""
    bound: float
    """Lower bound of the log evidence, nats, up to a constant of the graph."""
    posterior: FloatArray
    """(m,) probability that each direction is right."""
    variances: FloatArray
    """(m,) variance per axis, rad^2, own part included, of an error that says as much of the locations as
    that of each direction if it is right."""
    levels: Levels
    """Share and noise of the right directions."""
    looseness: FloatArray
    """(m, d - 1) variance of each residual by that of the locations, rad^2."""

    @property
    def right_share(self) -> float:
        """Share of the directions that are right."""
        return self.levels.right


class _Descent(NamedTuple):
    path: list[FloatArray]  # (n, d) locations of each step
    end: MixtureEnd


class _Residuals(NamedTuple):
    """The directions at some locations (n, d)."""

    locations: FloatArray
    lengths: FloatArray  # (m,) floored
    logs: FloatArray  # (m,) logs of these, less their mean
    units: FloatArray  # (m, d) directions of the baselines
    across: FloatArray  # (m, d, d - 1) axes of the covariances, less what of them is along the baselines
    errors: FloatArray  # (m, d - 1) along these axes, radians


class _Expectation(NamedTuple):
    """What the directions say, each by the posterior of its level."""

    information: FloatArray  # (m, d - 1) per axis, rad^-2
    likelihood: FloatArray  # (m,) log, over that of a wrong direction
    sums: FloatArray  # (K + 1,) sums of the posteriors: that of being wrong, and of each level


class _Noise(NamedTuple):
    levels: Levels
    floor: float  # radians; lower levels count as this one
    own: FloatArray  # (m, d - 1) rad^2, of the errors beside their levels
    variances: FloatArray  # (m, d - 1) rad^2, residuals by the locations
    precision: float  # 1 / variance of a log length in the prior
    unit: float  # the same if cameras differ independently


class _System(NamedTuple):
    blocks: FloatArray  # (m, d, d) parts of the normal matrix
    gradient: FloatArray  # (m, d) derivative of the cost by the baselines
    damping_unit: FloatArray  # (m,)
    cost: float  # minus the log of likelihood and prior


class Mixture:
    """The mixture model of a connected graph of cameras that move one by one."""

    def __init__(self, measured: MeasuredGraph, plan: FactorPlan, threads: int = 1) -> None:
        """Take a graph and the plan of its factor, whose work so many threads share."""
        graph = self._graph = measured.graph
        d, bases = graph.dimension, tangent_bases(graph.directions)
        self._own, self._axes = np.zeros((graph.num_edges, d - 1)), bases
        if measured.covariance is not None:
            known = np.asarray(np.isfinite(measured.covariance).all(axis=(1, 2), keepdims=True))
            variances, turns = np.linalg.eigh(np.where(known, measured.covariance, 0.0))
            self._own, self._axes = np.maximum(variances, 0.0), np.asarray(bases @ turns)
            if known.any():  # the levels are those of what the others have beyond their own
                self._own[~known[:, 0, 0]] = np.median(self._own[known[:, 0, 0]])
        log_sphere = np.log(2.0) + 0.5 * d * np.log(np.pi) - gammaln(0.5 * d)
        self._peak = float(np.exp(log_sphere - 0.5 * (d - 1) * np.log(2.0 * np.pi)))
        self._factor = allocate_factor(plan, d, threads=threads)
        self._workers, m = Workers(threads), graph.num_edges
        self._chunks = [slice(k, k + SLICE) for k in range(0, m, SLICE)]
        self._least_gain = max(_LEAST_GAIN, _LEAST_GAIN_A_CAMERA * graph.num_nodes)
        self._descents: list[_Descent] = []
        self._lengths = LengthPrior(graph)

    def descend(self, start: FloatArray) -> MixtureEnd | None:
        """Return where a descent from (n, d) locations ends; None if its equations are singular.

        That is the end of an earlier descent, the very same object, where it meets the path of that.
        """
        closed = np.zeros_like(self._own)
        descent = self._descend(start, _FIRST_FLOOR_RAD, _FIRST_LEVELS, closed, self._descents)
        if descent is None:
            return None
        self._descents.append(descent)
        return descent.end

    def improve(self, end: MixtureEnd) -> MixtureEnd:
        """Return the end of most evidence that consensus, opened pairs and descents, in turn, lead to."""
        for _ in range(_MOST_ROUNDS):
            moved, opened = self._put_by_consensus(end), self._open(end)
            if np.array_equal(moved, end.locations) and not opened.any():
                break
            floor, before = min(_NEXT_FLOOR * end.levels.typical, _FIRST_FLOOR_RAD), _Descent([], end)
            found = self._descend(moved, floor, end.levels, opened, [before])
            if found is None or found.end.bound <= end.bound + _ROUND_GAIN:
                break
            end = found.end
        return end

    def lead(self, end: MixtureEnd, other: MixtureEnd) -> float:
        """Return by how many nats the bound of one end is above the other's, at the noise of the noisier."""
        noise = max(end.levels, other.levels, key=lambda levels: levels.typical)
        return self._weigh(end, noise) - self._weigh(other, noise)

    def _weigh(self, end: MixtureEnd, levels: Levels) -> float:
        """Return the bound at the locations of an end, where right directions have such levels."""
        if end.levels is levels:
            return end.bound
        at, bound, variances = self._residuals(end.locations), -np.inf, end.looseness
        for _ in range(_WEIGH_ROUNDS):
            expected = at.errors**2 + variances
            levels = levels._replace(right=_right_share(self._expect(expected, levels, 0.0).sums))
            noise = _Noise(levels, 0.0, self._own, variances, *self._lengths.precisions(at.logs))
            system = self._equations(at, noise.precision, self._expect(expected, levels, 0.0))
            if not self._refactor(system, _DAMPING.least):
                return -np.inf
            bound, variances = self._log_determinant(system, noise) - system.cost, self._propagate(at)
        return bound

    def _descend(
        self, start: FloatArray, floor: float, levels: Levels, opened: FloatArray, others: list[_Descent]
    ) -> _Descent | None:
        """Return a descent from (n, d) locations, or the other that it meets.

        Errors have variances `opened`, (m, d - 1), beside their own, which fall as the floor does.
        """
        at, damping, bound, last = self._residuals(self._draw_in(start)), _DAMPING.first, -np.inf, None
        variances, path = np.zeros_like(self._own), list[FloatArray]()
        for step in range(_MOST_STEPS):
            own = self._own + opened
            levels, found, precisions = self._fit(at, variances, levels, floor, own)
            opening = float(np.sqrt(opened.max()))
            for other in others:
                if opening <= _NOISELESS_RAD and self._meet(other, step, at, max(floor, levels.typical)):
                    return other
            noise = _Noise(levels, floor, own, variances, *precisions)
            system = self._equations(at, noise.precision, found)
            path.append(at.locations)
            moved, damping = self._step(at, noise, system, damping)
            if moved is None:
                break
            before, bound = bound, self._log_determinant(system, noise) - system.cost
            last = at, noise, bound
            if max(floor, opening) <= _NOISELESS_RAD and abs(bound - before) < self._least_gain:
                break
            variances = self._propagate(at)
            at, floor, opened = moved, max(floor * _FALL, _LEVELS_RAD[0]), opened * _FALL**2
        return None if last is None else _Descent(path, self._judge(*last))

    def _meet(self, other: _Descent, step: int, at: _Residuals, level: float) -> bool:
        """Return whether all baselines are as another descent had them after as many steps."""
        there = other.path[step] if step < len(other.path) else other.end.locations
        apart = self._baselines(at.locations - there)[1]
        return bool(np.all(apart < _MET * level * at.lengths))

    def _draw_in(self, t: FloatArray) -> FloatArray:
        """Return locations with the nodes whose pairs are very long amid their neighbors.

        Nothing determines such a node, and at the scale of the others the prior of lengths hardly moves it.
        """
        edges, n, lengths = self._graph.edges, self._graph.num_nodes, self._baselines(t)[1]
        unit = max(float(np.median(lengths)), _TINY)
        if lengths.max() <= _LONGEST * unit:
            return t
        logs = np.log(np.maximum(lengths / unit, _SHORTEST))
        degrees = self._graph.degrees()
        far = np.bincount(edges.ravel(), np.repeat(logs, 2), n) > np.log(_LONGEST) * degrees
        if not far.any():
            return t
        others, ends = edges[:, ::-1][near := ~far[edges[:, ::-1]]], edges[near]
        counts, t = np.bincount(ends, minlength=n), t.copy()
        sums = np.stack([np.bincount(ends, x[others], n) for x in t.T], axis=1)
        far &= counts > 0
        t[far] = sums[far] / counts[far, None]
        return t

    def _step(
        self, at: _Residuals, noise: _Noise, system: _System, damping: float
    ) -> tuple[_Residuals | None, float]:
        """Return locations of less cost, the present ones where none are, None if the system is singular.

        With them the damping for the next step; the factor stays that of the step.
        """
        right = -adjoint(system.gradient, self._graph.edges, self._graph.num_nodes)

        def propose(damping: float) -> _Residuals | None:
            if not self._refactor(system, damping):
                return None
            step = self._factor.solve(right)
            there = self._residuals(self._draw_in(at.locations + step))
            helps = np.vdot(right, step) < _SMALL_STEP or self._cost(there, noise) < system.cost
            return there if helps else None

        moved, damping = take_damped_step(propose, damping, _DAMPING)
        if moved is None and self._refactor(system, _DAMPING.least):
            moved = at
        return moved, damping

    def _residuals(self, t: FloatArray) -> _Residuals:
        """Return the errors of the directions at locations, which are centered and scaled."""
        units, lengths = self._baselines(t)
        unit = max(float(np.median(lengths)), _TINY)
        scaled = np.asarray((t - t.mean(axis=0)) / unit)
        errors, across = np.empty_like(self._own), np.empty_like(self._axes)
        found, v = (
            _Residuals(scaled, lengths, np.empty_like(lengths), units, across, errors),
            self._graph.directions,
        )

        def job(of: slice) -> None:
            part = _Residuals(scaled, *(column[of] for column in found[1:]))
            _measure_errors(unit, v[of], self._axes[of], part)

        self._workers.run([partial(job, of) for of in self._chunks])
        found.logs[:] -= found.logs.mean()
        return found

    def _baselines(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        return measure_baselines(t, self._graph.edges)

    def _expect(
        self,
        expected: FloatArray,
        levels: Levels,
        floor: float,
        own: FloatArray | None = None,
        beside: Sequence[Callable[[], object]] = (),
    ) -> _Expectation:
        """Return what squared errors expected along the axes, (m, d - 1), say under some levels.

        Other jobs are done beside.
        """
        information, likelihood = np.empty_like(expected), np.empty(len(expected))
        weights = np.r_[1.0 - levels.right, levels.right * self._peak * _NODE_SHARES]
        levels2, own = levels.at_nodes(floor) ** 2, self._own if own is None else own
        sums = np.zeros((len(self._chunks), len(weights)))

        def job(k: int, of: slice) -> None:
            _expect(
                expected[of],
                own[of],
                levels2,
                weights,
                _Expectation(information[of], likelihood[of], sums[k]),
            )

        self._workers.run([*beside, *(partial(job, k, of) for k, of in enumerate(self._chunks))])
        return _Expectation(information, likelihood, sums.sum(axis=0))

    def _fit(
        self, at: _Residuals, variances: FloatArray, levels: Levels, floor: float, own: FloatArray
    ) -> tuple[Levels, _Expectation, tuple[float, float]]:
        """Return the levels after rounds of expectation maximization, and what is expected under them.

        With them the precisions of the prior of lengths.
        """
        expected, precisions = at.errors**2 + variances, list[tuple[float, float]]()
        beside = [lambda: precisions.append(self._lengths.precisions(at.logs))]
        found = self._expect(expected, levels, floor, own, beside)
        for _ in range(_FIT_ROUNDS):
            last, levels = levels, _maximize(found, expected, levels, floor)
            found = self._expect(expected, levels, floor, own)
            if np.abs(np.subtract(levels, last)).max() <= _SETTLED:
                break
        return levels, found, precisions[0]

    def _judge(self, at: _Residuals, noise: _Noise, bound: float) -> MixtureEnd:
        """Return locations with the posterior that each direction is right, and its variance if it is."""
        levels = noise.levels
        expected = at.errors**2 + noise.variances
        found = self._expect(expected, levels, 0.0)
        right, information = _posterior(levels, found.likelihood), found.information
        usual = np.exp(2.0 * levels.mean) + self._own
        told = self._told_share(expected, levels, information)
        variances = (right + _UNKNOWN) / (information + _UNKNOWN / usual).mean(axis=1) / told
        errors, alone = _predict(at.errors, information, noise.variances)
        likelihood = self._expect(errors**2, levels, 0.0, self._own + alone).likelihood
        return MixtureEnd(
            locations=at.locations,
            bound=bound,
            posterior=np.minimum(right, _posterior(levels, likelihood)),
            variances=np.maximum(variances, _LEVELS_RAD[0] ** 2),
            levels=levels,
            looseness=noise.variances,
        )

    def _open(self, end: MixtureEnd) -> FloatArray:
        """Return the variances (m, d - 1) that open the directions; 0 if no rejected one is likely."""
        at, levels = self._residuals(end.locations), end.levels
        found = self._expect(at.errors**2 + end.looseness, levels, 0.0)
        errors, alone = _predict(at.errors, found.information, end.looseness)
        likelihood = self._expect(errors**2, levels, 0.0, self._own + alone).likelihood
        is_rejected = _posterior(levels, found.likelihood) < 0.5
        gains = is_rejected & (_posterior(levels, likelihood) > 0.5)
        return np.minimum(alone, _MOST_OPENED_RAD**2) if gains.any() else np.zeros_like(alone)

    def _told_share(self, expected: FloatArray, levels: Levels, information: FloatArray) -> float:
        """Return the share of the information of known levels that is there while residuals tell these.

        Squared errors x change the mean of 1 / s^2 by -var(1 / s^2) / 2, and lower the curvature by
        x var(1 / s^2) / (d - 1).
        """
        total = float(information.sum())
        change = float(self._expect((1.0 + _PROBE) * expected, levels, 0.0).information.sum()) - total
        return float(np.clip(1.0 + 2.0 / expected.shape[1] * change / _PROBE / total, _LEAST_TOLD, 1.0))

    def _cost(self, at: _Residuals, noise: _Noise) -> float:
        likelihood = self._expect(
            at.errors**2 + noise.variances, noise.levels, noise.floor, noise.own
        ).likelihood
        return _prior_cost(at, noise.precision) - float(likelihood.sum())

    def _equations(self, at: _Residuals, precision: float, found: _Expectation) -> _System:
        m, d = at.units.shape
        blocks, gradient = np.empty((m, d, d)), np.empty((m, d))

        def job(of: slice) -> None:
            part = _Residuals(at.locations, *(column[of] for column in at[1:]))
            _assemble(part, found.information[of], precision, blocks[of], gradient[of])

        self._workers.run([partial(job, of) for of in self._chunks])
        return _System(
            blocks=blocks,
            gradient=gradient,
            damping_unit=float(np.median(found.information)) / at.lengths**2,
            cost=_prior_cost(at, precision) - float(found.likelihood.sum()),
        )

    def _refactor(self, system: _System, damping: float) -> bool:
        """Factor the damped normal matrix; return whether it is positive definite."""
        blocks = system.blocks.copy()
        for a in range(blocks.shape[1]):
            blocks[:, a, a] += damping * system.damping_unit
        try:
            self._factor.refactor(blocks)
        except UnsolvableError:
            return False
        return True

    def _log_determinant(self, system: _System, noise: _Noise) -> float:
        """Return log det(S) / 2 of the present factor, in units of the prior's for independent cameras."""
        n, d = self._graph.num_nodes, self._graph.dimension
        ground = 2.0 * float(np.trace(system.blocks, axis1=1, axis2=2).sum()) / (d * n)  # as `refactor` adds
        free = d * np.log(ground) + (d * (n - 1) - 1) * np.log(noise.unit)
        return 0.5 * float(free - self._factor.log_determinant())

    def _propagate(self, at: _Residuals) -> FloatArray:
        """Return the variance of each residual by that of the locations, (m, d - 1), rad^2."""
        inverse, variances = self._factor.selected_inverse(), np.empty_like(self._own)
        edges, nodes = self._graph.edges, inverse.nodes

        def job(of: slice) -> None:
            _project((nodes, inverse.edges[of]), edges[of], at.across[of], at.lengths[of], variances[of])

        self._workers.run([partial(job, of) for of in self._chunks])
        return np.asarray(np.clip(variances, 0.0, _LARGEST_VARIANCE))

    def _put_by_consensus(self, end: MixtureEnd) -> FloatArray:
        odds = np.full(len(self._own), logit(end.right_share))
        moved = put_by_consensus(
            self._graph, end.locations, odds, end.levels.typical**2 + self._own.mean(axis=1)
        )
        ends, lengths = self._graph.edges.ravel(), self._residuals(end.locations).lengths
        typical = np.bincount(ends, np.repeat(np.log(lengths), 2), len(moved)) / self._graph.degrees()
        far = np.linalg.norm(moved - end.locations, axis=1) > _FAR * end.levels.typical * np.exp(typical)
        return np.where(far[:, None], moved, end.locations)


def _maximize(found: _Expectation, expected: FloatArray, levels: Levels, floor: float) -> Levels:
    """Return the most likely levels for what was expected under some."""
    least, counts = np.log(max(floor, _LEVELS_RAD[0])), found.sums[1:] + _TINY
    # The factor by which all levels together fit the errors, and the squares of the scores.
    factor2 = np.vdot(found.information, expected) / (expected.shape[1] * counts.sum())
    mean = np.clip(levels.mean + 0.5 * np.log(max(factor2, _TINY)), least, np.log(_LEVELS_RAD[1]))
    gain = levels.spread**2 / (levels.spread**2 + 0.5 / expected.shape[1])
    grown = 1.0 + (counts @ _NODES**2 / counts.sum() - 1.0) / gain
    spread = np.clip(levels.spread * np.sqrt(max(grown, 0.0)), *_SPREADS)
    return Levels(_right_share(found.sums), float(mean), float(spread))


def _predict(
    errors: FloatArray, information: FloatArray, variances: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return errors and their variances by the locations, (m, d - 1), as the others predict them."""
    left = 1.0 - np.minimum(information * variances, _MOST_LEVERAGE)
    return errors / left, np.minimum(variances / left, _LARGEST_VARIANCE)


def _right_share(sums: FloatArray) -> float:
    """Return the most likely share of right directions for sums of the posteriors (K + 1,)."""
    return float(sums[1:].sum() / (sums.sum() + _PSEUDO_WRONG))


def _posterior(levels: Levels, likelihood: FloatArray) -> FloatArray:
    """Return the probability that each direction is right, from the log likelihood of the mixture (m,)."""
    return np.asarray(-np.expm1(np.minimum(np.log1p(-levels.right) - likelihood, 0.0)))


def _prior_cost(at: _Residuals, precision: float) -> float:
    """Return minus the log prior of lengths."""
    return float(0.5 * precision * np.sum(at.logs**2))


@kernel
def _measure_errors(unit: float, v: Any, axes: Any, found: Any) -> None:
    """Write lengths and their logs, units, axes across, and errors; `found` has lengths and baselines."""
    _, lengths, logs, units, across, errors = found
    d = v.shape[1]
    for e in range(len(v)):
        lengths[e] = max(lengths[e] / unit, _SHORTEST)
        logs[e], chord2, sine2 = np.log(lengths[e]), 0.0, 0.0
        for a in range(d):
            units[e, a] /= unit * lengths[e]
            chord2 += (units[e, a] - v[e, a]) ** 2
        for q in range(d - 1):
            along = 0.0
            for a in range(d):
                along += axes[e, a, q] * units[e, a]
            for a in range(d):
                across[e, a, q] = axes[e, a, q] - units[e, a] * along
            errors[e, q] = along
            sine2 += along * along
        angle, sine = 2.0 * np.arcsin(min(0.5 * np.sqrt(chord2), 1.0)), np.sqrt(sine2)
        if sine <= _TINY:  # straight behind, any axis will do
            errors[e, 0], sine = 1.0, 1.0
        for q in range(d - 1):  # scaled to the angle, beyond 90 degrees too
            errors[e, q] *= angle / sine


@kernel
def _expect(expected: Any, own: Any, levels2: Any, weights: Any, found: Any) -> None:
    """Write the information per axis (m, k), the log likelihood (m,), and add up the posteriors (K + 1,).

    `expected` (m, k) are mean squared errors along the axes of each direction, `levels2` ascending, `weights`
    the shares, those of levels times the constant of the density, relative to that of wrong directions.
    """
    information, likelihood, sums = found
    num_levels, num_axes = len(levels2), expected.shape[1]
    terms, inverses, peaks = np.empty(num_levels), 1.0 / levels2, weights[1:] / levels2 ** (0.5 * num_axes)
    for e in range(len(expected)):
        total, lowest, square, variance = weights[0], 0, 0.0, 0.0
        for a in range(num_axes):
            square += expected[e, a]
            variance += own[e, a]
        for k in range(num_levels - 1, -1, -1):
            exponent, peak = square * inverses[k], peaks[k]
            if variance > 0.0:
                exponent = 0.0
                for a in range(num_axes):
                    exponent += expected[e, a] / (levels2[k] + own[e, a])
                    peak *= np.sqrt(levels2[k] / (levels2[k] + own[e, a]))
            if exponent > _NEGLIGIBLE:  # and more so at lower levels
                lowest = k + 1
                break
            terms[k] = peak * np.exp(-0.5 * exponent)
            total += terms[k]
        sums[0] += weights[0] / total
        common = 0.0
        information[e] = 0.0
        for k in range(lowest, num_levels):
            share = terms[k] / total
            sums[k + 1] += share
            common += share * inverses[k]
            if variance > 0.0:
                for a in range(num_axes):
                    information[e, a] += share / (levels2[k] + own[e, a])
        if variance == 0.0:
            for a in range(num_axes):
                information[e, a] = common
        likelihood[e] = np.log(total)


@kernel
def _assemble(at: Any, information: Any, precision: float, blocks: Any, gradient: Any) -> None:
    """Write what each direction adds to the normal matrix (m, d, d) and to the gradient (m, d)."""
    d = gradient.shape[1]
    for e in range(len(gradient)):
        scale, trace = 1.0 / at.lengths[e] ** 2, 0.0
        for a in range(d):
            pull = precision * at.logs[e] * at.units[e, a]
            for q in range(d - 1):
                pull += information[e, q] * at.errors[e, q] * at.across[e, a, q]
            gradient[e, a] = pull / at.lengths[e]
            for b in range(a + 1):
                total = precision * at.units[e, a] * at.units[e, b]
                for q in range(d - 1):
                    total += information[e, q] * at.across[e, a, q] * at.across[e, b, q]
                blocks[e, a, b] = blocks[e, b, a] = scale * total
            trace += blocks[e, a, a]
        for a in range(d):
            blocks[e, a, a] += _RIDGE * trace


@kernel
def _project(inverse: Any, edges: Any, across: Any, lengths: Any, variances: Any) -> None:
    """Write the variances (m, d - 1) of the errors, by the covariances of the nodes and between both ends."""
    nodes, between = inverse
    d = nodes.shape[1]
    for e in range(len(edges)):
        i, j = edges[e]
        for q in range(d - 1):
            total = 0.0
            for a in range(d):
                for b in range(d):
                    block = nodes[i, a, b] + nodes[j, a, b] - between[e, a, b] - between[e, b, a]
                    total += across[e, a, q] * block * across[e, b, q]
            variances[e, q] = total / lengths[e] ** 2
