"""What `locate` returns, and its files."""

from sfm_shapefit.results.result import FurtherPiece, GraphResult, Inputs, LocateResult
from sfm_shapefit.results.rows import camera_rows, own_camera_rows, pair_rows, piece_rows
from sfm_shapefit.results.warnings import graph_warnings, match_warnings, quality_warnings, trust_warnings

__all__ = [
    "FurtherPiece",
    "GraphResult",
    "Inputs",
    "LocateResult",
    "camera_rows",
    "graph_warnings",
    "match_warnings",
    "own_camera_rows",
    "pair_rows",
    "piece_rows",
    "quality_warnings",
    "trust_warnings",
]
