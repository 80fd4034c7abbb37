"""The commands: parse, call, write. The door to typer and rich.

Flags are the fields of the options dataclasses, and their help is the sentence under each field. Results
go to stdout, progress and messages to stderr.

Exit codes: 0 done; 2 wrong usage; 3 bad input; 4 the view graph cannot be solved; 130 interrupted.
"""

import ast
import inspect
import os
import signal
import sys
import textwrap
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_type_hints

import typer

from sfm_shapefit.errors import InputError, ShapeFitError, UnsolvableError
from sfm_shapefit.options import LocateOptions
from sfm_shapefit.robust.options import PlacementOptions
from sfm_shapefit.synthetic.options import SceneOptions, WorkspaceOptions

if TYPE_CHECKING:
    from sfm_shapefit.diagnosis import Diagnosis, Inspection
    from sfm_shapefit.evaluation import Evaluation
    from sfm_shapefit.pipeline import Progress
    from sfm_shapefit.results import GraphResult, LocateResult
    from sfm_shapefit.solver.options import SolverResult

Options = TypeVar("Options")
Command = TypeVar("Command", bound=Callable[..., None])
Rows = list[tuple[str, str]]
"""A two-column table: label and what stands beside it."""

_EXIT_USAGE, _EXIT_INPUT, _EXIT_UNSOLVABLE, _EXIT_INTERRUPTED = 2, 3, 4, 130
_NAMES_SHOWN = 8
_SEE_JSON = "see --json"

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # its columns break long sentences into one word a line
    help="Place the cameras of a COLMAP model whose rotations are known.",
)

# COLMAP's own names for paths are accepted beside the positional ones.
ModelArgument = Annotated[
    Path | None, typer.Argument(metavar="MODEL", help="COLMAP model folder (binary or text).")
]
OutArgument = Annotated[Path | None, typer.Argument(metavar="OUT", help="Folder to be made.")]
InputPath = Annotated[Path | None, typer.Option("--input_path", hidden=True)]
OutputPath = Annotated[Path | None, typer.Option("--output_path", hidden=True)]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an earlier output of this command.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
Config = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE.toml", help="Options from a TOML file; flags win over it."),
]


def main() -> None:
    """Run the command line. A request to terminate ends it like an interrupt from the keyboard."""
    _catch_termination()
    try:
        app()
    except KeyboardInterrupt:  # outside a command: while modules are loaded
        sys.exit(_EXIT_INTERRUPTED)


def _interrupt(_signal: int, _frame: object) -> None:
    raise KeyboardInterrupt


# --- flags from options ----------------------------------------------------------------------------


def _takes(options_type: type, only: Sequence[str] = ()) -> Callable[[Command], Command]:
    """Give a command one flag per field of an options dataclass, None where the user says nothing.

    `only` names the fields that matter to the command, if not all do.
    """

    def decorate(command: Command) -> Command:
        signature = inspect.signature(command, eval_str=True)
        own = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
        flags = [flag for flag in _flags(options_type) if not only or flag.name in only]
        parameters = own + flags
        command.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        command.__annotations__ = {p.name: p.annotation for p in parameters} | {"return": None}
        return command

    return decorate


def _flags(options_type: type) -> list[inspect.Parameter]:
    """Return a keyword parameter with a typer option for each field."""
    hints, documentation = get_type_hints(options_type), _field_documentation(options_type)
    parameters = []
    for item in fields(options_type):
        flag = f"--{item.name.replace('_', '-')}"
        names = f"{flag}/--no{flag[1:]}" if hints[item.name] is bool else flag
        shown = {"True": "yes", "False": "no"}.get(str(item.default), str(item.default))
        text = f"{documentation[item.name]} [default: {shown}]"
        annotation: Any = Annotated[hints[item.name] | None, typer.Option(names, help=text)]
        parameters.append(
            inspect.Parameter(item.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
        )
    return parameters


def _field_documentation(options_type: type) -> dict[str, str]:
    """Return the sentence under each field of a dataclass and of those it inherits from."""
    found: dict[str, str] = {}
    for base in options_type.__bases__:
        if is_dataclass(base):
            found |= _field_documentation(base)
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(options_type))).body
    assert isinstance(definition, ast.ClassDef)
    for statement, following in zip(definition.body, definition.body[1:], strict=False):
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            is_text = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
            found[statement.target.id] = " ".join(str(following.value.value).split()) if is_text else ""  # type: ignore[attr-defined]
    return found


def _options(options_type: type[Options], given: dict[str, Any], config: Path | None = None) -> Options:
    """Return options from a TOML file and the flags that were given, which win."""
    known = {item.name for item in fields(options_type)}  # type: ignore[arg-type]
    values = _read_toml(config, known) if config else {}
    values |= {name: value for name, value in given.items() if value is not None}
    try:
        return options_type(**values)
    except (TypeError, ValueError) as error:
        raise typer.BadParameter(str(error)) from error


def _read_toml(path: Path, known: set[str]) -> dict[str, Any]:
    """Return the values of a TOML file whose keys are options."""
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise typer.BadParameter(f"{path} is not a readable TOML file: {error}") from error
    for name in values:
        if name not in known:
            raise typer.BadParameter(f"{path}: {name!r} is no option; known are {', '.join(sorted(known))}")
    return values


# --- messages --------------------------------------------------------------------------------------


@contextmanager
def _reported() -> Iterator[None]:
    """Turn every known error into one sentence on stderr and its exit code."""
    try:
        yield
    except KeyboardInterrupt:
        _fail("interrupted; nothing was written", _EXIT_INTERRUPTED)
    except UnsolvableError as error:
        _fail(str(error), _EXIT_UNSOLVABLE)
    except ShapeFitError as error:
        _fail(str(error), _EXIT_INPUT)


def _catch_termination() -> None:
    """Turn SIGTERM into an interrupt; again once pycolmap is loaded, which brings a handler of its own."""
    signal.signal(signal.SIGTERM, _interrupt)


def _fail(message: str, code: int) -> None:
    print(f"sfm-shapefit: {_printable(message)}", file=sys.stderr)  # noqa: T201
    raise typer.Exit(code)


def _printable(text: str) -> str:
    """Return text without control characters: names come from strangers, and may move the cursor."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


@contextmanager
def _progress(enabled: bool) -> "Iterator[Progress | None]":
    """Show stages on stderr if it is a terminal. Written to a copy of it, which nobody silences."""
    if not (enabled and sys.stderr.isatty()):
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Display

    columns = (TextColumn("{task.description:<20}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with (
        os.fdopen(os.dup(2), "w") as stream,
        Display(*columns, console=Console(file=stream, force_terminal=True)) as display,
    ):
        tasks: dict[str, Any] = {}

        def advance(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = display.add_task(stage, total=total)
            if total > 1 or display.tasks[tasks[stage]].total == 1:
                display.update(tasks[stage], completed=done, total=total)

        yield advance


def _print_table(title: str, rows: Rows) -> None:
    """Print a two-column table on stdout."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    # Text, not markup: names and paths come from strangers, and brackets in them mean nothing.
    table = Table(title=Text(_printable(title)), show_header=False, title_justify="left")
    for label, value in rows:
        table.add_row(label, Text("\n".join(_printable(line) for line in value.split("\n"))))
    Console().print(table)


# --- locate ----------------------------------------------------------------------------------------


@app.command("locate")
@_takes(LocateOptions)
def locate_command(
    model: ModelArgument = None,
    out: OutArgument = None,
    *,
    input_path: InputPath = None,
    output_path: OutputPath = None,
    database: Annotated[
        Path | None,
        typer.Option(
            "--database",
            "--database_path",
            help="COLMAP database; by default database.db in MODEL, its parent or grandparent.",
        ),
    ] = None,
    overwrite: Overwrite = False,
    config: Config = None,
    as_json: Json = False,
    quiet: Quiet = False,
    **given: Any,
) -> None:
    """Place the cameras of MODEL from its rotations and its matches; write a seeded model to OUT."""
    source = _one_path(model, input_path, "MODEL")
    target = _one_path(out, output_path, "OUT")
    with _reported():
        from sfm_shapefit.output import check_output

        options = _options(LocateOptions, given, config)
        protect = [path for path in (source, database, config) if path is not None]
        check_output(target, overwrite=overwrite, protect=protect)

        from sfm_shapefit.pipeline import locate
        from sfm_shapefit.report import dumps
        from sfm_shapefit.results import summary, write_result

        _catch_termination()
        with _progress(not quiet) as progress:
            found = locate(source, database, options, progress)
            write_result(found, target, overwrite=overwrite, protect=protect)
        if as_json:
            print(dumps(summary(found)))  # noqa: T201
        elif not quiet:
            _print_table(f"{len(found.model.names)} images of {source}", _locate_table(found, target))


def _locate_table(found: "LocateResult", out: Path) -> Rows:
    """Return what was placed, what was not and why, how certain it is, and where it is."""
    from sfm_shapefit.results import summary

    facts = summary(found)
    left_out = [f"{row.name}: {row.reason}" for row in found.cameras if not row.placed]
    return [
        ("directions", found.inputs.statement),
        ("placed", f"{facts['num_placed']} of {facts['num_images']} images"),
        *([("not placed", _shortened(left_out))] if left_out else []),
        *_pieces_line(facts),
        ("pairs", _pairs_line(facts)),
        ("objective", _objective_line(found.solve)),
        ("points as nodes", f"{facts['num_points_as_nodes']} tracks helped to place the cameras"),
        ("centres", found.placement.finish.statement()),
        ("scale", found.gauge.statement),
        ("points", _points_line(facts)),
        *([("bundle adjustment", _adjustment_line(found))] if found.adjusted else []),
        *[("warning", warning) for warning in found.warnings],
        ("time", f"{sum(found.timings_s.values()):.1f} s"),
        ("written to", f"{out}: seeded model, locate.json, cameras.csv, pairs.csv"),
    ]


def _pieces_line(facts: dict[str, Any]) -> Rows:
    """Return a row that says where the further pieces stand, if there are any."""
    lines = [
        f"{piece['folder']}: {piece['num_placed']} of {piece['num_cameras']} cameras, hinged at "
        f"{', '.join(piece['hinges']) or 'nothing'}, with a scale of its own"
        for piece in facts["pieces"][1:]
        if piece["folder"]
    ]
    return [("further pieces", _shortened(lines))] if lines else []


def _pairs_line(facts: dict[str, Any]) -> str:
    counts = dict(facts["pairs"])
    contradicting, usable = counts.pop("outlier"), counts.pop("usable")
    others = "".join(f", {count} {status.replace('_', ' ')}" for status, count in counts.items())
    return f"{facts['num_pairs']}: {usable} usable ({contradicting} contradict the solution){others}"


def _points_line(facts: dict[str, Any]) -> str:
    if facts["num_points"] == 0:
        return "none"
    return f"{facts['num_points']}, mean error {facts['mean_reprojection_error_px']:.2f} px"


def _adjustment_line(found: "LocateResult") -> str:
    assert found.adjusted is not None
    state = "converged" if found.adjusted.converged else "stopped at its limit"
    before, after = found.adjusted.initial_error_px, found.adjusted.final_error_px
    return f"{state} after {found.adjusted.iterations} steps, mean error {before:.2f} -> {after:.2f} px"


# --- solve -----------------------------------------------------------------------------------------


@app.command("solve")
@_takes(PlacementOptions)
def solve_command(
    graph: Annotated[
        Path | None, typer.Argument(metavar="GRAPH", help="Text file: i j vx vy vz [weight] per line.")
    ] = None,
    out: OutArgument = None,
    *,
    overwrite: Overwrite = False,
    as_json: Json = False,
    quiet: Quiet = False,
    **given: Any,
) -> None:
    """Place the nodes of a bare view GRAPH of directions, in any dimension; write tables to OUT."""
    source = _one_path(graph, None, "GRAPH")
    target = _one_path(out, None, "OUT")
    with _reported():
        from sfm_shapefit.output import check_output

        options = _options(PlacementOptions, given)
        check_output(target, overwrite=overwrite, protect=[source])

        from sfm_shapefit.pipeline import solve_graph_file
        from sfm_shapefit.report import dumps
        from sfm_shapefit.results import graph_summary, write_graph_result

        _catch_termination()
        found = solve_graph_file(source, options)
        write_graph_result(found, target, overwrite=overwrite)
        if as_json:
            print(dumps(graph_summary(found)))  # noqa: T201
        elif not quiet:
            _print_table(
                f"{found.placement.graph.num_cameras} nodes of {source}", _solve_table(found, target)
            )


def _solve_table(found: "GraphResult", out: Path) -> Rows:
    """Return what was placed, what was not and why, and how certain it is."""
    from sfm_shapefit.results import graph_summary, quality_warnings

    placement = found.placement
    left_out = [f"{row.name}: {row.reason}" for row in found.cameras if not row.placed]
    return [
        ("dimension", str(placement.graph.dimension)),
        ("placed", f"{len(placement.cameras)} of {placement.graph.num_cameras} nodes"),
        *([("not placed", _shortened(left_out))] if left_out else []),
        *_pieces_line(graph_summary(found)),
        (
            "pairs",
            f"{placement.num_pairs}, of which {len(placement.rejected_pairs)} contradict the solution",
        ),
        ("objective", _objective_line(placement.solve)),
        ("locations", placement.finish.statement()),
        *[("warning", warning) for warning in quality_warnings(placement)],
        ("time", f"{sum(found.timings_s.values()):.1f} s"),
        ("written to", f"{out}: locate.json, cameras.csv, pairs.csv"),
    ]


def _objective_line(solve: "SolverResult") -> str:
    chosen = f"{solve.method}: {solve.method_reason}"
    return f"{solve.objective:.6g}, certified to {max(solve.gap, 0.0):.1e} ({chosen})"


# --- inspect ---------------------------------------------------------------------------------------

_INSPECTED = (
    "directions",
    "solver",
    "objective",
    "refine",
    "points",
    "min_inliers",
    "min_inlier_ratio",
    "inlier_threshold_px",
    "threads",
)
"""The options of `locate` that decide what the view graph is and what becomes of it."""


@app.command("inspect")
@_takes(LocateOptions, only=_INSPECTED)
def inspect_command(
    model: Annotated[
        Path | None,
        typer.Argument(metavar="MODEL", help="COLMAP model folder, or the text file of a bare graph."),
    ] = None,
    *,
    input_path: InputPath = None,
    database: Annotated[
        Path | None,
        typer.Option(
            "--database",
            "--database_path",
            help="COLMAP database; by default database.db in MODEL, its parent or grandparent.",
        ),
    ] = None,
    theory: Annotated[
        bool,
        typer.Option("--theory", help="Also compute what the recovery theorems grant at MODEL's centres."),
    ] = False,
    as_json: Json = False,
    **given: Any,
) -> None:
    """Diagnose the view graph of MODEL and say what `locate` would do; solve and write nothing."""
    source = _one_path(model, input_path, "MODEL")
    with _reported():
        options = _options(LocateOptions, given)

        from sfm_shapefit.pipeline import inspect as inspect_model
        from sfm_shapefit.report import dumps

        _catch_termination()
        with _progress(not as_json) as progress:
            found = inspect_model(source, database, options, theory=theory, progress=progress)
        if as_json:
            print(dumps(found.as_dict()))  # noqa: T201
        else:
            what = "nodes" if source.is_file() else "images"
            _print_table(f"{found.num_images} {what} of {source}", _inspection_table(found))
        if found.diagnosis.obstacle:
            raise UnsolvableError(found.diagnosis.obstacle)


def _inspection_table(found: "Inspection") -> Rows:
    """Return the diagnosis, label by label."""
    seen = found.diagnosis
    statuses = "\n".join(f"{count} {status}" for status, count in found.statuses.items())
    left_out = [f"{name}: {reason}" for name, reason in seen.left_out.items()]
    weak = [f"{camera.name}: {'; '.join(camera.reasons)}" for camera in seen.weak]
    return [
        ("directions", found.directions),
        ("pairs", statuses),
        ("points as nodes", found.points),
        ("components", _components_line(seen)),
        *([("rigid pieces", _shortened(_piece_lines(seen), _SEE_JSON))] if seen.pieces else []),
        *([("not placed", _shortened(left_out, _SEE_JSON))] if left_out else []),
        *([("weak cameras", _shortened(weak, _SEE_JSON))] if weak else []),
        ("wrong pairs", seen.corruption.statement),
        *([("solver", f"{seen.plan.solver}: {seen.plan.solver_reason}")] if seen.plan else []),
        *([("finish", seen.plan.finish)] if seen.plan else []),
        *([("theory", found.theory.statement)] if found.theory else []),
    ]


def _components_line(seen: "Diagnosis") -> str:
    sizes = ", ".join(map(str, seen.components[:_NAMES_SHOWN]))
    more = ", ..." if len(seen.components) > _NAMES_SHOWN else ""
    return f"{len(seen.components)} ({sizes}{more} cameras)"


def _piece_lines(seen: "Diagnosis") -> list[str]:
    """Say of each rigid piece how large it is and what it hangs by."""
    return [
        f"{piece.num_cameras} cameras" + (f", hinged at {', '.join(piece.hinges)}" if piece.hinges else "")
        for piece in seen.pieces
    ]


# --- evaluate --------------------------------------------------------------------------------------


@app.command("evaluate")
def evaluate_command(
    model: ModelArgument = None,
    reference: Annotated[
        Path | None, typer.Argument(metavar="REF", help="COLMAP model with the true poses.")
    ] = None,
    *,
    input_path: InputPath = None,
    threshold: Annotated[
        list[float] | None,
        typer.Option("--threshold", help="Recall at this position error in REF's units; may be repeated."),
    ] = None,
    csv: Annotated[
        Path | None, typer.Option("--csv", metavar="FILE", help="Write one row per camera to FILE.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare the camera poses of MODEL with those of REF, after a robust similarity alignment."""
    source = _one_path(model, input_path, "MODEL")
    truth = _one_path(reference, None, "REF")
    with _reported():
        from sfm_shapefit.pipeline import evaluate
        from sfm_shapefit.report import dumps, write_records

        errors = evaluate(source, truth, threshold or ())
        if csv is not None:
            if csv.exists() and csv.suffix.lower() != ".csv":
                raise InputError(f"{csv} exists and is no .csv file; choose another name")
            write_records(errors.rows(), csv)
        if as_json:
            print(dumps(errors.as_dict()))  # noqa: T201
        else:
            _print_table(f"{source} against {truth}", _evaluation_table(errors))


def _evaluation_table(errors: "Evaluation") -> Rows:
    """Return the errors in the reference's units."""
    position, rotation = errors.position, errors.rotation_deg
    recall = "\n".join(f"{r.recall:7.1%} within {r.threshold:.4g}" for r in errors.recalls)
    return [
        ("cameras", f"{len(errors.names)} in common of {len(errors.names) + len(errors.missing)}"),
        *([("missing", _shortened(errors.missing))] if errors.missing else []),
        (
            "position error",
            f"median {position.median:.4g}, mean {position.mean:.4g}, max {position.max:.4g} "
            f"(extent {errors.extent:.4g})",
        ),
        (
            "rotation error",
            f"median {rotation.median:.4g}, mean {rotation.mean:.4g}, max {rotation.max:.4g} deg",
        ),
        ("recall", recall),
        *[("warning", warning) for warning in errors.warnings],
    ]


# --- synth -----------------------------------------------------------------------------------------


@app.command("synth")
@_takes(SceneOptions)
@_takes(WorkspaceOptions)
def synth_command(out: OutArgument = None, *, output_path: OutputPath = None, **given: Any) -> None:
    """Make a synthetic COLMAP workspace in OUT: a database, a model, and the exact truth."""
    target = _one_path(out, output_path, "OUT")
    with _reported():
        scene_options = _options(SceneOptions, _fields_of(SceneOptions, given))
        workspace_options = _options(WorkspaceOptions, _fields_of(WorkspaceOptions, given))
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
        _print_table(f"{scene_options.shape}, seed {scene_options.seed}", rows)


def _fields_of(options_type: type, given: dict[str, Any]) -> dict[str, Any]:
    names = {item.name for item in fields(options_type)}
    return {name: value for name, value in given.items() if name in names}


def _one_path(positional: Path | None, flag: Path | None, name: str) -> Path:
    """Return the one path that was given, by position or by COLMAP's name."""
    if positional is not None and flag is not None:
        raise typer.BadParameter(f"{name} is given twice; give it by position or by name")
    path = positional if positional is not None else flag
    if path is None:
        raise typer.BadParameter(f"{name} is missing")
    return path


def _shortened(lines: Sequence[str], elsewhere: str = "see cameras.csv") -> str:
    """Return the first lines, and how many there are more and where."""
    more = [f"and {len(lines) - _NAMES_SHOWN} more, {elsewhere}"] if len(lines) > _NAMES_SHOWN else []
    return "\n".join([*lines[:_NAMES_SHOWN], *more])


if __name__ == "__main__":
    main()
