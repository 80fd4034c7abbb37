"""Pose graphs: relative poses of pairs, of any format, and their directions in the axes of the world."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import rotation_angles_deg
from sfm_shapefit.files.colmap.other_programs import relative_poses_of
from sfm_shapefit.files.g2o import is_g2o, read_g2o, read_g2o_rotations
from sfm_shapefit.files.glomap_text import is_relative_poses, read_relative_poses
from sfm_shapefit.files.onedsfm import EpipolarGeometries, is_onedsfm, read_onedsfm, read_rotations
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.refinement.posterior import weigh_by_triangles
from sfm_shapefit.rotations.average import average_rotations

if TYPE_CHECKING:
    import pycolmap

MAX_ROTATION_ERROR_DEG = 10.0  # degrees; pairs off by more are taken for false, as 1DSfM does


def read_pose_graph(source: "Path | str | pycolmap.PoseGraph") -> EpipolarGeometries | None:
    """Return the relative poses of a source; None if it is a bare graph of directions."""
    if not isinstance(source, Path | str):
        return relative_poses_of(source)
    if is_onedsfm(source):
        return read_onedsfm(source)
    if is_g2o(source):
        return read_g2o(source)
    return read_relative_poses(source) if is_relative_poses(source) else None


def orient_pose_graph(
    poses: EpipolarGeometries,
    path: Path | str | None = None,
    max_rotation_error_deg: float = MAX_ROTATION_ERROR_DEG,
    *,
    threads: int,
) -> tuple[MeasuredGraph, str]:
    """Return the directions of the pairs that agree with the rotations, of a file or averaged."""
    if path is not None:
        read = read_g2o_rotations if is_g2o(path) else read_rotations
        (rotations, known), origin = read(path, poses.names), f"of {path}"
    else:
        averaged = average_rotations(
            poses.pairs,
            poses.rotations,
            poses.information,
            num_images=len(poses.names),
            weights=poses.num_matches,
            threads=threads,
        )
        rotations, known, origin = averaged.rotations, averaged.registered, "averaged"
        if averaged.counts_mislead:
            origin += " without numbers of matches, with which fewer pairs agree"
        elif poses.num_matches is not None:
            origin += " by the numbers of matches"
    agreeing = np.flatnonzero(_agree(poses.pairs, poses.rotations, rotations, max_rotation_error_deg))
    total, kept = len(poses.pairs), len(agreeing)
    statement = (
        f"{int(np.sum(known))} of {len(known)} rotations {origin}; {total - kept} of {total} pairs "
        f"contradict them by more than {max_rotation_error_deg:g} deg and are left out"
    )
    return poses.subset(agreeing.tolist()).measured(rotations, known), statement


def without_contradicted(
    measured: MeasuredGraph, rotations: npt.ArrayLike, num_matches: npt.ArrayLike | None, threads: int
) -> MeasuredGraph:
    """Return what was measured of the pairs whose relative rotations agree with the averaged ones."""
    graph = measured.graph
    averaged = average_rotations(
        graph.edges, rotations, num_images=graph.num_nodes, weights=num_matches, threads=threads
    )
    relative = np.asarray(rotations, dtype=np.float64)
    agree = _agree(graph.edges, relative, averaged.rotations, MAX_ROTATION_ERROR_DEG)
    leave = averaged.registered[graph.edges].all(axis=1) & ~agree
    if num_matches is None and leave.any() and np.mean(weigh_by_triangles(graph).log_odds[leave] > 0.0) > 0.5:
        return measured
    return measured.subset(np.flatnonzero(~leave))


def _agree(pairs: IntArray, relative: FloatArray, rotations: FloatArray, most_deg: float) -> BoolArray:
    """Return which relative rotations of pairs (m, 2) agree with those of the cameras (n, 3, 3), (m,)."""
    i, j = pairs.T
    agree = rotation_angles_deg(relative @ rotations[i] @ rotations[j].swapaxes(1, 2)) <= most_deg
    if not agree.any():
        raise InputError(
            f"none of the {len(pairs)} relative rotations agrees with those of the cameras; "
            "check that they belong together"
        )
    return np.asarray(agree)
