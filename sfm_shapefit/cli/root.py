"""The command line's root: commands join it as their modules are loaded."""

import atexit
import gc
import sys
from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from sfm_shapefit import __version__
from sfm_shapefit.cli.colmap_names import answer_for_command
from sfm_shapefit.cli.console import (
    EXIT_INTERRUPTED,
    catch_termination,
    ignore_signals,
    open_closed_streams,
    refuse_little_memory,
    repeat_lost_interrupts,
)

_GROUPS = {
    "Make models": ("map", "locate", "join", "place"),
    "Look at models and results": ("check", "inspect", "evaluate"),
    "Convert, and make test scenes": ("workspace", "convert", "synth"),
    "Set up": ("warm-up",),
}
"""The commands in the help, the most used first."""

# New objects after which unused ones are looked for. Modules make a hundred thousand that stay; to go through
# them as often as the interpreter does by itself takes a twentieth of a short run, and even once a hundredth.
_OBJECTS_BETWEEN_SEARCHES = (150_000, 10, 100)


_PLAIN: dict[Any, Any] = {str: str, Path: Path, int: int, float: float, int | None: int, float | None: float}
"""What makes a value of a word, by its type."""


class _PlainConversion:
    """What typer does to words, paths and numbers; for the rest it imports pydantic, a twentieth of a run."""

    def coerce(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the value of a parameter; what is not single, limited, or no such value is left to typer."""
        is_list = param.multiple or param.nargs != 1
        if value is None:
            return () if is_list else None
        kind, limits = param.type_descriptor.annotation, param.type_descriptor.parameter_info
        is_limited = limits.min is not None or limits.max is not None
        if not (is_list or is_limited) and kind in _PLAIN and type(value) is str:
            try:
                return _PLAIN[kind](value)
            except ValueError:
                whole = "a whole number" if kind in (int, int | None) else "a number"
                raise typer.BadParameter(f"must be {whole}, got {value!r}", ctx, param) from None
        return type(param).get_runtime_param(param).coerce(value, param=param, ctx=ctx)


def convert_plainly(parameters: Iterable[Any]) -> None:
    """Convert the words and paths of a command's parameters without typer."""
    for parameter in parameters:
        if hasattr(parameter, "get_runtime_param"):  # which earlier versions do not have
            parameter.get_runtime_param = _PlainConversion


class _ByImportance(TyperGroup):
    """Commands in groups and in the order of their importance, not of the alphabet."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the flags before the command."""
        convert_plainly(self.get_params(ctx))
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that is called; one of COLMAP's is answered with what it is here."""
        if answer := answer_for_command(*args[:2]):
            ctx.fail(answer)
        return super().resolve_command(ctx, args)

    def list_commands(self, ctx: Any) -> list[str]:
        """Return all names, those of the groups first."""
        known = [name for names in _GROUPS.values() for name in names if name in self.commands]
        return known + [name for name in super().list_commands(ctx) if name not in known]

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        known = self.list_commands(ctx)
        for title, names in _GROUPS.items():
            shown = [(name, self.commands[name].get_short_help_str(100)) for name in names if name in known]
            with formatter.section(title):
                formatter.write_dl(shown)


app = typer.Typer(
    cls=_ByImportance,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # its columns break long sentences into one word a line
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"sfm-shapefit {__version__}")  # noqa: T201
        raise typer.Exit


@app.callback()
def root(
    *,
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None:
    """Make COLMAP models from matches, or from known rotations, and say whether to trust them."""


def load_commands(words: Sequence[str] = ()) -> None:
    """Load the command that such words call, or all where they call none: for the help, or to name the like.

    To load and to describe the others takes longer than the rest of the command line.
    """
    known = [name for names in _GROUPS.values() for name in names]
    called = next((word for word in words if not word.startswith("-")), None)
    for name in [called] if called in known else known:
        import_module(f"sfm_shapefit.cli.{name.replace('-', '_')}")


def run_command() -> None:
    """Run the command line. A request to terminate ends it like an interrupt from the keyboard."""
    open_closed_streams()
    catch_termination()
    repeat_lost_interrupts()
    gc.set_threshold(*_OBJECTS_BETWEEN_SEARCHES)
    # As it ends, the interpreter looks for unused objects again and again: a fifth of a short run. What is
    # there then goes with the process.
    atexit.register(gc.freeze)
    try:
        refuse_little_memory()
        load_commands(sys.argv[1:])
        app()
    except KeyboardInterrupt:  # outside a command: while modules are loaded
        sys.exit(EXIT_INTERRUPTED)
    finally:
        ignore_signals()
