"""Position priors that pull the cameras: opt-in, after they have set scale, origin and axes."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import MEDIAN_NORMAL_LENGTH
from sfm_shapefit.placement.gauge import Gauge
from sfm_shapefit.placement.place import Placement, replace_locations
from sfm_shapefit.refinement.anchored import refine_anchored, weighted_anchors
from sfm_shapefit.refinement.angular import KERNEL_WIDTH
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.scene.given import PositionPriors
from sfm_shapefit.scene.known_positions import KnownPositions

PULLED = "; the priors moved cameras by "
"""What the statement of the gauge goes on with, before how far."""


class Pulled(NamedTuple):
    """A placement after position priors pulled at it."""

    placement: Placement
    """Refined on directions and priors together."""
    gauge: Gauge
    """Gauge as before; its statement says by how much the priors moved cameras."""
    anchors: KnownPositions
    """The priors by the placement's cameras, in its gauge but for the axes, which are the input's; each has
    the weight that it ended with: a wrong one has none."""


def pull_to_priors(
    placement: Placement, gauge: Gauge, priors: PositionPriors, options: PlacementOptions
) -> Pulled:
    """Return the placement refined on directions and priors together.

    A camera that the refinement had thrown out of the scene and put back stays undetermined, unless a prior
    holds it where it is now. The gauge is that of the priors, from `prior_gauge`; the options are those of
    the placement. UnsolvableError if the factor would take more memory than they allow.
    """
    part, refined = placement.measured_part(), placement.refined
    known = priors.of(placement.nodes).known
    start = gauge.similarity.apply(refined.locations)
    anchors = _anchor(start, known, np.eye(3) if gauge.axes is None else gauge.axes)
    levels = np.radians(np.array(refined.finish.levels_deg))
    moved = refine_anchored(part, start, levels, anchors, max_bytes=options.solver.factor_bytes)
    by = float(np.median(np.linalg.norm((moved - start)[: len(placement.cameras)], axis=1)))
    held = anchors.indices[anchors.chi2(moved) <= KERNEL_WIDTH**2]
    locations = (moved - gauge.similarity.translation) / gauge.similarity.scale
    kept = refined.moved_to(locations, np.setdiff1d(refined.reset_nodes, held))
    return Pulled(
        replace_locations(placement, kept),
        replace(gauge, statement=f"{gauge.statement}{PULLED}{by:.3g} (median)"),
        weighted_anchors(anchors, moved),
    )


def _anchor(start: FloatArray, known: KnownPositions, axes: FloatArray) -> KnownPositions:
    """Return the priors in the input's axes; those of unknown covariance get that of their residuals."""
    turned = known._replace(positions=known.positions @ axes)
    level = float(np.median(np.linalg.norm(turned.off(start), axis=1))) / MEDIAN_NORMAL_LENGTH
    information = known.information.copy()
    information[~np.isfinite(information).all(axis=(1, 2))] = level**-2 * np.eye(3)
    return turned._replace(information=axes.T @ information @ axes)
