"""How a view graph is placed: the solver's options, and what follows the certified solve. Pure data."""

from dataclasses import dataclass
from typing import Literal

from sfm_shapefit.base.settings import Composed, explained, group, option
from sfm_shapefit.solver.solver_options import SolverOptions

Objective = Literal["auto", "shapefit", "lud"]


@explained
@dataclass(frozen=True, kw_only=True, init=False)
class PlacementOptions(Composed):
    """What follows the certified solve."""

    objective: Objective = option(
        "auto",
        'Which program the locations come from. "auto" solves ShapeFit, certified, and LUD, which '
        "does not collapse on long chains, refines both and keeps the one that fits the angles "
        "better; a bare graph of ten cameras or more, with redundant pairs and no rigid groups, is refined "
        "under a mixture of noise levels, from triangles too, and the end of most evidence is kept; "
        '"shapefit" is the certified answer itself, unrefined; "lud" takes LUD whatever its fit.',
    )
    refine: bool = option(
        True, 'Refine the start robustly in the angles of the directions; not for "shapefit".'
    )
    solver: SolverOptions = group(SolverOptions)

    @property
    def refines(self) -> bool:
        """Whether the start is to be refined in angles."""
        return self.refine and self.objective != "shapefit"
