"""Settings of an adjustment, and what it tells while it runs. Pure data, cheap to import."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from sfm_shapefit.base.settings import Settings, explained, option

LinearSolver = Literal["auto", "dense", "sparse"]
Adjust = Literal["none", "seed", "full"]
IntrinsicsFreedom = Literal["auto", "held", "focal", "all"]
RigFreedom = Literal["held", "free"]

# With more cameras, the adjustment would take longer than all the rest.
_MOST_ADJUSTED_CAMERAS = 2_000


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


@explained
@dataclass(frozen=True, kw_only=True)
class FreedomOptions(Settings):
    """What is adjusted to the pixels, and what may move with it."""

    adjust: Adjust = option(
        "seed",
        'What is adjusted to the pixels: "seed", the placed cameras by all tracks at once, and rotations as '
        "far as they are doubtful, up to 2,000 cameras and not with objectives that deliver an optimum as it "
        'is, or, of rotations that `map` averages, a first placement on few tracks; "full", poses and points '
        'once more by bundle adjustment from the seed; "none", nothing.',
    )
    intrinsics: IntrinsicsFreedom = option(
        "auto",
        'Intrinsics that the adjustments change: "auto", focal length and distortion of cameras that were '
        'never calibrated (COLMAP\'s guess, or EXIF data); "focal", the focal lengths of all cameras; "all", '
        'their distortion too; "held", nothing. What was given pulls by its own weight, and stays where the '
        "matches do not tell it. Cameras that images share stay shared.",
    )
    rigs: RigFreedom = option(
        "held",
        'Where sensors stand in their rigs: "held", where they are; "free", the adjustments change it, each '
        "by one pose for all frames. The reference sensors stay, and so does the mean distance of the others "
        "from them: the scale is still that of the rigs. Refused where the matches do not tell a sensor's "
        "pose.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, asks in (("intrinsics", self.intrinsics in ("focal", "all")), ("rigs", self.rigs == "free")):
            if asks:
                self.refuse_held(name, getattr(self, name))

    def adjusts_cameras(self, num_cameras: int) -> bool:
        """Return whether so many placed cameras are adjusted, unless the optimum is wanted as it is."""
        return self.adjust != "none" and num_cameras <= _MOST_ADJUSTED_CAMERAS

    def refuse_held(self, name: str, value: object) -> None:
        """Refuse a freedom, an option with its value, where nothing is adjusted that could use it.

        Raises:
            ValueError: a sentence that names both options.
        """
        if self.adjust == "none":
            raise ValueError(f"{name}={value} needs an adjustment; leave out adjust=none")


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
    max_iterations: int = option(
        100, "Limit of linear systems solved; reaching it is reported, never silent."
    )
    linear_solver: LinearSolver = option(
        "auto",
        "How the system of the cameras is factored: dense by LAPACK, or sparse in blocks; auto is dense up "
        "to 3,000 unknowns (500 cameras).",
    )
    threads: int = option(1, "Threads that share the work; the answer is the same whatever their number.")

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
        self.check_range("threads", 1, 256)
