"""Files of other programs, read into plain values and written from them; one module per format."""

from sfm_shapefit.formats.g2o import g2o_text, is_g2o, read_g2o, read_g2o_rotations
from sfm_shapefit.formats.glomap_text import is_relative_poses, read_relative_poses, relative_poses_text
from sfm_shapefit.formats.graph_text import graph_text, read_graph
from sfm_shapefit.formats.lines import refuse_irregular_file
from sfm_shapefit.formats.onedsfm import (
    EpipolarGeometries,
    is_onedsfm,
    onedsfm_files,
    read_onedsfm,
    read_rotations,
)

__all__ = [
    "EpipolarGeometries",
    "g2o_text",
    "graph_text",
    "is_g2o",
    "is_onedsfm",
    "is_relative_poses",
    "onedsfm_files",
    "read_g2o",
    "read_g2o_rotations",
    "read_graph",
    "read_onedsfm",
    "read_relative_poses",
    "read_rotations",
    "refuse_irregular_file",
    "relative_poses_text",
]
