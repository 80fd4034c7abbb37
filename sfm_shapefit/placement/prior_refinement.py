"""Position priors that pull the cameras: opt-in, after they have set scale, origin and axes.

Standard deviations that are given are often too small, as those of GPS are. The kernel of `refine_anchored`
would then hold on to the few priors that happen to fit, and shift the whole model to these. Where most priors
are farther off than it reaches, deviations start as large as the residuals, and are halved down to those that
are given, as long as half of the priors or more are within its reach (graduated non-convexity, Blake,
Zisserman 1987, "Visual Reconstruction").
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import MEDIAN_NORMAL_LENGTH
from sfm_shapefit.placement.gauge import FEWEST_CHECKED, Gauge
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
    vagueness: float
    """Ratio of the standard deviations that the priors count with to those that are given, 1 or more."""


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
    refine = partial(refine_anchored, part, levels=levels, max_bytes=options.solver.factor_bytes)
    vagueness = 1.0 if _fit_most(anchors, start) else _vagueness(anchors, start)
    moved = refine(start, anchors=_vaguer(anchors, vagueness))
    while vagueness > 1.0:
        sharper = max(0.5 * vagueness, 1.0)
        then = refine(moved, anchors=_vaguer(anchors, sharper))
        if not _fit_most(_vaguer(anchors, sharper), then):
            break
        moved, vagueness = then, sharper
    anchors = _vaguer(anchors, vagueness)
    by = float(np.median(np.linalg.norm((moved - start)[: len(placement.cameras)], axis=1)))
    held = anchors.indices[anchors.chi2(moved) <= KERNEL_WIDTH**2]
    locations = (moved - gauge.similarity.translation) / gauge.similarity.scale
    kept = refined.moved_to(locations, np.setdiff1d(refined.reset_nodes, held))
    return Pulled(
        replace_locations(placement, kept),
        replace(gauge, statement=f"{gauge.statement}{PULLED}{by:.3g} (median)"),
        weighted_anchors(anchors, moved),
        vagueness,
    )


def _fit_most(anchors: KnownPositions, t: FloatArray) -> bool:
    """Return whether the kernel reaches half of the anchors; true where they do not check one another."""
    held = anchors.chi2(t) <= KERNEL_WIDTH**2
    return len(held) < FEWEST_CHECKED or bool(np.mean(held) >= 0.5)


def _vagueness(anchors: KnownPositions, t: FloatArray) -> float:
    """Return how many times as far off anchors are as they say, in the median."""
    return float(np.sqrt(np.median(anchors.chi2(t)))) / MEDIAN_NORMAL_LENGTH


def _vaguer(anchors: KnownPositions, vagueness: float) -> KnownPositions:
    """Return the anchors with standard deviations so many times as large."""
    return anchors._replace(information=anchors.information / vagueness**2)


def _anchor(start: FloatArray, known: KnownPositions, axes: FloatArray) -> KnownPositions:
    """Return the priors in the input's axes; those of unknown covariance get that of their residuals."""
    turned = known._replace(positions=known.positions @ axes)
    level = float(np.median(np.linalg.norm(turned.off(start), axis=1))) / MEDIAN_NORMAL_LENGTH
    information = known.information.copy()
    information[~np.isfinite(information).all(axis=(1, 2))] = level**-2 * np.eye(3)
    return turned._replace(information=axes.T @ information @ axes)
