"""Settings of an adjustment, and what it tells while it runs. Pure data, cheap to import."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

LinearSolver = Literal["auto", "dense", "sparse"]


@dataclass(frozen=True, slots=True)
class AdjustmentStep:
    """What an adjustment tells its `on_iteration` callback after each iteration."""

    iteration: int
    """Number of iterations done, from 1."""
    cost: float
    """The least cost so far, px^2."""
    damping: float
    """Levenberg-Marquardt damping of the next step, relative to the diagonal."""
    accepted: bool
    """Whether this iteration lowered the cost."""


OnIteration = Callable[[AdjustmentStep], bool | None]
"""Called after each iteration; returning False, or raising, cancels the adjustment."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustmentOptions:
    """Settings of one adjustment."""

    loss_scale_px: float | None = 1.0
    """Residual at which the Cauchy loss has halved the weight of an observation; None for plain squares."""
    hold_rotations: bool = False
    """Keep every rotation as it is, to the last bit. Rotations with a prior are weighted, not held."""
    free_focal_lengths: bool = False
    """Adjust the focal lengths of all lenses that are not fixed; cameras of one lens share them."""
    free_distortion: bool = False
    """Adjust the distortion of all lenses that are not fixed, where their model has one."""
    noise_px: float = 0.5
    """Standard deviation of a right observation per axis: what weighs priors, and scales covariances."""
    cost_tolerance: float = 1e-6
    """Stop once a step lowers the cost by less than this share of it."""
    gradient_tolerance: float = 1e-10
    """Stop once no parameter's column of the Jacobian has a larger cosine with the residuals."""
    max_iterations: int = 100
    """Limit of linear systems solved; reaching it is reported, never silent."""
    linear_solver: LinearSolver = "auto"
    """How the system of the cameras is factored: "dense" by LAPACK, "sparse" in blocks; "auto" is dense up to
    3,000 unknowns (500 cameras)."""
    threads: int = 1
    """Threads that share the work; the answer is the same, to the last bit, whatever their number."""

    def __post_init__(self) -> None:
        """Refuse what makes no sense, by name."""
        if self.loss_scale_px is not None:
            self._refuse_unless(self.loss_scale_px > 0.0, "loss_scale_px", "positive or None")
        self._refuse_unless(0.0 < self.noise_px < math.inf, "noise_px", "positive and finite")
        for name in ("cost_tolerance", "gradient_tolerance"):
            self._refuse_unless(0.0 <= getattr(self, name) < 1.0, name, "in [0, 1)")
        for name in ("max_iterations", "threads"):
            self._refuse_unless(getattr(self, name) >= 1, name, "at least 1")
        known = get_args(LinearSolver)
        self._refuse_unless(self.linear_solver in known, "linear_solver", f"one of {', '.join(known)}")

    def _refuse_unless(self, holds: bool, name: str, what: str) -> None:
        if not holds:
            raise ValueError(f"AdjustmentOptions.{name} must be {what}, got {getattr(self, name)}")
