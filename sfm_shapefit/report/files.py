"""The pictures of an output folder: report.html, scene.glb, scene.ply."""

from pathlib import Path
from typing import Any

from sfm_shapefit.report.drawing import Scene


def write_pictures(scene: Scene, facts: dict[str, Any], folder: Path, *, report: bool, meshes: bool) -> None:
    """Write what is asked for into an existing folder.

    Args:
        scene: what is drawn.
        facts: the contents of locate.json.
        folder: where the files go.
        report: write report.html.
        meshes: write scene.glb and scene.ply.
    """
    if report:
        from sfm_shapefit.report.page import write_report

        write_report(scene, facts, folder / "report.html")
    if meshes:
        from sfm_shapefit.report.mesh import write_meshes

        write_meshes(scene, folder)
