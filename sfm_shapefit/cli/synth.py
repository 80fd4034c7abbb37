"""`sfm-shapefit synth OUT`."""

from typing import Any

from sfm_shapefit.cli.app import app
from sfm_shapefit.cli.console import print_table, reported
from sfm_shapefit.cli.flags import OutArgument, OutputPath, fields_of, one_path, options_from, takes
from sfm_shapefit.synthetic.options import SceneOptions, WorkspaceOptions


@app.command("synth")
@takes(SceneOptions)
@takes(WorkspaceOptions)
def synth_command(out: OutArgument = None, *, output_path: OutputPath = None, **given: Any) -> None:
    """Make a synthetic COLMAP workspace in OUT: a database, a model, and the exact truth."""
    target = one_path(out, output_path, "OUT")
    with reported():
        scene_options = options_from(SceneOptions, fields_of(SceneOptions, given))
        workspace_options = options_from(WorkspaceOptions, fields_of(WorkspaceOptions, given))
        from sfm_shapefit.colmap.workspace import write_workspace
        from sfm_shapefit.synthetic import make_scene

        scene = make_scene(scene_options)
        write_workspace(scene, target, workspace_options)
        rows = [
            ("images", str(len(scene.keypoints))),
            ("points", str(len(scene.points))),
            ("pairs", f"{len(scene.pairs)}, of which {int(scene.pair_is_corrupted.sum())} wrong"),
            ("written to", str(target)),
        ]
        print_table(f"{scene_options.shape}, seed {scene_options.seed}", rows)
