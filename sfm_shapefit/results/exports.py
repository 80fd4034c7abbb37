"""A placed bare graph in formats of other programs."""

import numpy as np

from sfm_shapefit.errors import InputError
from sfm_shapefit.formats.g2o import g2o_text
from sfm_shapefit.formats.onedsfm import EpipolarGeometries, onedsfm_files
from sfm_shapefit.results.result import GraphResult


def positions_g2o(found: GraphResult) -> str:
    """Return the placed nodes as g2o vertices."""
    placement = found.placement
    names = [placement.graph.name_of(camera) for camera in placement.cameras.tolist()]
    rotations = None if found.rotations is None else found.rotations[placement.cameras]
    return g2o_text(names, placement.locations, rotations)


def agreeing_onedsfm(found: GraphResult) -> dict[str, str]:
    """Return the 1DSfM files of what agrees with the solution; world axes serve where there are no others."""
    placement, graph = found.placement, found.placement.graph
    if graph.dimension != 3:
        raise InputError(
            f"1DSfM's files are of three dimensions, the graph of {graph.dimension}; leave them out"
        )
    n = graph.num_nodes
    agreeing = placement.edges[placement.pairs[placement.assessment.inliers[placement.pairs]]]
    geometries, rotations = found.geometries, found.rotations
    if geometries is None or rotations is None:
        rotations = np.tile(np.eye(3), (n, 1, 1))
        geometries = EpipolarGeometries(
            names=tuple(graph.name_of(camera) for camera in range(n)),
            pairs=graph.edges,
            rotations=rotations[graph.edges[:, 0]],
            to_second=-graph.directions,
        )
    wanted = set(map(tuple, graph.edges[agreeing].tolist()))
    rows = [k for k, pair in enumerate(geometries.pairs.tolist()) if tuple(pair) in wanted]
    return onedsfm_files(geometries.subset(rows), rotations, placement.cameras, placement.locations)
