"""The driver of all benchmarks: it measures cases in fresh processes and writes a section of the results.

A benchmark states its cases, each of which gives rows of tables, and what its columns mean. All understand

    --only NAME ...   the cases whose names begin so
    --quick           a small version, which takes seconds and says nothing of speed
    --repeats N       runs, or seeds, of each case
    --threads N       threads of every library in the processes that are measured
    --data DIR        the folder of the real sets
    --cache FILE      what an interrupted run of the same command measured is taken from there
    --out FILE        the section; scripts/results/NAME.md by default, nowhere by default with --quick
"""

import argparse
import os
import pickle
import shlex
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from harness.process import call, thread_environment
from harness.record import Row, count_met, environment, table, tables_of, versions

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data"
"""Where the real sets are looked for."""
RESULTS = ROOT / "scripts" / "results"
NOT_FOUND = "its data is not found; give their folder with --data"

Case = Callable[[], Row | Sequence[Row]] | str
"""A function to be called in a fresh process, or the reason why the case is skipped."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Benchmark:
    """What is measured and how it is shown."""

    name: str
    title: str
    cases: Callable[[argparse.Namespace], Mapping[str, Case]]
    """By name; a case can be pickled, such as a `partial` of a function of a module."""
    columns: Mapping[str, str]
    """The unit of each column, and what it means."""
    notes: Mapping[str, str] = field(default_factory=dict)
    """Text before a table, by its heading."""
    closing: Callable[[Sequence[Row]], Iterable[str]] = lambda _rows: ()
    """Further parts of the section, of all rows."""
    packages: Sequence[str] = ("numpy", "scipy", "numba", "pycolmap")
    flags: Callable[[argparse.ArgumentParser], None] = lambda _parser: None
    """Declares further arguments."""
    quick: Mapping[str, Any] = field(default_factory=dict)
    """Arguments that --quick changes."""
    repeats: int = 1
    threads: int = 1
    timeout_s: float | None = None
    """After which a case is ended."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the common arguments and those of this benchmark."""
        add = parser.add_argument
        add("--only", nargs="+", default=[], metavar="NAME", help="cases whose names begin so (all)")
        add("--quick", action="store_true", help="a small version that takes seconds")
        add("--repeats", type=positive, default=self.repeats, help=f"runs or seeds ({self.repeats})")
        add("--threads", type=positive, default=self.threads, help=f"threads measured ({self.threads})")
        add("--data", type=Path, default=DATA, help="folder of the real sets")
        add("--cache", type=Path, help="file that keeps what is measured, for interrupted runs")
        add("--out", type=Path, help=f"file of the section (scripts/results/{self.name}.md)")
        self.flags(parser)

    def run(self, args: argparse.Namespace) -> int:
        """Measure, print the section and write it; a missed limit is no failure."""
        if args.quick:
            vars(args).update(self.quick)
        about = environment(self.packages, self.command_line(args))
        rows, reasons, loads = self._measure(choose(self.cases(args), args.only), args)
        for name, reason in reasons.items():
            print(f"{name}: {reason}", file=sys.stderr)
        if not rows:
            return 0
        about += f"- Load average (1 min) while measuring: {min(loads):.1f} to {max(loads):.1f}\n"
        body = self.section(rows, about, reasons)
        print(body)
        if args.out is not None or not args.quick:
            replace_file(args.out or RESULTS / f"{self.name}.md", body.encode())
        return 0

    def section(self, rows: Sequence[Row], about: str = "", reasons: Mapping[str, str] | None = None) -> str:
        """Return the section of what was measured, and of what was not and why."""
        missing = "; ".join(f"{name}: {reason}" for name, reason in (reasons or {}).items())
        parts = [
            f"# {self.title}",
            about,
            count_met([check for row in rows for check in row.checks]),
            *tables_of(rows, self.notes),
            *self.closing(rows),
            f"Not measured: {missing}." if missing else "",
            "## What the columns mean",
            table(["column", "unit and meaning"], self.columns.items()),
        ]
        return "\n\n".join(part.strip() for part in parts if part) + "\n"

    def command_line(self, args: argparse.Namespace) -> str:
        """Return the command that repeats the measurement, without paths."""
        parser = argparse.ArgumentParser()
        self.add_arguments(parser)
        words = ["python", "scripts/benchmark.py", self.name]
        for action in parser._actions:
            value = getattr(args, action.dest, action.default)
            if action.type is Path or value == action.default or (args.quick and action.dest in self.quick):
                continue
            given = value if isinstance(value, list) else [] if value is True else [value]
            words += [action.option_strings[-1], *map(str, given)]
        return shlex.join(words)

    def _measure(
        self, cases: Mapping[str, Case], args: argparse.Namespace
    ) -> tuple[list[Row], dict[str, str], list[float]]:
        """Return the rows of the cases, why others gave none, and the loads of the machine."""
        rows, reasons, loads = list[Row](), dict[str, str](), [os.getloadavg()[0]]
        variables = thread_environment(args.threads)
        kept = Kept(args.cache, {"command": self.command_line(args), "versions": versions(self.packages)})
        for name, case in cases.items():
            if isinstance(case, str):
                reasons[name] = case
                continue
            print(f"measuring {name}", file=sys.stderr, flush=True)
            try:
                found = kept.get(name, partial(call, case, environment=variables, timeout_s=self.timeout_s))
                rows += [found] if isinstance(found, Row) else found
            except (RuntimeError, TimeoutError) as error:
                reasons[name] = f"failed: {error}"
            loads.append(os.getloadavg()[0])
        return rows, reasons, loads


class Kept:
    """What was measured, by name: in a file that belongs to settings or, without one, in memory only."""

    def __init__(self, file: Path | None, settings: object) -> None:
        """Read what an earlier run of the same settings left.

        Raises:
            ValueError: if the file belongs to other settings.
        """
        self._file, self._settings = file, settings
        self._answers: dict[str, Any] = {}
        if file is None or not file.exists():
            return
        kept_settings, self._answers = pickle.loads(file.read_bytes())
        if kept_settings != settings:
            raise ValueError(f"{file} holds answers of other settings; delete it or give another --cache")

    def __contains__(self, name: str) -> bool:
        return name in self._answers

    def get(self, name: str, ask: Callable[[], Any]) -> Any:
        """Return the answer kept under a name, or ask for it and keep it."""
        if name not in self._answers:
            self._answers[name] = ask()
            if self._file is not None:
                replace_file(self._file, pickle.dumps((self._settings, self._answers)))
        return self._answers[name]


def if_there(folder: Path, case: Case) -> Case:
    """Return a case if its data is there, or the reason why it is skipped."""
    return case if folder.exists() else NOT_FOUND


def on_sets(data: Path, names: Iterable[str], measure: Callable[..., Any], *args: Any) -> dict[str, Case]:
    """Return a case for each real set, `measure(folder, *args)`."""
    return {name: if_there(data / name, partial(measure, data / name, *args)) for name in names}


def choose(cases: Mapping[str, Case], beginnings: Sequence[str]) -> dict[str, Case]:
    """Return the cases whose names begin with one of these; all without any.

    Raises:
        SystemExit: if one of the beginnings fits no case.
    """
    unknown = [part for part in beginnings if not any(name.startswith(part) for name in cases)]
    if unknown:
        raise SystemExit(f"--only: no case begins with {', '.join(unknown)}; known: {'; '.join(cases)}")
    wanted = tuple(beginnings) or ("",)
    return {name: case for name, case in cases.items() if name.startswith(wanted)}


def replace_file(file: Path, content: bytes) -> None:
    """Put a file in place of an earlier one in one step."""
    file.parent.mkdir(parents=True, exist_ok=True)
    unfinished = file.with_name(f".{file.name}.partial")
    unfinished.write_bytes(content)
    unfinished.replace(file)


def positive(text: str) -> int:
    """Parse a number that is at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 1 or more")
    return int(text)
