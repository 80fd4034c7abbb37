"""Flags are the fields of the settings classes, in their groups, and their help is each field's sentence."""

import inspect
import itertools
import re
import shlex
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from typer.core import TyperCommand

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.settings import S, Settings, hint, homes_of, option, setting_groups
from sfm_shapefit.cli.colmap_names import answer_for, answer_for_file
from sfm_shapefit.cli.console import flag_names, flags_and_keys, key_names
from sfm_shapefit.cli.root import convert_plainly

Command = TypeVar("Command", bound=Callable[..., None])

# COLMAP's own names for paths are accepted beside the positional ones.
ModelArgument = Annotated[Path | None, typer.Argument(metavar="MODEL", help="COLMAP model folder.")]
OutArgument = Annotated[Path | None, typer.Argument(metavar="OUT", help="Folder to be made.")]
InputPath = Annotated[Path | None, typer.Option("--input_path", hidden=True)]
OutputPath = Annotated[Path | None, typer.Option("--output_path", hidden=True)]
Database = Annotated[
    Path | None,
    typer.Option(
        "--database",
        "--database_path",
        help="COLMAP database; by default database.db or colmap.db in the model folder or up to two above.",
    ),
]
PriorsFile = Annotated[
    Path | None,
    typer.Option(
        "--priors",
        metavar="FILE|FOLDER|database",
        help="Position priors of a file (name x y z [sigma], a table with a header, COLMAP's JSON), of the "
        "EXIF data of a folder of images, or of the database; those with standard deviations also hold the "
        "cameras.",
    ),
]


Scheduler = Annotated[
    str,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS",
        help="Address of a dask scheduler, whose workers share the work; see docs/distributed.md.",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else.")]
Config = Annotated[Path | None, typer.Option("--config", help="Options from a TOML file; flags win over it.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
ImageFolder = Annotated[
    Path | None,
    typer.Option(
        "--images",
        "--image_path",
        metavar="FOLDER",
        help="Folder of the images: matched where there is no database, and shown in FILE.",
    ),
]

ScaleBarsFile = Annotated[
    Path | None,
    typer.Option(
        "--scale-bars", metavar="FILE", help="Known lengths between points, as of `locate`, to compare with."
    ),
]

_ALSO = {"quiet": "-q", "verbose": "-v", "images": "--image_path"}

_METAVARS: dict[Any, str] = {
    "known_distance": "NAME NAME DISTANCE",
    "fix": "FILE|solved",
    "without": "FILE",
    "control_points": "FILE",
    "scale_bars": "FILE",
    "length": "PLACE PLACE",
    "gravity": "FILE|database",
    "rotations": "auto|held|free|SIGMA_DEG",
    "config": "FILE",
    "images": "FOLDER",
    "mask_path": "FOLDER",
    "offset": "X,Y,Z",
    "rig_config_path": "FILE",
    int: "INTEGER",
    float: "NUMBER",
    int | None: "INTEGER",
    float | None: "NUMBER",
}
"""Placeholder of a flag's value in the help, by the field's name or else by its type."""

_ASKED_OF_MODELS = {"control_points", "length"}
"""Flags of `evaluate` that ask a finished model, as `check` does."""
_REPEATED = {"known_distance": (str, str, float), "length": (str, str)}
"""Repeatable flags of several values, which typer has no way to declare, and the types of these values."""

_WORDS_OR_NUMBERS = {"rotations"}
"""Flags that take a word or a number; typer has no way to declare these either."""

_JOINT = "\0"  # between the values of one flag; no argument of a program can hold it

_FIRST_SCREEN = {
    "locate": (
        *("database", "priors", "control_points", "known_distance", "fix", "without", "rotations"),
        *("intrinsics", "adjust", "scale", "images", "overwrite", "json", "threads"),
    ),
    "map": (
        *("camera_model", "camera_mode", "pairing", "mask_path", "rig_config_path"),
        *("priors", "control_points", "known_distance", "intrinsics", "adjust"),
        *("images", "overwrite", "json", "threads"),
    ),
    "join": ("database", "adjust", "without", "images", "overwrite", "json"),
    "synth": (
        *("shape", "num_images", "num_points", "rig", "images", "pixel_noise_px", "wrong_match_fraction"),
        *("corrupted_pair_fraction", "rotation_noise_deg", "repeated_fraction", "model", "database", "seed"),
    ),
}
"""Options that `--help` lists, in their order, of the commands that have many; `--help-all` lists all."""
STRICT_HELP = 'End with exit code 4 where the verdict is "do not use" or "cannot be judged"'
_HELP_ALL = "--help-all"
_ALL_OPTIONS = "sfm_shapefit.all_options"
"""Key of a context's `meta` that is set where the help is to list all options."""


@dataclass(frozen=True, kw_only=True)
class OutputFlags(Settings):
    """What is written and shown."""

    config: str = option("", "Options from a TOML file; flags win over it.")
    overwrite: bool = option(False, "Replace an earlier output of sfm-shapefit, of any command.")
    report: bool = option(True, "Write report.html: one page that works offline.")
    images: str = option(
        "", "Folder of the images: points get their colors, report.html small pictures of them, 4 MB at most."
    )
    json: bool = option(False, "Print one JSON object on stdout and nothing else.")
    strict: bool = option(False, f"{STRICT_HELP}; OUT is written.")
    quiet: bool = option(False, "Print nothing but errors.")
    verbose: bool = option(False, "Show every detail, the seconds of each stage, and pycolmap's messages.")


class GroupedCommand(TyperCommand):
    """A command whose `--help` lists what is used most, and `--help-all` all options by their groups."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the words of the usage line: arguments are needed, though COLMAP's flags may give them."""
        pieces = super().collect_usage_pieces(ctx)
        return [piece if piece == self.options_metavar else _bare(piece) for piece in pieces]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments first, then the options."""
        for title, records in self._sections(ctx).items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)

    def _sections(self, ctx: Any) -> dict[str, list[tuple[str, str]]]:
        """Return names and sentences of arguments, and of options used most or all by their groups."""
        groups: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        first = () if _ALL_OPTIONS in ctx.meta else _FIRST_SCREEN.get(self.name or "", ())
        by_name: dict[str, tuple[str, str]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is None:
                continue
            by_name[parameter.name or ""] = record
            if parameter.param_type_name == "argument":
                groups["Arguments"].append((_bare(record[0]), record[1]))
            elif not first:
                title = getattr(parameter, "rich_help_panel", None) or "Options"
                groups.setdefault(title, []).append(record)
        if first:
            shown = [(by_name[name][0], brief_help(by_name[name][1])) for name in first]
            groups["Options"] = [*shown, (_HELP_ALL, "Show all options."), by_name["help"]]
        return groups

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse flags, the several values of one as one."""
        if _HELP_ALL in args and not ctx.resilient_parsing:
            ctx.meta[_ALL_OPTIONS] = True
            args = ["--help"]
        parameters = self.get_params(ctx)
        known = {name for one in parameters for name in (*one.opts, *one.secondary_opts)}
        args = _with_hyphens(args, known)
        flag_names.update(name.removeprefix("--").replace("-", "_") for name in known)
        if not ctx.resilient_parsing:
            self._refuse_unknown(ctx, args, known)
        if "--database" in known:
            ctx.allow_extra_args = True  # so that they can be looked at
        convert_plainly(parameters)
        try:
            extra = super().parse_args(ctx, _gather_values(args))
        except typer.BadParameter as error:
            said = error.message.removeprefix("Value error, ")  # typer has it from pydantic
            error.message = said.replace("Input should be", "must be").partition(", unable to parse")[0]
            raise
        if extra and "--database" in known and not ctx.resilient_parsing:
            _refuse_extra(ctx, extra)
        return extra

    def _refuse_unknown(self, ctx: Any, args: Sequence[str], known: set[str]) -> None:
        """Refuse flags that are keys of --config, or another command's; others are the parser's business."""
        settings = getattr(self.callback, "settings", None)
        groups = () if settings is None else setting_groups(settings)
        key_names.clear()
        key_names.update(item.name for one in groups for item in one.options)
        for word in itertools.takewhile(lambda word: word != "--", args):
            flag = word.partition("=")[0]
            name = flag.removeprefix("--").removeprefix("no-").replace("-", "_")
            if not flag.startswith("--") or flag in known:
                continue
            if name in key_names:
                ctx.fail(f"{flag} is a key of --config: {name} = ...")
            if others := _commands_with(name):
                is_asked = ctx.info_name == "check" and name in _ASKED_OF_MODELS
                how = (
                    f": sfm-shapefit evaluate {shlex.join(args).replace(flag, _flag_of(name))}"
                    if is_asked
                    else ""
                )
                ctx.fail(f"{flag} is an option of {others}{how}")
            if answer := answer_for(flag, known | key_names):
                ctx.fail(answer)


def _with_hyphens(args: Sequence[str], known: set[str]) -> list[str]:
    """Return arguments with flags as they are known, where underscores stand in the place of hyphens."""
    flags = itertools.takewhile(lambda word: word != "--", args)
    spelled = []
    for word in flags:
        flag, equals, value = word.partition("=")
        hyphened = flag.replace("_", "-")
        is_typed = flag.startswith("--") and flag not in known and hyphened in known
        spelled.append(f"{hyphened}{equals}{value}" if is_typed else word)
    return [*spelled, *args[len(spelled) :]]


def _bare(name: str) -> str:
    """Return the name of an argument, or of a list of them, without what says that it may be left out."""
    return name.removesuffix("]...").strip("[]").replace("<list[Path]>", "<path>")


def brief_help(text: str) -> str:
    """Return what an option is, without what its values mean, and its default."""
    words = re.split(r"[.:;] | \[default: ", text, maxsplit=1)[0].rstrip(".")
    return words + "".join(re.findall(r" \[default: [^]]*\]", text))


def _refuse_extra(ctx: Any, extra: Sequence[str]) -> None:
    """Refuse more arguments than a command has; say where a database belongs, if one of them is that."""
    from sfm_shapefit.files.lines import is_database

    paths = [value for value in ctx.params.values() if isinstance(value, Path)]
    for path in (*paths, *map(Path, extra)):
        if is_database(path) and path != ctx.params.get("database"):
            ctx.fail(f"{path} is a database, which goes by --database {path}")
    ctx.fail(f"Got unexpected extra argument(s) ({' '.join(extra)})")


def takes(
    *flags: Sequence[inspect.Parameter], settings: type[Settings] | None = None
) -> Callable[[Command], Command]:
    """Give a command flags, as of `flags_of`, None where the user says nothing.

    Options of its `settings` that are no flags are keys of --config.
    """

    def decorate(command: Command) -> Command:
        signature = inspect.signature(command, eval_str=True)
        own = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
        parameters = [*own, *(flag for some in flags for flag in some)]
        command.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        command.__annotations__ = {p.name: p.annotation for p in parameters} | {"return": None}
        command.settings = settings  # type: ignore[attr-defined]
        return command

    return decorate


def flags_of(settings: type[Settings], *names: str) -> list[inspect.Parameter]:
    """Return a keyword parameter with a typer option for each option of a class, or those that are named."""
    parameters = []
    for group in setting_groups(settings):
        for item in group.options:
            if names and item.name not in names:
                continue
            flag = _flag_of(item.name)
            is_switch = settings is OutputFlags and item.default is False
            has_opposite = item.kind is bool and not is_switch
            spelled = [f"{flag}/--no{flag[1:]}" if has_opposite else flag]
            spelled += [_ALSO[item.name]] if item.name in _ALSO else []
            shown = {"True": "yes", "False": "no"}.get(str(item.default), str(item.default))
            default = "" if item.default in (None, "", ()) or is_switch else f" [default: {shown}]"
            flagged = typer.Option(
                *spelled,
                help=item.help + default,
                rich_help_panel=group.title,
                metavar=_METAVARS.get(item.name, _METAVARS.get(item.kind)),
            )
            kind = str if item.name in _WORDS_OR_NUMBERS else item.kind
            annotation: Any = Annotated[(list[str] if item.name in _REPEATED else kind) | None, flagged]
            keyword = inspect.Parameter.KEYWORD_ONLY
            parameters.append(inspect.Parameter(item.name, keyword, default=None, annotation=annotation))
    return parameters


def _flag_of(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _gather_values(args: Sequence[str]) -> list[str]:
    """Return arguments in which the values of a repeated flag are one."""
    counts = {_flag_of(name): len(kinds) for name, kinds in _REPEATED.items()}
    gathered, waiting = [], list(args)
    while waiting and waiting[0] != "--":
        word = waiting.pop(0)
        flag, equals, value = word.partition("=")
        count = counts.get(flag, 0)
        if not count:
            gathered.append(word)
            continue
        values = [value, *waiting] if equals else waiting
        gathered += [flag, _JOINT.join(values[:count])]
        waiting = values[count:]
    return gathered + waiting


def split_values(name: str, text: str) -> tuple[Any, ...]:
    """Return the values of a repeated flag that `_gather_values` made one."""
    try:
        return tuple(kind(part) for kind, part in zip(_REPEATED[name], text.split(_JOINT), strict=True))
    except ValueError as error:
        raise typer.BadParameter(f"{_flag_of(name)} takes {_METAVARS[name]}") from error


def _word_or_number(text: str) -> str | float:
    try:
        return float(text)
    except ValueError:
        return text


def read_options(settings: type[S], given: dict[str, Any], config: Path | None = None) -> S:
    """Return options from a TOML file, if there is one, and the flags that were given, which win.

    Flags are None where the user says nothing; what is no field of the class is left to others.

    Raises:
        InputError: if the file is none that may be read.
        typer.BadParameter: if it is no TOML, or an option is unknown or has a wrong value.
    """
    known = homes_of(settings)
    in_file = _read_toml(config, settings) if config else {}
    flags = {name: value for name, value in given.items() if value is not None and name in known}
    for name in _REPEATED.keys() & flags.keys():
        flags[name] = tuple(split_values(name, text) for text in flags[name])
    flags |= {name: _word_or_number(flags[name]) for name in _WORDS_OR_NUMBERS & flags.keys()}
    try:
        return settings(**in_file | flags)
    except (TypeError, ValueError) as error:
        message = str(error)
        if config and _is_wrong_alone(settings, in_file, message):
            message = f"{_place_of(message, config)}: {message}"
        for name in flags:  # an option of the file keeps its spelling
            message = re.sub(rf"\b{name}(?=[ =])", _flag_of(name), message)
            message = message.replace(f"{_flag_of(name)}=", f"{_flag_of(name)} ")
        raise typer.BadParameter(message) from error


def _is_wrong_alone(settings: type[Settings], values: dict[str, Any], message: str) -> bool:
    """Return whether the values of a file alone are refused in the same words."""
    try:
        settings(**values)
    except (TypeError, ValueError) as error:
        return str(error) == message
    return False


def _read_toml(path: Path, settings: type[Settings]) -> dict[str, Any]:
    """Return the values of a TOML file whose keys are options, or groups of them."""
    from sfm_shapefit.base.paths import refuse_irregular_file
    from sfm_shapefit.files.lines import text_of

    refuse_irregular_file(path)
    try:
        text = text_of(path)
    except InputError as error:
        raise typer.BadParameter(str(error)) from None
    homes = homes_of(settings)
    known = {*homes, *homes.values()}
    try:
        read = tomllib.loads(f"{text}\n")  # errors of the last line are told by its number, too
    except (ValueError, RecursionError) as error:
        if answer := answer_for_file(_names_in_ini(text), flags_and_keys()):
            raise typer.BadParameter(f"{path} {answer}") from error
        said = str(error).replace("Cannot overwrite a value", "a key is given for the second time")
        raise typer.BadParameter(f"{path} is not a readable TOML file: {said}") from error
    unknown = [name for name in read if name not in known]
    if unknown and (answer := answer_for_file(_names_in(read, unknown), flags_and_keys())):
        raise typer.BadParameter(f"{path} {answer}")
    for name in unknown:
        raise typer.BadParameter(f"{path}: {name!r} {_describe_unknown(name, sorted(known))}")
    return read


def _place_of(message: str, path: Path) -> str:
    """Return a TOML file, and the line of the option that a message begins with, if it has one."""
    from sfm_shapefit.files.lines import text_of

    name = re.match(r"\w*", message)
    key = re.compile(rf"\s*{name and name.group()}\s*=")
    numbers = (number for number, line in enumerate(text_of(path).split("\n"), 1) if key.match(line))
    number = next(numbers, None)
    return f"{path}, line {number}" if number else str(path)


def _names_in(read: dict[str, Any], chosen: Iterable[str]) -> Iterator[str]:
    """Yield names of options of a TOML file, those of a table after its name and a point."""
    for name in chosen:
        value = read[name]
        yield from (f"{name}.{key}" for key in value) if isinstance(value, dict) else [name]


def _names_in_ini(text: str) -> list[str]:
    """Return the names of options as COLMAP writes them into a file, none if the text is no such file."""
    import configparser  # here: few files are refused

    ini = configparser.ConfigParser(interpolation=None, strict=False)
    try:
        ini.read_string(f"[ ]\n{text}")  # the first options have no group
    except configparser.Error:
        return []
    return [f"{group}.{name}".lstrip(" .") for group in ini.sections() for name in ini.options(group)]


def _describe_unknown(name: str, known: Sequence[str]) -> str:
    """Say what a key is that this command does not know: a flag, another command's, or a typo."""
    if name in {"database", "priors", "scheduler", *homes_of(OutputFlags)}:
        return f"is no key of a file; give it as a flag: {_flag_of(name)}"
    others = _commands_with(name)
    return f"is an option of {others}" if others else f"is no option; {hint(name, known)}"


def _commands_with(name: str) -> str:
    """Return the commands that have an option as a flag or a key; empty if none has."""
    from sfm_shapefit.cli.root import app, load_commands
    from sfm_shapefit.facts.command_options import InspectOptions, JoinOptions, LocateOptions, MapOptions

    kinds = {"locate": LocateOptions, "map": MapOptions, "join": JoinOptions, "inspect": InspectOptions}
    having = [command for command, kind in kinds.items() if name in homes_of(kind)]
    load_commands()
    commands: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    for command, shown in commands.items():
        is_known = any(_flag_of(name) in one.opts for one in shown.params) and not shown.hidden
        having += [command] * (is_known and command not in having)
    return " and ".join(filter(None, [", ".join(having[:-1]), *having[-1:]]))


def one_path(positional: Path | None, flag: Path | None, name: str) -> Path:
    """Return the one path that was given, by position or by COLMAP's name."""
    if positional is not None and flag is not None:
        raise typer.BadParameter(f"{name} is given twice; give it by position or by name")
    path = positional if positional is not None else flag
    if path is None:
        raise typer.BadParameter(f"{name} is missing")
    return path
