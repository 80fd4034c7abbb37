"""`sfm-shapefit locate MODEL OUT`."""

from typing import Any

from sfm_shapefit.cli.flags import (
    Database,
    GroupedCommand,
    InputPath,
    ModelArgument,
    OutArgument,
    OutputFlags,
    OutputPath,
    PriorsFile,
    Scheduler,
    flags_of,
    one_path,
    takes,
)
from sfm_shapefit.cli.frame import command_run
from sfm_shapefit.cli.root import app
from sfm_shapefit.facts.command_options import LocateOptions

_FLAGS = (
    *("control_points", "scale_bars", "known_distance", "fix", "without", "rotations", "intrinsics"),
    *("rigs", "adjust", "scale", "min_trust", "points", "threads", "max_memory_mb"),
)
"""Options that are flags; the others are keys of --config."""


@app.command(
    "locate",
    cls=GroupedCommand,
    short_help="Make a model where the rotations of the cameras are known.",
    epilog="Example: sfm-shapefit locate sparse/0 out",
)
@takes(flags_of(LocateOptions, *_FLAGS), flags_of(OutputFlags), settings=LocateOptions)
def locate_command(
    model: ModelArgument = None,
    out: OutArgument = None,
    *,
    input_path: InputPath = None,
    output_path: OutputPath = None,
    database: Database = None,
    priors: PriorsFile = None,
    scheduler: Scheduler = "",
    **given: Any,
) -> None:
    """Find positions and points from the rotations of MODEL and its matches; write the model to OUT.

    Positions in MODEL give scale and origin only; it may also be a transforms.json or a TUM trajectory.
    """
    source = one_path(model, input_path, "MODEL")
    target = one_path(out, output_path, "OUT")
    with command_run(LocateOptions, given, target, [source, database, priors]) as run:
        from sfm_shapefit.commands.locate import locate
        from sfm_shapefit.pipeline.execution import open_client

        with open_client(scheduler) as client:
            found = locate(
                source, database, options=run.options, progress=run.progress, priors=priors, client=client
            )
        run.finish(found, source, target)
