"""OUT on disk: the seeded model, `locate.json`, `cameras.csv`, `pairs.csv`, `report.html`, scenes if wanted.

Further parallel-rigid pieces stand in `pieces/1`, `pieces/2`, ...: a seeded model and a `cameras.csv` each.
"""

from collections.abc import Sequence
from pathlib import Path

from sfm_shapefit.atomic_folder import MAP_MARKER, MARKER, atomic_folder
from sfm_shapefit.colmap.seed import write_model
from sfm_shapefit.report.mesh import write_meshes
from sfm_shapefit.report.page import write_report
from sfm_shapefit.report.read_back import draw_graph, draw_model
from sfm_shapefit.results.exports import agreeing_onedsfm, positions_g2o
from sfm_shapefit.results.map_result import MapResult
from sfm_shapefit.results.result import GraphResult, LocateResult
from sfm_shapefit.results.rows import folder_of, own_camera_rows
from sfm_shapefit.results.tables import CameraRow, PairRow, write_json, write_rows


def write_result(
    found: LocateResult,
    out: Path | str,
    *,
    overwrite: bool = False,
    protect: Sequence[Path | str] = (),
    report: bool = True,
    scene: bool = False,
) -> None:
    """Write the seeded model and its tables into a folder that appears whole or not at all.

    Args:
        found: what `locate` returned.
        out: the folder to be made.
        overwrite: replace an earlier output of this package.
        protect: paths that `out` must not be or contain, beside the inputs of `found`.
        report: write report.html, one page that explains the result and works offline.
        scene: write scene.glb and scene.ply, cameras and points for any 3D viewer.

    Raises:
        InputError: if the folder exists, cannot be written, or would hit a protected path.
    """
    inputs = [path for path in (found.inputs.folder, found.inputs.database) if path is not None]
    with atomic_folder(out, overwrite=overwrite, protect=[*inputs, *protect]) as folder:
        write_model(found.reconstruction, folder)
        _write_tables(found, folder, report=report, scene=scene)
        for piece in found.further:
            subfolder = folder / folder_of(piece.placement.piece)
            subfolder.mkdir(parents=True)
            write_model(piece.reconstruction, subfolder)
            write_rows(piece.camera_rows, CameraRow, 3, subfolder / "cameras.csv")


def write_graph_result(
    found: GraphResult,
    out: Path | str,
    *,
    overwrite: bool = False,
    g2o: bool = False,
    onedsfm: bool = False,
    protect: Sequence[Path | str] = (),
    report: bool = True,
    scene: bool = False,
) -> None:
    """Write the tables and pictures of a bare graph like `write_result`; there is no model.

    Args:
        found: what `place_graph_file` returned.
        out, overwrite, protect, report, scene: see `write_result`.
        g2o: also write `positions.g2o`, the placed nodes as vertices.
        onedsfm: also write a folder `1dsfm`: the pairs that agree with the solution, and the placed cameras.

    Raises:
        InputError: as `write_result`, or if a format has no such dimension.
    """
    with atomic_folder(out, overwrite=overwrite, protect=[found.path, *protect]) as folder:
        if g2o:
            (folder / "positions.g2o").write_text(positions_g2o(found), encoding="utf-8")
        if onedsfm:
            (folder / "1dsfm").mkdir()
            for name, text in agreeing_onedsfm(found).items():
                (folder / "1dsfm" / name).write_text(text, encoding="utf-8")
        _write_tables(found, folder, report=report, scene=scene)
        for piece in found.further:
            subfolder = folder / folder_of(piece.piece)
            subfolder.mkdir(parents=True)
            rows = own_camera_rows(piece, piece.locations, 1.0)
            write_rows(rows, CameraRow, piece.graph.dimension, subfolder / "cameras.csv")


def _write_tables(found: LocateResult | GraphResult, folder: Path, *, report: bool, scene: bool) -> None:
    dimension = found.placement.graph.dimension
    write_rows(found.cameras, CameraRow, dimension, folder / "cameras.csv")
    write_rows(found.pairs, PairRow, dimension, folder / "pairs.csv")
    facts = found.summary()
    write_json(facts, folder / MARKER)
    if report or scene:
        drawing = draw_graph(found) if isinstance(found, GraphResult) else draw_model(found)
        if report:
            write_report(drawing, facts, folder / "report.html")
        if scene:
            write_meshes(drawing, folder)


def write_map_result(
    found: MapResult,
    out: Path | str,
    *,
    overwrite: bool = False,
    protect: Sequence[Path | str] = (),
    report: bool = True,
    scene: bool = False,
) -> None:
    """Write all models into a folder that appears whole or not at all.

    Args:
        found: what `map_database` returned.
        out: the folder to be made.
        overwrite: replace an earlier output of this package.
        protect: paths that `out` must not be or contain, beside the database.
        report, scene: for each model as in `write_result`.

    Raises:
        InputError: if the folder exists, cannot be written, or would hit a protected path.
    """
    with atomic_folder(out, overwrite=overwrite, protect=[found.database, *protect]) as folder:
        for number, model in enumerate(found.models):
            write_result(model.located, folder / str(number), report=report, scene=scene)
        write_json(found.summary(), folder / MAP_MARKER)
