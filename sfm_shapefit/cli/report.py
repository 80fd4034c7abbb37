"""`sfm-shapefit report OUT` and `sfm-shapefit view OUT`: what an earlier run found, to be looked at."""

import shlex
import time
from pathlib import Path
from typing import Annotated

import typer

from sfm_shapefit.cli.app import app
from sfm_shapefit.cli.console import print_steps, print_table, report_errors
from sfm_shapefit.cli.flags import GroupedCommand, Images, Scene, one_path

Output = Annotated[Path | None, typer.Argument(metavar="OUT", help="A folder that locate or solve wrote.")]


@app.command(
    "report",
    cls=GroupedCommand,
    short_help="Make report.html again from the other files of OUT.",
    epilog="Example: sfm-shapefit report out --scene",
)
def report_command(out: Output = None, *, scene: Scene = False, images: Images = None) -> None:
    """Write OUT/report.html anew from the other files of OUT."""
    folder = one_path(out, None, "OUT")
    with report_errors():
        from sfm_shapefit.errors import InputError
        from sfm_shapefit.report.mesh import write_meshes
        from sfm_shapefit.report.page import write_report
        from sfm_shapefit.report.read_back import read_output
        from sfm_shapefit.report.sentences import shorten
        from sfm_shapefit.report.thumbnails import thumbnails_of

        drawn, facts = read_output(folder)
        pictures = thumbnails_of(drawn, images or "")
        if pictures is not None and not pictures:
            raise InputError(f"{images} has none of the images, such as {shorten(drawn.cameras.names[0])}")
        try:
            write_report(drawn, facts, folder / "report.html", pictures)
            if scene:
                write_meshes(drawn, folder)
            names = ["report.html", *(["scene.glb", "scene.ply"] if scene else [])]
            print_table(str(folder), [("written", ", ".join(names))])
            print_steps([f"open {shlex.quote(str(folder / 'report.html'))}"])
        except OSError as error:
            what = f"{folder} cannot be written ({error.strerror})"
            raise InputError(f"{what}; copy it elsewhere first") from error


@app.command(
    "view",
    cls=GroupedCommand,
    short_help="Explore OUT in the browser.",
    epilog="Example: sfm-shapefit view out --port 8090",
)
def view_command(
    out: Output = None,
    *,
    host: Annotated[
        str, typer.Option("--host", help="Address to listen on; others than this machine's let others in.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=1, max=65535, help="Port to listen on.")] = 8080,
) -> None:
    """Explore OUT in the browser: move thresholds, pick cameras, compare with the input's poses."""
    folder = one_path(out, None, "OUT")
    with report_errors():
        from sfm_shapefit.report.read_back import read_output
        from sfm_shapefit.report.viewer import serve

        drawn, facts = read_output(folder)
        server = serve(drawn, facts, host, port)
        try:
            print(f"http://{host}:{server.get_port()}  (end with Ctrl-C)", flush=True)  # noqa: T201
            while True:
                time.sleep(3600)
        except KeyboardInterrupt:
            server.stop()
