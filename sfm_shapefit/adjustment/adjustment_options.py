"""Settings of an adjustment. Pure data, cheap to import."""

import math
from dataclasses import dataclass
from typing import Literal

from sfm_shapefit.base.settings import Settings, explained, option
from sfm_shapefit.base.threads import MAX_THREADS

LinearSolver = Literal["auto", "dense", "sparse", "iterative"]


@explained
@dataclass(frozen=True, kw_only=True)
class AdjustmentOptions(Settings):
    """How poses and points are adjusted by their reprojection errors."""

    loss_scale_px: float | None = option(
        1.0, "Residual at which the Cauchy loss has halved the weight of an observation; None for squares."
    )
    hold_rotations: bool = option(
        False, "Keep every rotation as it is, to the last bit; a prior on rotations then says nothing."
    )
    free_focal_lengths: bool = option(
        False, "Adjust the focal lengths of all lenses that are not fixed; cameras of one lens share them."
    )
    free_distortion: bool = option(
        False, "Adjust the distortion of all lenses that are not fixed, where their model has one."
    )
    noise_px: float = option(
        0.5, "Standard deviation of a right observation per axis: it weighs priors and scales covariances."
    )
    cost_tolerance: float = option(1e-6, "Stop once a step lowers the cost by less than this share of it.")
    gradient_tolerance: float = option(
        1e-10, "Stop once no parameter's column of the Jacobian has a larger cosine with the residuals."
    )
    first_damping: float = option(
        1e-4,
        "Levenberg-Marquardt damping of the first step, relative to the diagonal; near the minimum, less of "
        "it lets a long shape bend that single cameras hardly feel.",
    )
    settles_points: bool = option(
        False,
        "Let points also step by themselves, before the first step and with each: a third of the iterations "
        "near the minimum; far from it single points may end in another minimum of their own.",
    )
    max_iterations: int = option(
        100, "Limit of linear systems solved; reaching it is reported, never silent."
    )
    linear_solver: LinearSolver = option(
        "auto",
        "How the system of the cameras is solved: by one dense factor, a sparse one in blocks, or by "
        "conjugate gradients with blocks and a coarse system; auto is dense up to 3,000 unknowns (500 "
        "cameras), and sparse beyond. Covariances always take a factor.",
    )
    threads: int = option(
        0, f"Threads to use, at most {MAX_THREADS}, or 0 for one per core. The answer does not depend on it."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("loss_scale_px", "noise_px"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {value}")
        self.check_range("cost_tolerance", 0.0, 1.0)
        self.check_range("gradient_tolerance", 0.0, 1.0)
        self.check_range("first_damping", 0.0, 1.0)
        self.check_range("max_iterations", 1)
        self.check_range("threads", 0, MAX_THREADS)
