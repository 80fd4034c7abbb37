"""`sfm-shapefit locate MODEL OUT`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfm_shapefit.base.wording import counted
from sfm_shapefit.cli.console import Rows, shorten
from sfm_shapefit.cli.flags import (
    Database,
    ExecutorName,
    GroupedCommand,
    InputPath,
    ModelArgument,
    OutArgument,
    OutputFlags,
    OutputPath,
    PriorsFile,
    one_path,
    takes,
)
from sfm_shapefit.cli.frame import Told, command_run
from sfm_shapefit.cli.lines import (
    control_point_rows,
    describe_adjustment,
    describe_points,
    further_piece_rows,
    intrinsics_rows,
    next_steps,
    picture_rows,
    rig_rows,
    scene_rows,
)
from sfm_shapefit.cli.root import app
from sfm_shapefit.facts.options import LocateOptions

if TYPE_CHECKING:
    from sfm_shapefit.facts.result import LocateResult


@app.command(
    "locate",
    cls=GroupedCommand,
    short_help="Place the cameras of a model from its rotations and matches.",
    epilog="Example: sfm-shapefit locate sparse/0 out",
)
@takes(LocateOptions, OutputFlags)
def locate_command(
    model: ModelArgument = None,
    out: OutArgument = None,
    *,
    input_path: InputPath = None,
    output_path: OutputPath = None,
    database: Database = None,
    priors: PriorsFile = None,
    executor: ExecutorName = "serial",
    **given: Any,
) -> None:
    """Place the cameras of MODEL from its rotations and its matches; write a seeded model to OUT."""
    source = one_path(model, input_path, "MODEL")
    target = one_path(out, output_path, "OUT")
    with command_run(LocateOptions, given, target, [source, database, priors]) as run:
        from sfm_shapefit.pipeline.execution import open_executor
        from sfm_shapefit.pipeline.locate import locate
        from sfm_shapefit.pipeline.write import write_result

        with open_executor(executor, run.options.num_threads()) as workers:
            found = locate(
                source, database, options=run.options, progress=run.progress, priors=priors, executor=workers
            )
        write_result(found, target, **run.writing)
        title = f"{counted(len(found.model.names), 'image')} of {source}"
        run.heed(found.verdict)
        run.show(title, found.summary(), lambda: _tell(found, target, run.flags))


def _tell(found: "LocateResult", out: Path, flags: OutputFlags) -> Told:
    """Say what was placed, what was not and why, how certain it is, and where it is."""
    from sfm_shapefit.facts.key_figures import figure_rows

    facts = found.summary()
    left_out = [f"{row.name}: {row.reason}" for row in found.cameras if not row.placed]
    return Told(
        figures=[
            *figure_rows(facts),
            *([("not placed", shorten(left_out))] if left_out else []),
            *further_piece_rows(facts),
            *intrinsics_rows(facts),
            *rig_rows(facts),
            *control_point_rows(facts),
            *scene_rows(facts),
            *[("warning", warning) for warning in found.warnings],
            *picture_rows(flags, found.model.names),
        ],
        details=[
            ("directions", found.inputs.statement),
            *_group_rows(facts),
            ("pairs", _describe_pairs(facts)),
            (
                "points as nodes",
                f"{counted(facts['num_points_as_nodes'], 'track')} helped to place cameras",
            ),
            ("centers", found.placement.refined.statement()),
            *([("adjustment", found.adjustment.statement)] if found.adjustment else []),
            ("scale", found.gauge.statement),
            ("points", describe_points(facts)),
            *([("bundle adjustment", describe_adjustment(found.adjusted))] if found.adjusted else []),
            ("certificate", found.departure.statement),
        ],
        verdict=found.verdict,
        steps=next_steps(facts, out, flags),
        timings_s=found.timings_s,
        written=f"{out}: seeded model, locate.json, cameras.csv, pairs.csv{', report.html' * flags.report}",
    )


def _group_rows(facts: dict[str, Any]) -> Rows:
    groups = facts["rigid_groups"]
    if groups is None:
        return []
    fixed = f", {counted(groups['num_fixed'], 'camera')} fixed" if groups["num_fixed"] else ""
    inner = f"; {groups['num_inner_pairs']} pairs inside them give no constraint"
    return [("rigid groups", f"{groups['num_placed']} of {groups['num_groups']} placed{fixed}{inner}")]


def _describe_pairs(facts: dict[str, Any]) -> str:
    """Say what became of the pairs, in the words of `inspect`."""
    from sfm_shapefit.pairs.pair_directions import DirectionStatus

    counts = dict(facts["pairs"])
    contradicting, usable = counts.pop("outlier"), counts.pop("usable")
    others = [f"{count} {DirectionStatus[status.upper()].value}" for status, count in counts.items()]
    return "\n".join([f"{usable} usable ({contradicting} contradict the solution)", *others])
