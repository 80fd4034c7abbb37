"""What is given up so that a run stays below a limit of memory, the cheapest first."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.scene.matches import PLENTY, Reading
from sfm_shapefit.solver.solver_options import NO_FACTOR

_FRUGAL = Reading(batch=50_000, rays_bytes=50_000_000, keeps=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class MemoryPlan:
    """What is given up for memory."""

    statement: str = ""
    """What that is, for the user; empty for nothing."""
    reading: Reading = PLENTY
    """How matches are read."""
    divides: bool = False
    """Whether adjustments are divided, see `adjustment.divided`."""
    samples: bool = True
    """Whether the errors of directions are sampled together where keypoints are shared."""
    points: bool = True
    """Whether 3D points may join the graph."""
    adjustment: bool = True
    """Whether placed cameras may be adjusted by their matches."""
    factor: bool = True
    """Whether there is a factor for the refinement and the standard deviations."""

    def limit(self, options: PlacementOptions) -> PlacementOptions:
        """Return how to place: as asked, or, if the factor is given up, unrefined and without one."""
        if self.factor:
            return options
        return replace(options, solver=replace(options.solver, factor_memory_mb=NO_FACTOR), refine=False)


def _list_memory_plans() -> Iterator[MemoryPlan]:
    """Yield what can be given up, the cheapest first, each with all that comes before it."""
    plan = MemoryPlan()
    yield plan
    given_up: list[str] = []
    for what, changes in (
        ("matches are read in small batches", {"reading": _FRUGAL}),
        ("adjustments go part by part", {"divides": True}),
        ("directions count as independent in standard deviations", {"samples": False}),
        ("no 3D points join the view graph", {"points": False}),
        ("cameras are not adjusted by their matches", {"adjustment": False}),
        ("locations are neither refined nor have they standard deviations", {"factor": False}),
    ):
        given_up.append(what)
        plan = replace(plan, statement=", ".join(given_up), **changes)
        yield plan


MEMORY_PLANS = tuple(_list_memory_plans())
"""The cheapest first."""
