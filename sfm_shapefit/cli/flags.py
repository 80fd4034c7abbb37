"""Flags are the fields of the options dataclasses, and their help is the sentence under each field."""

import ast
import inspect
import textwrap
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

import typer

Options = TypeVar("Options")
Command = TypeVar("Command", bound=Callable[..., None])

# COLMAP's own names for paths are accepted beside the positional ones.
ModelArgument = Annotated[
    Path | None,
    typer.Argument(
        metavar="MODEL",
        help="COLMAP model folder, binary or text; or a file of Bundler, openMVG or OpenSfM.",
    ),
]
OutArgument = Annotated[Path | None, typer.Argument(metavar="OUT", help="Folder to be made.")]
InputPath = Annotated[Path | None, typer.Option("--input_path", hidden=True)]
OutputPath = Annotated[Path | None, typer.Option("--output_path", hidden=True)]
Database = Annotated[
    Path | None,
    typer.Option(
        "--database",
        "--database_path",
        help="COLMAP database; by default database.db in MODEL, its parent or grandparent.",
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an earlier output of this command.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
Verbose = Annotated[
    bool,
    typer.Option("--verbose", "-v", help="Let pycolmap's messages through, and list seconds per stage."),
]
Report = Annotated[
    bool, typer.Option("--report/--no-report", help="Write report.html: one page that works offline.")
]
Scene = Annotated[
    bool, typer.Option("--scene", help="Also write scene.glb and scene.ply, for any 3D viewer.")
]
ExecutorName = Annotated[
    Literal["serial", "processes", "dask"],
    typer.Option(
        "--executor",
        help="Who measures directions: this process, so many others as --threads says, or a cluster.",
    ),
]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", metavar="ADDRESS", help="Of a dask scheduler that runs already.")
]
Config = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE.toml", help="Options from a TOML file; flags win over it."),
]


def takes(options_type: type, only: Sequence[str] = ()) -> Callable[[Command], Command]:
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
        default = "" if item.default in (None, "") else f" [default: {shown}]"
        text = f"{documentation[item.name]}{default}"
        annotation: Any = Annotated[hints[item.name] | None, typer.Option(names, help=text)]
        parameters.append(
            inspect.Parameter(item.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
        )
    return parameters


@cache
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


def options_from(options_type: type[Options], given: dict[str, Any], config: Path | None = None) -> Options:
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
    from sfm_shapefit.formats import refuse_irregular_file

    refuse_irregular_file(path)
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise typer.BadParameter(f"{path} is not a readable TOML file: {error}") from error
    for name in values:
        if name not in known:
            raise typer.BadParameter(f"{path}: {name!r} is no option; known are {', '.join(sorted(known))}")
    return values


def fields_of(options_type: type, given: dict[str, Any]) -> dict[str, Any]:
    """Return the given values that are fields of an options dataclass."""
    names = {item.name for item in fields(options_type)}
    return {name: value for name, value in given.items() if name in names}


def one_path(positional: Path | None, flag: Path | None, name: str) -> Path:
    """Return the one path that was given, by position or by COLMAP's name."""
    if positional is not None and flag is not None:
        raise typer.BadParameter(f"{name} is given twice; give it by position or by name")
    path = positional if positional is not None else flag
    if path is None:
        raise typer.BadParameter(f"{name} is missing")
    return path
