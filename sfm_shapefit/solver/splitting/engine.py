"""The iteration that ShapeFit and LUD share: alternating directions with a factored graph Laplacian.

    minimize  sum_e phi_e(y_e)    subject to  y = D T,  and for ShapeFit  <c, T> = kappa

with the edge state x of `edges` (y and the scaled multiplier u in one vector) and a penalty rho_e per
edge. With L = D^T diag(rho) D one iteration is

    solve    L delta = D^T rho (y - u - D T) + lambda c           T <- T + delta
    scale    T <- T + beta h,  lambda <- lambda + beta            L h = c,  beta so that <c, T> = kappa
    pass     x <- relaxation D T + (1 - relaxation) y + u         and the sums over edges

At a fixed point delta = 0 and beta = 0, however inexact the solves are, so D^T (rho u) = lambda c: rho u
and lambda are the dual of the program. It lies in its ball at every iteration.

Penalties w_e / r_e, with r_e the residual of the edge, make the augmented term the local curvature of
w ||r||. They are renewed a few times, with a lower floor on r_e each time as the residuals become
trustworthy, and scaled by the balance of the primal and the dual residual.

Sources: Boyd et al., "Distributed optimization and statistical learning via the alternating direction
method of multipliers" (2011), sections 3.4.1 and 3.4.3.
"""

import enum
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.laplacian.factor import LaplacianFactor
from sfm_shapefit.solver.solver_options import IterationInfo, OnIteration, asks_to_stop
from sfm_shapefit.solver.splitting.anderson import Anderson
from sfm_shapefit.solver.splitting.edges import CHANGE, INTERIOR, OBJECTIVE, EdgePasses

# Renewed penalties are rho_e = _PENALTY w_e / max(r_e, floor mean(r)).
_PENALTY = 0.5  # dimensionless; see above
_FLOORS = (0.1, 0.03, 0.01)  # shares of the mean residual, by renewal; the last one stays
# While the iteration is accelerated every renewal has this floor: even penalties leave more to acceleration.
_ANDERSON_FLOOR = 0.3
# A renewal leaves the scale of the penalties alone where primal over dual residual has this value: with
# acceleration the first, else those of the successive renewals, of which the last one stays. What has not
# converged by the third, as communities that hang together by few pairs, creeps along smooth modes, and
# smaller penalties free them (community graph of 1e4 cameras to 1e-4: 133 iterations instead of 222).
_BALANCE = 1.0
_BALANCES = (_BALANCE, _BALANCE, 4.0, 2.0)
_ANDERSON_MEMORY = 6  # differences kept; each costs a pass over the edges
_ANDERSON_RELAXATION = 1.0  # none; over-relaxation and acceleration get in each other's way
_ANDERSON_INTERIOR = 0.3  # fraction of edges inside their ball; from here on acceleration can pay, unless ...
_ANDERSON_KEPT = 0.9  # ... less than this share of the fraction one renewal earlier is left; noise rules then
_ANDERSON_GIVE_UP = 4.0  # length of a step over the one before; a longer one discards the history
# Ratio to the first objective above which the iteration restarts without acceleration: the history of a tiny
# problem may be longer than it has dimensions.
_ASTRAY_PER_FIRST = 10.0
_LEAST_FIRST_OBJECTIVE = 1e-6  # objective, dimensionless; exact data begin at rounding
_STEPS_LEFT = 10.0  # steps of the present length to the fixed point, at least: convergence is linear
_MOST_STEPS_LEFT = 1000.0  # likewise, at most; a stalled iteration has no estimate
_CONTRACTION_WINDOW = 10  # iterations over which the shrinking of the steps is measured; evens it out
_STALL_WINDOW = 150  # iterations without a better estimate; then it has stalled


class Stop(enum.Enum):
    """Why the iteration ended; the value is the sentence shown to the user."""

    ACCURATE = "the estimated relative accuracy was reached"
    MAX_ITERATIONS = "the iteration limit was reached; raise max_iterations or loosen tol"
    STALLED = (
        "the splitting stalled; if its linear solves were iterative, allow more memory for the factor, "
        "else use the Newton solver"
    )
    CANCELLED = "cancelled by on_iteration"


class Goal(NamedTuple):
    """When a run ends."""

    tol: float
    """Relative error of the objective, estimated."""
    absolute_tol: float
    """Error of the objective, in its own units, that is accurate enough whatever `tol` says."""
    max_iterations: int


class Tuning(NamedTuple):
    """How the iteration runs for one program."""

    relaxation: float
    renewals: tuple[int, ...]
    """Iterations after which the penalties are renewed; none leaves them constant."""
    penalty: float
    """rho_e at the start is penalty * w_e / mean residual of the first solution."""
    accelerate: bool
    """Allow Anderson acceleration where the data call for it."""


@dataclass(slots=True, eq=False)
class State:
    """The iterate. Arrays over edges are in the order of the passes."""

    x: FloatArray
    t: FloatArray
    rho: FloatArray
    multiplier: float = 0.0
    scale: float = 1.0
    """Factor on the penalties from balancing."""
    pull: FloatArray = field(default_factory=lambda: np.empty(0))
    """D^T rho (y - u - D T)."""
    unit: FloatArray = field(default_factory=lambda: np.empty(0))
    """h with L h = c."""
    sums: FloatArray = field(default_factory=lambda: np.zeros(5))
    spare: FloatArray = field(default_factory=lambda: np.empty(0))
    """Room for the next x while acceleration needs the old one."""
    steps: list[float] = field(default_factory=list)
    """Squared steps since the penalties were renewed."""
    steps_left: float = _STEPS_LEFT
    """How many steps of the present length the fixed point is away."""
    interior: float = np.inf
    """Fraction of edges inside their ball at the last renewal."""
    anderson: Anderson | None = None
    """The history, while the iteration is accelerated."""


class Outcome(NamedTuple):
    """Where the iteration ended."""

    state: State
    iterations: int
    stop: Stop


class Iteration:
    """One run: the program, its factor and passes, and the steps between them."""

    def __init__(
        self, passes: EdgePasses, factor: LaplacianFactor, tuning: Tuning, c: FloatArray | None, kappa: float
    ) -> None:
        """Set up the program <c, T> = kappa over the edges of `passes`; no such constraint if c is None."""
        self.passes, self.factor, self.tuning, self.c, self.kappa = passes, factor, tuning, c, kappa
        self._factored = 1.0  # the factor is that of the Laplacian of rho / _factored
        self._astray = np.inf  # objective from which acceleration has led away from the solution

    def run(self, goal: Goal, on_iteration: OnIteration | None, resumed: Outcome | None = None) -> Outcome:
        """Iterate from the least-squares locations, or from where a run ended, until a reason to stop.

        Between two runs the factor may have been used for other weights; it is computed anew.
        """
        state, done = (self._start(), 0) if resumed is None else (resumed.state, resumed.iterations)
        if resumed is not None:
            self._factor(state)
        best, best_at = np.inf, done
        for k in range(done + 1, goal.max_iterations + 1):
            if k > 1:
                self._move(state)
            renew = k in self.tuning.renewals
            before = state.x.copy() if renew else None
            self._pass(state)
            if asks_to_stop(on_iteration, IterationInfo(k, self.objective(state), None)):
                return Outcome(state=state, iterations=k, stop=Stop.CANCELLED)
            if self._is_astray(state, k):
                state, best, best_at = self._begin_again(), np.inf, k
                continue
            residual = self._residual(state)
            allowed = max(goal.tol * self.objective(state), goal.absolute_tol)
            if max(residual, self._error(state)) <= allowed:
                return Outcome(state=state, iterations=k, stop=Stop.ACCURATE)
            if residual < 0.5 * best:
                best, best_at = residual, k
            elif k - best_at > max(_STALL_WINDOW, k // 2):
                return Outcome(state=state, iterations=k, stop=Stop.STALLED)
            if before is not None:
                state.anderson = self._accelerator(state)
                floor, wanted = _ANDERSON_FLOOR, _BALANCE
                if state.anderson is None:
                    renewal = self.tuning.renewals.index(k)
                    floor = _FLOORS[min(renewal, len(_FLOORS) - 1)]
                    wanted = _BALANCES[min(renewal, len(_BALANCES) - 1)]
                state.scale *= np.sqrt(self._balance(state, before, wanted) / wanted)
                before = None  # its memory is needed for the factor
                self._renew(state, floor)
        return Outcome(state=state, iterations=goal.max_iterations, stop=Stop.MAX_ITERATIONS)

    def objective(self, state: State) -> float:
        """Return the objective at the locations of the last pass, relative to kappa."""
        return float(state.sums[OBJECTIVE]) / self.kappa

    def _is_astray(self, state: State, k: int) -> bool:
        """Return whether the accelerated iteration is far above the objective that it began with."""
        objective = self.objective(state)
        if k == 1:
            self._astray = _ASTRAY_PER_FIRST * max(objective, _LEAST_FIRST_OBJECTIVE)
        return state.anderson is not None and not objective <= self._astray

    def _begin_again(self) -> State:
        """Return the state of the beginning, and accelerate no more."""
        self.tuning = self.tuning._replace(accelerate=False)
        state = self._start()
        state.pull = self.passes.pull(state.x, state.t, state.rho)
        return state

    def _start(self) -> State:
        """Return the state at unit lengths, y = v and u = 0, with the least-squares locations of y."""
        data = self.passes.data
        state = State(
            x=data.directions.copy(),
            t=np.zeros((data.num_nodes, data.directions.shape[1])),
            rho=data.weights.copy(),
        )
        self._factor(state)
        state.pull = self.passes.pull(state.x, state.t, state.rho)
        self._move(state)
        self._factored = self.tuning.penalty / _mean(self.passes.residuals(state.t), data.weights)
        state.rho *= self._factored
        state.unit /= self._factored
        state.multiplier *= self._factored
        return state

    def _factor(self, state: State) -> None:
        """Factor the Laplacian of the penalties and solve for the direction of the constraint."""
        self.factor.refactor(self.passes.in_graph_order(state.rho))
        self._factored = 1.0
        if self.c is not None:
            state.unit = self.factor.solve(self.c)

    def _move(self, state: State) -> None:
        """Move the locations to the minimum of the augmented term on the constraint."""
        if self.c is None:
            state.t += self.factor.solve(state.pull) / self._factored
            return
        state.t += self.factor.solve(state.pull + state.multiplier * self.c) / self._factored
        missing = self.kappa - float(np.vdot(self.c, state.t))
        beta = missing / float(np.vdot(self.c, state.unit))
        state.t += beta * state.unit
        state.multiplier += beta

    def _pass(self, state: State) -> None:
        """Take the proximal step, accelerated if there is a history."""
        anderson = state.anderson
        relaxation = self.tuning.relaxation if anderson is None else _ANDERSON_RELAXATION
        if anderson is not None and state.spare.shape != state.x.shape:
            state.spare = np.empty_like(state.x)
        target = state.x if anderson is None else state.spare
        state.pull, state.sums = self.passes.step(state.x, target, state.t, state.rho, relaxation)
        state.steps.append(float(state.sums[CHANGE]))
        state.steps_left = _steps_left(state) if anderson is None else _STEPS_LEFT
        if anderson is None:
            return
        if len(state.steps) > 1 and state.steps[-1] > _ANDERSON_GIVE_UP**2 * state.steps[-2]:
            anderson.restart()
        state.x, state.spare = anderson.advance(state.x, target, state.rho), state.x
        state.pull = self.passes.pull(state.x, state.t, state.rho)

    def _residual(self, state: State) -> float:
        """Return how far the iterate is from a fixed point: the gap to its dual value, or ten steps."""
        objective, pairing, along, change = state.sums[:4]
        dual_value = pairing - (along if self.passes.data.least > -np.inf else 0.0)
        return float(max(abs(objective - dual_value), _STEPS_LEFT * change)) / self.kappa

    def _error(self, state: State) -> float:
        """Return the objective's error, by Cauchy and Schwarz at most the step times the distance left."""
        return state.steps_left * float(state.sums[CHANGE]) / self.kappa

    def _renew(self, state: State, floor: float) -> None:
        """Replace the penalties by w / max(residual, floor * mean) and factor anew; y and rho u stay."""
        passes = self.passes
        rho = passes.residuals(state.t)
        np.maximum(rho, floor * _mean(rho, passes.data.weights), out=rho)
        np.divide(state.scale * _PENALTY * passes.data.weights, rho, out=rho)
        passes.change_penalties(state.x, state.rho, rho)
        state.rho, state.steps = rho, []
        self._factor(state)
        state.pull = passes.pull(state.x, state.t, state.rho)

    def _balance(self, state: State, before: FloatArray, otherwise: float) -> float:
        """Return the norm of D T - y over that of rho (y - y before); `otherwise` where one of them is 0."""
        primal, dual = self.passes.imbalance(before, state.x, state.t, state.rho)
        if not (primal > 0.0 and dual > 0.0):
            return otherwise
        return float(np.sqrt(np.clip(primal / dual, 1e-2, 1e2)))

    def _accelerator(self, state: State) -> Anderson | None:
        """Return an empty history if so many edges fit exactly that acceleration pays, else None.

        With noise, fewer and fewer edges are inside their ball. The first renewal only takes note of them.
        """
        before, state.interior = state.interior, float(state.sums[INTERIOR]) / len(state.x)
        pays = state.interior >= max(_ANDERSON_INTERIOR, _ANDERSON_KEPT * before)
        if not (self.tuning.accelerate and pays):
            return None
        if state.anderson is None:
            return Anderson(self.passes, state.x.shape, _ANDERSON_MEMORY)
        state.anderson.restart()
        return state.anderson


def _mean(residuals: FloatArray, weights: FloatArray) -> float:
    """Return the weighted mean residual, kept away from 0 (the mean edge has length about 1)."""
    return max(float(np.vdot(weights, residuals) / weights.sum()), 1e-6)


def _steps_left(state: State) -> float:
    """Return how many steps are left, 1 / (1 - q) if they go on to shrink by q; a renewal lets them jump."""
    if len(state.steps) <= _CONTRACTION_WINDOW:
        return state.steps_left
    now, before = state.steps[-1], state.steps[-1 - _CONTRACTION_WINDOW]
    if not before > 0.0:
        return _STEPS_LEFT
    shrinking = (now / before) ** (0.5 / _CONTRACTION_WINDOW)  # the steps are squared
    return float(np.clip(1.0 / max(1.0 - shrinking, 1.0 / _MOST_STEPS_LEFT), _STEPS_LEFT, None))
