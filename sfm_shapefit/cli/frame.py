"""The frame of the commands that make OUT: it is claimed, errors are caught, progress and results shown."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic

import typer

from sfm_shapefit.cli.console import (
    EXIT_UNSOLVABLE,
    Rows,
    catch_termination,
    print_json,
    print_table,
    report_errors,
    show_progress,
)
from sfm_shapefit.cli.flags import Options, OutputFlags, read_options

if TYPE_CHECKING:
    from sfm_shapefit.commands.stages.clock import Progress
    from sfm_shapefit.results.model_verdict import ModelVerdict


@dataclass(slots=True, kw_only=True)
class Run(Generic[Options]):
    """A command at work: what it was told, and what it has to show in the end."""

    options: Options
    flags: OutputFlags
    protect: list[Path]
    """Inputs, which OUT must not be, nor contain."""
    progress: "Progress | None" = None
    shown: Callable[[], None] = field(default=lambda: None)
    is_unusable: bool = False

    @property
    def writing(self) -> dict[str, Any]:
        """How the result is written; keywords of `write_result`."""
        flags = self.flags
        how = {"overwrite": flags.overwrite, "report": flags.report, "scene": flags.scene}
        return how | {"protect": self.protect, "images": flags.images}

    def show(self, title: str, facts: dict[str, Any], table: Callable[[], Rows]) -> None:
        """Print the facts as JSON, or a table, or nothing, once the output is complete."""
        if self.flags.json:
            self.shown = lambda: print_json(facts)
        elif not self.flags.quiet:
            self.shown = lambda: print_table(title, table())

    def heed(self, verdict: "ModelVerdict") -> None:
        """End with exit code 4, if that was asked for and the model is not to be used."""
        self.is_unusable = self.flags.strict and verdict.is_bad


@contextmanager
def command_run(
    settings: type[Options], given: dict[str, Any], target: Path, inputs: Sequence[Path | None]
) -> Iterator[Run[Options]]:
    """Run a command that makes OUT: errors become one sentence and an exit code, and OUT is whole or absent.

    Flags of `settings` and of `OutputFlags` are None where the user says nothing. Inputs stay as they are.
    """
    with report_errors(target):
        from sfm_shapefit.atomic_folder import claimed_output

        flags = read_options(OutputFlags, given)
        config = Path(flags.config) if flags.config else None
        options = read_options(settings, given, config)
        if flags.images:  # now, not when all is computed
            from sfm_shapefit.report.thumbnails import refuse_no_folder

            refuse_no_folder(Path(flags.images))
        fixed = getattr(options, "fix", "")
        paths = [
            *inputs,
            config,
            Path(fixed) if fixed else None,
            Path(flags.images) if flags.images else None,
        ]
        run = Run(options=options, flags=flags, protect=[path for path in paths if path is not None])
        with claimed_output(target, overwrite=flags.overwrite, protect=run.protect):
            from sfm_shapefit.colmap.quiet import hear_pycolmap

            catch_termination()
            with show_progress(not flags.quiet, flags.verbose) as run.progress, hear_pycolmap(flags.verbose):
                yield run
        run.shown()
        if run.is_unusable:
            raise typer.Exit(EXIT_UNSOLVABLE)
