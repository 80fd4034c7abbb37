"""What is certified, what is delivered, and how far apart the two are.

The certificate proves the optimum of ShapeFit. What is delivered is mostly not that optimum: it is refined in
angles, from ShapeFit's optimum or from LUD's, and may be adjusted after.
"""

from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import fit_similarity_l1, median_spread
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.solver.options import Status

# A camera that is farther off, of the spread of all, has no say in the common scale, axes and shift.
_CAP_OF_SIZE = 0.5
_OTHERS = {True: ", and no other is as good", False: ", but others may be as good", None: ""}
# A distance that is smaller is rounding.
_SAME = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Departure:
    """How far delivered cameras stand from the certified optimum, after the similarity that fits best."""

    statement: str
    """What is certified, what is delivered, and how far apart they are."""
    median: float
    """Of the distances, as a share of the scene's radius."""
    largest: float


def compare_with_certified(placement: Placement, centers: FloatArray, *, adjusted: bool) -> Departure:
    """Compare the delivered centers with the certified optimum.

    Args:
        placement: the solve and what was kept of it.
        centers: (k, d) delivered centers of `placement.cameras`, NaN for those that are left out.
        adjusted: whether a bundle adjustment came last.
    """
    solved, refined = placement.certified, placement.refined
    delivered = f"{refined.start}, refined in angles" if refined.is_refined else refined.start
    delivered += ", then adjusted" if adjusted else ""
    to = f"to {max(solved.gap, 0.0):.1e}"
    certified = f"ShapeFit's optimum is certified {to}{_OTHERS[solved.unique]}"
    if solved.status is not Status.CONVERGED:
        certified = f"ShapeFit's optimum is not certified to the tolerance, only {to}"
    kept = np.isfinite(centers).all(axis=1)
    optimum, there = solved.locations[: len(centers)][kept], centers[kept]
    size = median_spread(there)
    onto = fit_similarity_l1(optimum, there, cap=_CAP_OF_SIZE * size)
    distances = np.linalg.norm(onto.apply(optimum) - there, axis=1) / size
    median, largest = float(np.median(distances)), float(distances.max())
    apart = (
        f"delivered: {delivered}, {median:.2%} of the scene's radius from it (median; at most {largest:.2%})"
    )
    if largest <= _SAME:
        apart = "delivered: that optimum itself"
    return Departure(statement=f"{certified}; {apart}", median=median, largest=largest)
