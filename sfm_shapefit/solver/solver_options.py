"""What the solver is told and what it answers: data alone, cheap to import."""

import enum
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal, Self

from sfm_shapefit.base.display import Displayed
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.settings import Settings, explained, option
from sfm_shapefit.base.threads import MAX_THREADS, count_threads

if TYPE_CHECKING:  # numpy is not cheap
    from sfm_shapefit.base.arrays import FloatArray
    from sfm_shapefit.base.executors import Advance

Solver = Literal["auto", "newton", "admm", "conic"]

NO_FACTOR = 0
"""Megabytes for `factor_memory_mb`: nothing is factored that can be left out."""

PAIRS_AT_SCALE = 1_000_000
"""Pairs of a view graph; with more, a solve to the last digit or a second one takes a minute or more."""

# Gap and iterations of a start at scale. A few cameras that hang by few right pairs creep for hundreds of
# iterations: boxes of 1e5, 60 % wrong, come to 3e-6 in 36, to 2e-6 in 60, to 1.4e-6 in none of 186.
_TOL_OF_MANY, _ITERATIONS_OF_MANY = 1e-6, 60


class Status(enum.Enum):
    """Why the solver stopped; the value is the sentence shown to the user."""

    CONVERGED = "the certified gap is below the tolerance"
    INACCURATE = (
        "the solver stalled above the tolerance; the certified gap says how far off the answer may be"
    )
    MAX_ITERATIONS = "the iteration limit was reached; raise max_iterations or loosen tol"
    CANCELLED = "on_iteration cancelled the solve; these are the last iterate and what it proves"


@dataclass(frozen=True, slots=True)
class IterationInfo:
    """What a solver tells its `on_iteration` callback after each iteration."""

    iteration: int
    """Number of iterations done, from 1."""
    objective: float
    """Objective at the iterate, in the scale of `SolverResult.objective`."""
    dual_bound: float | None
    """A rigorous lower bound if the method has one at every iterate, else None."""
    limit: int = 0
    """Iterations after which the solver stops at the latest; 0 where that is not known."""


OnIteration = Callable[[IterationInfo], bool | None]
"""Called after each iteration; returning False, or raising, cancels the solve."""


def reported(advance: "Advance") -> OnIteration:
    """Return a callback that reports each iteration: of at most so many, for fewer may do."""
    return lambda info: advance(info.iteration, max(info.limit, info.iteration))


def asks_to_stop(on_iteration: OnIteration | None, info: IterationInfo) -> bool:
    """Tell the callback, if any, of an iteration; return whether it cancels, as a numpy False does."""
    answer = None if on_iteration is None else on_iteration(info)
    return answer is not None and not answer


class Watch:
    """Passes iterations on to the user's callback, and remembers whether it cancelled."""

    def __init__(self, on_iteration: OnIteration | None, *, limit: int = 0, done: int = 0) -> None:
        """Pass on `limit`, and iterations that follow `done` earlier ones."""
        self._on_iteration, self._limit, self._done = on_iteration, limit, done
        self.cancelled = False

    def __call__(self, info: IterationInfo) -> bool:
        """Pass one iteration on; return whether to go on."""
        passed = replace(info, iteration=self._done + info.iteration, limit=self._limit)
        self.cancelled = asks_to_stop(self._on_iteration, passed)
        return not self.cancelled


@explained
@dataclass(frozen=True, kw_only=True)
class SolverOptions(Settings):
    """The solver.

    The program that it solves has no unit: it fixes its own scale.
    """

    solver: Solver = option(
        "auto",
        'Which solver: "newton" is primal-dual Newton, "admm" splitting (with Newton steps at the end if the '
        'gap needs them) for large graphs, "conic" the generic conic program through cvxpy and Clarabel; '
        '"auto" picks by size and predicted fill, splits where "newton" stalls in the plane, and says why.',
    )
    tol: float = option(
        1e-8,
        "Certified gap, objective - dual_bound, at which a solve counts as converged. Placements of more "
        "than a million pairs take 1e-6 unless another value is given.",
    )
    max_iterations: int | None = option(
        None,
        "Largest number of iterations; by default the solver's own, and 60 for a placement of more than a "
        "million pairs. Reaching it is reported, never silent.",
    )
    uniqueness: bool = option(
        True,
        "Also examine whether the certificate proves the optimum unique; costs one sparse factorization.",
    )
    factor_memory_mb: int = option(
        2000,
        "Memory of one sparse factor. Larger ones are replaced by iterations in the solve, and left out "
        "elsewhere: on long chains in the refinement, and for standard deviations.",
    )
    threads: int = option(
        0, f"Threads to use, at most {MAX_THREADS}, or 0 for one per core. The answer does not depend on it."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.tol < 1.0:
            raise ValueError(f"tol must lie in (0, 1), got {self.tol}")
        if self.max_iterations is not None:
            self.check_range("max_iterations", 1)
        self.check_range("factor_memory_mb", NO_FACTOR)
        self.check_range("threads", 0, MAX_THREADS)

    def at_scale(self, num_pairs: int) -> Self:
        """Return the options for the starts of a placement of so many pairs; those that are told stay."""
        if num_pairs <= PAIRS_AT_SCALE:
            return self
        tol = _TOL_OF_MANY if self.tol == type(self)().tol else self.tol
        return replace(self, tol=tol, max_iterations=self.max_iterations or _ITERATIONS_OF_MANY)

    @property
    def factor_bytes(self) -> int:
        """What one sparse factor may take."""
        return self.factor_memory_mb * 1_000_000

    def num_threads(self) -> int:
        """Return the number of threads to use."""
        return count_threads(self.threads)


class Solve(Record):
    """A certified ShapeFit solve: of the largest piece, or over pieces that are joined."""

    status: Annotated[str, "converged, inaccurate, max_iterations or cancelled."]
    objective: Annotated[float | None, "R(T) / L(T) of the paper at the ShapeFit optimum, dimensionless."]
    dual_bound: Annotated[float | None, "No placement has a lower objective."]
    gap: Annotated[float | None, "objective - dual_bound."]
    equality_residual: Annotated[
        float | None, "Violation of the dual's equality, relative to the largest weighted degree."
    ]
    unique: Annotated[bool | None, "Whether the certificate proves the optimum unique; null if not examined."]
    iterations: Annotated[int, "Iterations of the solver that ran."]
    seconds: Annotated[float, "Wall-clock time of the solve."]
    method: Annotated[str, "The solver that ran."]
    method_reason: Annotated[str, "Why it was chosen."]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class SolverResult(Displayed):
    """A solve's answer together with the evidence that it is one."""

    locations: "FloatArray"
    """(n, d) camera centers with centroid 0, scaled so that sum_e w_e <t_i - t_j, v_e> = sum_e w_e."""
    status: Status
    objective: float
    """R(T) / L(T) of the paper at `locations`: a length-weighted mean tangent of the angular errors."""
    dual_bound: float
    """Value of the feasible dual point `dual`: no locations have an objective below it."""
    dual: "FloatArray"
    """(m, d) y_e, orthogonal to v_e, ||y_e|| <= w_e; at every camera the sum of signed y_e equals
    dual_bound times the sum of signed w_e v_e."""
    equality_residual: float
    """Largest violation of that equality at a camera, relative to the largest weighted degree."""
    unique: bool | None
    """True: the certificate proves that no other locations are optimal (up to translation, scale and the
    gap). False: it does not prove that. None: not examined."""
    iterations: int
    """Interior-point, Newton or splitting steps."""
    seconds: float
    """Wall-clock time of solving and certifying."""
    method: str
    """The solver that ran."""
    method_reason: str
    """Why it was chosen."""

    @property
    def gap(self) -> float:
        """How far `objective` may be above the optimum, in the same dimensionless scale."""
        return self.objective - self.dual_bound

    @property
    def converged(self) -> bool:
        """Whether the certified gap is below the tolerance."""
        return self.status is Status.CONVERGED

    @property
    def facts(self) -> Solve:
        """The `solve` object of locate.json."""
        return Solve.taken_from(self, status=self.status.name.lower())

    def _headline(self) -> str:
        found = f"{len(self.locations)} locations, {self.status.name.lower()}"
        return f"{found}, objective {self.objective:.6g}, gap {self.gap:.1e}"
