"""What the user should know of a placed model beyond its tables, in the order in which it is told.

Images that are left out stand in the tables with the reason, and in the verdict.

A new warning is a line here, and where that does not suffice a function above the list.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from sfm_shapefit.facts.intrinsics import intrinsics_warnings
from sfm_shapefit.facts.result import NO_POINTS, LocateResult
from sfm_shapefit.facts.warnings import (
    ambiguity_warnings,
    match_warnings,
    prior_warnings,
    quality_warnings,
    support_warnings,
)


def located_warnings(result: LocateResult, of_scale: Sequence[str]) -> Iterator[str]:
    """Yield what the result and the choice of its scale say, a sentence each, doubts first."""
    images, options = result.placed, result.options
    yield from result.evidence.statements
    yield from intrinsics_warnings(result.intrinsics.rows(images))
    yield from match_warnings(result.directions, may_repeat=result.database is not None)
    yield from quality_warnings(result.placement, options.placement)
    yield from ambiguity_warnings(result.placement)
    if result.model.num_points3D() == 0:
        yield f"{NO_POINTS}; bundle adjustment has nothing to start from"
    yield from prior_warnings(result.prior_fit, images.names)
    yield from of_scale
    if options.trust.min_trust == 0.0:
        unsupported = np.flatnonzero(result.support.unsupported).tolist()
        yield from support_warnings([images.names[k] for k in unsupported])
