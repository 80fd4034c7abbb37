"""OUT on disk: the seeded model, `locate.json`, `cameras.csv`, `pairs.csv`.

Further parallel-rigid pieces stand in `pieces/1`, `pieces/2`, ...: a seeded model and a `cameras.csv` each.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sfm_shapefit.colmap.seed import write_model
from sfm_shapefit.errors import InputError
from sfm_shapefit.formats import EpipolarGeometries, g2o_text, onedsfm_files
from sfm_shapefit.output import MARKER, atomic_folder
from sfm_shapefit.report import CameraRow, PairRow, write_json, write_rows
from sfm_shapefit.results.rows import folder_of, name_of, own_camera_rows
from sfm_shapefit.results.summary import graph_summary, summary
from sfm_shapefit.results.values import GraphResult, LocateResult


def write_result(
    found: LocateResult, out: Path | str, *, overwrite: bool = False, protect: Sequence[Path | str] = ()
) -> None:
    """Write the seeded model and its tables into a folder that appears whole or not at all.

    Args:
        found: what `locate` returned.
        out: the folder to be made.
        overwrite: replace an earlier output of this package.
        protect: paths that `out` must not be or contain, beside the inputs of `found`.

    Raises:
        InputError: if the folder exists, cannot be written, or would hit a protected path.
    """
    inputs = [path for path in (found.inputs.folder, found.inputs.database) if path is not None]
    with atomic_folder(out, overwrite=overwrite, protect=[*inputs, *protect]) as folder:
        write_model(found.reconstruction, folder)
        _write_tables(found, summary(found), folder)
        for piece in found.further:
            subfolder = folder / folder_of(piece.placement.piece)
            subfolder.mkdir(parents=True)
            write_model(piece.reconstruction, subfolder)
            write_rows(piece.cameras, CameraRow, 3, subfolder / "cameras.csv")


def write_graph_result(
    found: GraphResult,
    out: Path | str,
    *,
    overwrite: bool = False,
    g2o: bool = False,
    onedsfm: bool = False,
    protect: Sequence[Path | str] = (),
) -> None:
    """Write the tables of a bare graph like `write_result`; there is no model.

    Args:
        found: what `solve_graph_file` returned.
        out, overwrite, protect: see `write_result`.
        g2o: also write `positions.g2o`, the placed nodes as vertices.
        onedsfm: also write a folder `1dsfm`: the pairs that agree with the solution, and the placed cameras.

    Raises:
        InputError: as `write_result`, or if a format has no such dimension.
    """
    with atomic_folder(out, overwrite=overwrite, protect=[found.path, *protect]) as folder:
        if g2o:
            (folder / "positions.g2o").write_text(_g2o(found), encoding="utf-8")
        if onedsfm:
            (folder / "1dsfm").mkdir()
            for name, text in _onedsfm(found).items():
                (folder / "1dsfm" / name).write_text(text, encoding="utf-8")
        _write_tables(found, graph_summary(found), folder)
        for piece in found.further:
            subfolder = folder / folder_of(piece.piece)
            subfolder.mkdir(parents=True)
            rows = own_camera_rows(piece, piece.locations, 1.0)
            write_rows(rows, CameraRow, piece.graph.dimension, subfolder / "cameras.csv")


def _g2o(found: GraphResult) -> str:
    """Return the placed nodes as g2o vertices."""
    placement = found.placement
    names = [name_of(placement.graph, camera) for camera in placement.cameras.tolist()]
    rotations = None if found.rotations is None else found.rotations[placement.cameras]
    return g2o_text(names, placement.locations, rotations)


def _onedsfm(found: GraphResult) -> dict[str, str]:
    """Return the 1DSfM files of what agrees with the solution; world axes serve where there are no others."""
    placement, graph = found.placement, found.placement.graph
    if graph.dimension != 3:
        raise InputError(
            f"1DSfM's files are of three dimensions, the graph of {graph.dimension}; leave them out"
        )
    n = graph.num_cameras
    agreeing = placement.edges[placement.pairs[placement.assessment.inliers[placement.pairs]]]
    geometries, rotations = found.geometries, found.rotations
    if geometries is None or rotations is None:
        rotations = np.tile(np.eye(3), (n, 1, 1))
        geometries = EpipolarGeometries(
            names=tuple(name_of(graph, camera) for camera in range(n)),
            pairs=graph.edges,
            rotations=rotations[graph.edges[:, 0]],
            to_second=-graph.directions,
        )
    wanted = set(map(tuple, graph.edges[agreeing].tolist()))
    rows = [k for k, pair in enumerate(geometries.pairs.tolist()) if tuple(pair) in wanted]
    return onedsfm_files(geometries.subset(rows), rotations, placement.cameras, placement.locations)


def _write_tables(found: LocateResult | GraphResult, facts: dict[str, Any], folder: Path) -> None:
    dimension = found.placement.graph.dimension
    write_rows(found.cameras, CameraRow, dimension, folder / "cameras.csv")
    write_rows(found.pairs, PairRow, dimension, folder / "pairs.csv")
    write_json(facts, folder / MARKER)
