"""The frame of the commands that make OUT: it is claimed, errors are caught, progress and results shown."""

import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic

import typer

from sfm_shapefit.base.display import row
from sfm_shapefit.base.libraries import import_packages
from sfm_shapefit.base.paths import OF_DATABASE, SOLVED
from sfm_shapefit.base.settings import S, flat_values
from sfm_shapefit.base.wording import first_of
from sfm_shapefit.cli.console import (
    EXIT_UNSOLVABLE,
    print_answer,
    print_ending,
    print_json,
    print_table,
    report_errors,
)
from sfm_shapefit.cli.flags import OutputFlags, read_options
from sfm_shapefit.cli.forecast import PLANS
from sfm_shapefit.cli.progress import show_progress
from sfm_shapefit.files.matching_options import MADE_FIRST

if TYPE_CHECKING:
    from sfm_shapefit.base.clock import Progress
    from sfm_shapefit.base.kernel_cache import CompileTime
    from sfm_shapefit.facts.map_result import JoinedModel, MapResult
    from sfm_shapefit.facts.result import GraphResult, LocateResult

    Result = LocateResult | MapResult | GraphResult | JoinedModel

_BLACK = "the points have none; --images FOLDER takes them from the images"
_IN_PLACE_OF_FILES = {OF_DATABASE, SOLVED}
"""Words that options take where else they take a file."""
_NOTICED_S = 1.0  # seconds; a user does not notice less compiling


@dataclass(slots=True, kw_only=True)
class Run(Generic[S]):
    """A command at work: its options, and the result that it shows in the end."""

    options: S
    flags: OutputFlags
    protect: list[Path]
    """Inputs, which OUT must not be, nor contain."""
    progress: "Progress | None" = None
    shown: Callable[[], None] = field(default=lambda: None)
    is_unusable: bool = False
    started: float = field(default_factory=time.perf_counter)
    compiling: "CompileTime | None" = None
    """Seconds spent compiling so far."""

    def finish(self, found: "Result", source: Path, out: Path) -> None:
        """Write the result, and print its facts as JSON, or what is told of it, or nothing, in the end.

        The command ends with exit code 4, if that was asked for and the model is not to be used.
        """
        from sfm_shapefit.commands.write import WriteOptions, deliver

        flags = self.flags
        how: dict[str, Any] = {"overwrite": flags.overwrite, "report": flags.report, "images": flags.images}
        if self.progress is not None:
            self.progress("write", 0, 1)
        found = deliver(found, out, WriteOptions(protect=tuple(self.protect), **how))
        self.is_unusable = flags.strict and not found.verdict.is_usable
        if self.flags.json:
            self.shown = lambda: print_json(found.summary())
        elif not self.flags.quiet:
            self.shown = lambda: self._tell(found, source, out)

    def _tell(self, found: "Result", source: Path, out: Path) -> None:
        """Print the details if they are wanted, the answer, the verdict, and what to do next."""
        from sfm_shapefit.commands.colors import has_colors

        told, pages = found.told, [str(out / folder / "report.html") for folder in found.told.folders]
        if self.flags.verbose:
            known = dict(found.timings_s)
            rest = time.perf_counter() - self.started - sum(known.values())
            stages = ", ".join(f"{stage} {s:.2f}" for stage, s in (known | {"start and write": rest}).items())
            print_table(str(source), [*told.details, row("seconds", stages)], told.elsewhere)
        black = "" if self.flags.images or has_colors(found) else _BLACK
        print_answer(told._replace(rows=[*told.rows, row("colors", black)]), self.describe_time())
        opened = f"; open {first_of([*map(shlex.quote, pages)])}" if self.flags.report else ""
        images = self.flags.images if self._has_pictures(found.image_names) else ""
        model = out / told.folders[0]
        step = told.step.at(out=model, out_dense=f"{model}_dense", images=images or "IMAGES")
        print_ending(found.verdict.grade.value, found.verdict.statement, f"written to {out}/{opened}", step)

    def _has_pictures(self, names: Sequence[str]) -> bool:
        from sfm_shapefit.base.paths import file_of

        return any(file_of(Path(self.flags.images), name) for name in names)

    def describe_time(self) -> str:
        """Return the seconds since the start, and how many of them went into compiling if that is noticed."""
        total = f"{time.perf_counter() - self.started:.1f} s"
        compiling = 0.0 if self.compiling is None else self.compiling.seconds
        if compiling >= _NOTICED_S:
            total += f", of which {compiling:.0f} s compiling kernels, once"
        return total


def refuse_swapped(source: Path, target: Path, order: str) -> None:
    """Refuse an output that is what the command reads: the arguments are swapped.

    Raises:
        InputError: if OUT is a model that no command of this program wrote, a database or another file.
    """
    from sfm_shapefit.base.atomic_folder import MAP_MARKER, MARKER
    from sfm_shapefit.base.errors import InputError
    from sfm_shapefit.files.lines import is_database

    if source.exists() and target.exists() and source.samefile(target):
        raise InputError(f"{target} is the input; choose another folder for OUT")
    if order == "MODEL OUT" and is_database(target):
        raise InputError(f"{target} is a database, which goes by --database; the order is {order}")
    ours = any((target / marker).exists() for marker in (MARKER, MAP_MARKER))
    is_model = any((target / f"cameras{suffix}").exists() for suffix in (".bin", ".txt"))
    if (is_model and not ours) or (target.is_file() and not source.is_file()):
        what = "holds a model" if is_model else "is a file"
        first = "" if order.startswith("MODEL") and not is_model else f", so give {target} first"
        raise InputError(f"{target} {what}, but OUT is a folder to be made; the order is {order}{first}")


def _refuse_unreadable(order: str, inputs: Sequence[Path | None], has_images: bool) -> None:
    """Raise InputError if a database, images or models, with theirs after them, cannot be read."""
    from sfm_shapefit.files.colmap.listed_poses import read_source
    from sfm_shapefit.files.colmap.photographs import find_photographs
    from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile, database_in

    first = inputs[0]
    if order == "DATABASE OUT" and first is not None:
        find_photographs(first) if has_images else DatabaseFile(database_in(first)).close()
    elif order.startswith("MODEL"):
        *models, database = inputs[:2] if order == "MODEL OUT" else inputs
        for model in filter(None, models):
            read_source(model, database, rotations_suffice=True)
        if database is not None:
            DatabaseFile(database).close()


@contextmanager
def command_run(
    settings: type[S],
    given: dict[str, Any],
    target: Path,
    inputs: Sequence[Path | None],
    order: str = "MODEL OUT",
    begun: Path | None = None,
) -> Iterator[Run[S]]:
    """Run a command that makes OUT: errors become one sentence and an exit code, and OUT is whole or absent.

    The first input is that which stands before OUT, `order` the names of both. Flags of `settings` and of
    `OutputFlags` are None where the user says nothing. Inputs stay as they are. `begun` is the database that
    the command makes in OUT first, with which an interrupted run is gone on.
    """
    started = time.perf_counter()
    with report_errors(target if begun is None else target / "map.json", begun):
        from sfm_shapefit.base.atomic_folder import claimed_output
        from sfm_shapefit.base.paths import refuse_absent, refuse_no_folder
        from sfm_shapefit.files.model_folder import refuse_no_model

        flags = read_options(OutputFlags, given)
        config = Path(flags.config) if flags.config else None
        options = read_options(settings, given, config)
        if flags.images:  # now, not when all is computed
            refuse_no_folder(Path(flags.images))
        values = flat_values(options)
        named = [
            flags.images,
            *(values.get(n, "") for n in ("fix", "without", "control_points", "scale_bars", "gravity")),
        ]
        paths = [*inputs, config, *(Path(name) for name in named if name)]
        protect = [path for path in paths if path is not None]
        run = Run(options=options, flags=flags, protect=protect, started=started)
        if inputs[0] is not None:
            refuse_swapped(inputs[0], target, order)
        if order.startswith("MODEL"):
            refuse_no_model(inputs[0])
        refuse_absent(*(path for path in protect if str(path) not in _IN_PLACE_OF_FILES))
        if target.exists() and not flags.overwrite:  # what is wrong with the input is said first
            _refuse_unreadable(order, inputs, has_images=begun is not None)
        kept = () if begun is None else MADE_FIRST
        plan = PLANS.get(order if begun is None else "IMAGES OUT", ())
        with claimed_output(target, overwrite=flags.overwrite, protect=run.protect, kept=kept):
            import_packages()
            from sfm_shapefit.base.kernel_cache import measure_compilation
            from sfm_shapefit.files.colmap.quiet import hear_pycolmap

            with (
                measure_compilation() as run.compiling,
                show_progress(not flags.quiet, flags.verbose, plan=plan) as run.progress,
                hear_pycolmap(flags.verbose),
            ):
                yield run
        run.shown()
        if run.is_unusable:
            raise typer.Exit(EXIT_UNSOLVABLE)
