"""How a view graph is placed: the solver's options, and what follows the certified solve. Pure data."""

from dataclasses import dataclass
from typing import Literal, get_args

from sfm_shapefit.solver.options import SolverOptions

Objective = Literal["auto", "shapefit", "lud"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacementOptions(SolverOptions):
    """Settings of a placement."""

    objective: Objective = "auto"
    """Which start the locations come from. ShapeFit is solved and certified always. "auto" solves LUD
    too, which does not collapse on long chains, refines both and keeps the one that fits the angles
    better; "shapefit" is the certified answer itself, unrefined; "lud" takes LUD whatever its fit."""
    refine: bool = True
    """Refine the start robustly in the angles of the directions; never for "shapefit"."""

    def __post_init__(self) -> None:
        super(PlacementOptions, self).__post_init__()
        if self.objective not in get_args(Objective):
            raise ValueError(
                f"PlacementOptions.objective must be one of {get_args(Objective)}, got {self.objective!r}"
            )
