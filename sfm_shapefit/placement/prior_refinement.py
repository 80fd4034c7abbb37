"""Let position priors pull the cameras: opt-in, after they have set scale, origin and axes."""

from dataclasses import replace

import numpy as np

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.geometry import MEDIAN_NORMAL_LENGTH
from sfm_shapefit.judgement.trust import Evidence
from sfm_shapefit.judgement.verdicts import assess
from sfm_shapefit.placement.gauge import Gauge, PositionPriors
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.refinement.anchored import Anchors, refine_anchored
from sfm_shapefit.refinement.angular import Metric


def pulled(
    placement: Placement,
    gauge: Gauge,
    priors: PositionPriors,
    covariance: FloatArray,
    evidence: Evidence,
) -> tuple[Placement, Gauge]:
    """Return the placement refined on directions and priors together and judged anew, and its gauge.

    Args:
        placement: cameras placed by directions, and points with them.
        gauge: in which the priors are, from `prior_gauge`.
        priors: of the images.
        covariance: (m, 2, 2) of the directions of the whole graph.
        evidence: for the whole graph.
    """
    nodes, edges = placement.nodes, placement.edges
    piece, _ = placement.graph.restricted_to(edges)
    known = covariance[edges]
    classes = np.max(placement.graph.edges[edges] >= placement.num_cameras, axis=1).astype(np.int64)
    own = priors.of(nodes)
    start = gauge.similarity.apply(placement.finish.locations)
    anchors = _anchors(start, own, np.eye(3) if gauge.axes is None else gauge.axes)
    levels = np.radians(np.array(placement.finish.levels_deg))
    moved = refine_anchored(piece, start, Metric(known, classes), levels, anchors)
    locations = (moved - gauge.similarity.translation) / gauge.similarity.scale
    heard = evidence.restricted_to(edges, nodes, placement.graph.num_nodes)
    by = float(np.median(np.linalg.norm((moved - start)[: len(placement.cameras)], axis=1)))
    return (
        replace(
            placement,
            finish=replace(placement.finish, locations=locations),
            assessment=assess(piece, locations, known, heard, len(placement.cameras)),
        ),
        replace(gauge, statement=f"{gauge.statement}; the priors moved cameras by {by:.3g} (median)"),
    )


def _anchors(start: FloatArray, priors: PositionPriors, axes: FloatArray) -> Anchors:
    """Return the priors in the input's axes; those of unknown covariance get that of their residuals."""
    positions = priors.positions @ axes
    residuals = np.linalg.norm(start[priors.cameras] - positions, axis=1)
    level = float(np.median(residuals)) / MEDIAN_NORMAL_LENGTH
    covariances = priors.covariances.copy()
    covariances[~np.isfinite(covariances).all(axis=(1, 2))] = level**2 * np.eye(3)
    information = np.linalg.inv(axes.T @ covariances @ axes)
    return Anchors(priors.cameras, positions, np.asarray(information, dtype=np.float64))
