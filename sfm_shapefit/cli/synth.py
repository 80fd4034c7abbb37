"""`sfm-shapefit synth OUT`."""

import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from sfm_shapefit.base.display import Row, row
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.cli.console import print_lines, print_table, report_errors
from sfm_shapefit.cli.flags import (
    GroupedCommand,
    OutArgument,
    OutputPath,
    flags_of,
    one_path,
    read_options,
    takes,
)
from sfm_shapefit.cli.progress import show_progress
from sfm_shapefit.cli.root import app
from sfm_shapefit.synthetic.scene_options import RenderOptions, SceneOptions, WorkspaceOptions

DrawImages = Annotated[
    bool, typer.Option("--images", help="Draw images, and let COLMAP find the keypoints and matches in them.")
]


@app.command(
    "synth",
    cls=GroupedCommand,
    short_help="Make a synthetic workspace with known truth.",
    epilog="Example: sfm-shapefit synth ring --shape ring --num-images 50",
)
@takes(flags_of(SceneOptions), flags_of(WorkspaceOptions), flags_of(RenderOptions))
def synth_command(
    out: OutArgument = None, *, output_path: OutputPath = None, images: DrawImages = False, **given: Any
) -> None:
    """Make a synthetic COLMAP workspace in OUT: a database, a model, the exact truth, and images if asked."""
    target = one_path(out, output_path, "OUT")
    with report_errors(target):
        scene = read_options(SceneOptions, given)
        workspace = read_options(WorkspaceOptions, given)
        render = read_options(RenderOptions, given)
        if not images and render != RenderOptions():
            raise InputError("the options of drawing need --images; add it, or leave them out")
        rows = _write_drawn(scene, render, target, workspace) if images else _write(scene, target, workspace)
        exact = "truth" if (target / "truth").exists() else "sparse/0"
        rows += [row("exact model", exact), row("written to", str(target))]
        print_table(f"{scene.shape}, seed {scene.seed}", rows)
        made = shlex.quote(str(target))
        pictures = f" --images {made}/images" if images else ""
        step = f"map {made}/database.db {made}_mapped{pictures}"
        print_lines([f"next: sfm-shapefit {step if workspace.database else f'check {made}/sparse/0'}"])


def _write(options: SceneOptions, target: Path, workspace: WorkspaceOptions) -> list[Row]:
    """Write a workspace whose keypoints are projected points; return what to print of it."""
    from sfm_shapefit.synthetic import make_scene
    from sfm_shapefit.synthetic.workspace import write_workspace

    scene = make_scene(options)
    write_workspace(scene, target, workspace)
    return [
        row("images", str(len(scene.keypoints))),
        row("points", str(len(scene.points))),
        row("pairs", f"{len(scene.pairs)}, of which {int(scene.pair_is_corrupted.sum())} wrong"),
    ]


def _write_drawn(
    options: SceneOptions, render: RenderOptions, target: Path, workspace: WorkspaceOptions
) -> list[Row]:
    """Write a workspace with images; return what to print of it."""
    from sfm_shapefit.synthetic import make_rendered_scene
    from sfm_shapefit.synthetic.rendered_workspace import judge_matches, write_rendered_workspace

    scene = make_rendered_scene(options, render)
    with show_progress(True) as progress:
        assert progress is not None
        write_rendered_workspace(scene, target, workspace, progress)
    rows = [row("images", str(scene.num_images))]
    if workspace.database:
        judged = judge_matches(scene, target / "database.db")
        wrong = int(judged.pair_is_wrong.sum())
        rows.append(row("matches", f"{len(judged.is_right)}, of which {int((~judged.is_right).sum())} wrong"))
        rows.append(row("pairs", f"{len(judged.pair_is_wrong)}, of which {wrong} wrong"))
    return rows
