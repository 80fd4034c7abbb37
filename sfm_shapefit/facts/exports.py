"""A placed bare graph in formats of other programs."""

import numpy as np

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.facts.result import GraphResult
from sfm_shapefit.files.g2o import g2o_text
from sfm_shapefit.files.onedsfm import EpipolarGeometries, onedsfm_files


def export_files(found: GraphResult, *, g2o: bool, onedsfm: bool) -> dict[str, str]:
    """Return the texts of the formats that are wanted, by their path in the output folder.

    `positions.g2o` has the placed nodes as vertices, the folder `1dsfm` the pairs that agree and the cameras.

    Raises:
        InputError: if a format has no such dimension.
    """
    files: dict[str, str] = {}
    if g2o:
        cameras = found.placement.cameras
        names = [found.placement.graph.name_of(camera) for camera in cameras.tolist()]
        rotations = None if found.rotations is None else found.rotations[cameras]
        files["positions.g2o"] = g2o_text(names, found.placement.locations, rotations)
    if onedsfm:
        files |= {f"1dsfm/{name}": text for name, text in _agreeing_onedsfm(found).items()}
    return files


def _agreeing_onedsfm(found: GraphResult) -> dict[str, str]:
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
