"""What a benchmark measures and how it is written: rows with limits, tables, the machine, versions.

A limit is met by the value as measured, not as printed; a value that is not finite never meets one. No host
name and no path is recorded.
"""

import datetime
import math
import os
import platform
import statistics
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from numbers import Integral
from pathlib import Path
from typing import Any, Literal

from sfm_shapefit import __version__


@dataclass(frozen=True, slots=True)
class Check:
    """One measured value against the limit that it must reach."""

    name: str
    value: float
    limit: float
    better: Literal["lower", "higher"] = "lower"

    @property
    def met(self) -> bool:
        """Whether the unrounded value reaches the limit; equality does."""
        if not math.isfinite(self.value):
            return False
        return self.value <= self.limit if self.better == "lower" else self.value >= self.limit

    @property
    def goal(self) -> str:
        """What is to be reached, in words."""
        return f"{self.name} {'up to' if self.better == 'lower' else 'from'} {number(self.limit)}"

    def __str__(self) -> str:
        sign = ">" if self.better == "lower" else "<"
        return "met" if self.met else f"{self.name} {number(self.value)} {sign} {number(self.limit)}"


def at_most(**limits: tuple[float, float | None]) -> list[Check]:
    """Return the checks of values that must not be above a limit, `name=(value, limit)`; None is no limit."""
    return [
        Check(name.replace("_", " "), v, limit) for name, (v, limit) in limits.items() if limit is not None
    ]


def at_least(**limits: tuple[float, float | None]) -> list[Check]:
    """Return the checks of values that must not be below a limit; else as `at_most`."""
    return [Check(one.name, one.value, one.limit, "higher") for one in at_most(**limits)]


@dataclass(frozen=True, slots=True)
class Row:
    """A line of a table: cells by column, as text or as measured, and what they have to reach."""

    cells: Mapping[str, Any]
    checks: Sequence[Check] = ()
    table: str = ""
    """Heading of its table."""
    more: Mapping[str, Any] = field(default_factory=dict)
    """What stands in no cell and is needed to close the section."""

    def __getitem__(self, name: str) -> Any:
        return self.more[name] if name in self.more else self.cells[name]


def verdict(checks: Sequence[Check]) -> str:
    """Return "met", "-" where there is nothing to reach, or "missed: ..." with every failed check."""
    if not checks:
        return "-"
    missed = [str(check) for check in checks if not check.met]
    return f"**missed**: {', '.join(missed)}" if missed else "met"


def count_met(checks: Sequence[Check]) -> str:
    """Return how many limits are met, as a sentence in bold; nothing where there is no limit."""
    return f"**{sum(check.met for check in checks)} of {len(checks)} limits met.**" if checks else ""


def ratio(value: float, reference: float) -> float:
    """Return value / reference; NaN if either is not finite or the reference is not positive."""
    if not (math.isfinite(value) and math.isfinite(reference) and reference > 0.0):
        return math.nan
    return value / reference


def times(value: float) -> str:
    """Return a ratio as text, such as "3.4x"; "-" for NaN."""
    return "-" if math.isnan(value) else f"{value:.2g}x" if value < 10.0 else f"{value:.0f}x"


def number(value: float) -> str:
    """Return a value with three significant digits, without an exponent where that stays short."""
    if not math.isfinite(value):
        return "-"
    if value != 0.0 and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.1e}"
    digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
    return f"{value:.{digits}f}"


def median(values: Sequence[float]) -> float:
    """Return the median, NaN of nothing."""
    return statistics.median(values) if values else math.nan


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """Return a in value ~ size^a by least squares of the logarithms; NaN for fewer than two sizes."""
    pairs = [(math.log(s), math.log(v)) for s, v in zip(sizes, values, strict=True) if v > 0.0]
    if len({x for x, _ in pairs}) < 2:
        return math.nan
    return statistics.linear_regression(*zip(*pairs, strict=True)).slope


def text_of(value: Any) -> str:
    """Return the text of a cell: several numbers as "0.0226 / 0.0285", None as "-"."""
    if value is None:
        return "-"
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Integral):
        return str(value)
    return " / ".join(map(text_of, value)) if isinstance(value, Iterable) else number(value)


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a Markdown table.

    Raises:
        ValueError: if a row has another number of cells than the header.
    """
    lines = [list(header), ["---"] * len(header), *([text_of(cell) for cell in row] for row in rows)]
    if any(len(line) != len(header) for line in lines):
        raise ValueError(f"a row has another number of cells than the header: {', '.join(header)}")
    return "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in lines) + "\n"


def tables_of(rows: Sequence[Row], notes: Mapping[str, str]) -> Iterator[str]:
    """Yield the table of each heading, its note before it, what is to be reached and the verdict behind."""
    for heading in dict.fromkeys(row.table for row in rows):
        chosen = [row for row in rows if row.table == heading]
        columns = list(dict.fromkeys(name for row in chosen for name in row.cells))
        ends: list[tuple[str, Callable[[Row], str]]] = []
        if any(row.checks for row in chosen):
            ends = [
                ("to reach", lambda row: ", ".join(check.goal for check in row.checks) or "-"),
                ("verdict", lambda row: verdict(row.checks)),
            ]
        if heading:
            yield f"## {heading}"
        if heading in notes:
            yield notes[heading]
        yield table(
            [*columns, *(name for name, _ in ends)],
            [
                [*(row.cells.get(name) for name in columns), *(show(row) for _, show in ends)]
                for row in chosen
            ],
        )


def environment(packages: Sequence[str], command: str) -> str:
    """Return when, how and on what the figures are measured, as a Markdown list."""
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    return (
        f"- Command: `{command}`\n"
        f"- Date: {datetime.datetime.now(datetime.UTC).date().isoformat()}\n"
        f"- Machine: {os.cpu_count()} cores, {cpu_model()}, {platform.system()} {platform.machine()};"
        f" load average at the start (1, 5, 15 min): {load}\n"
        f"- Versions: sfm_shapefit {__version__}, python {platform.python_version()},"
        f" {', '.join(versions(packages))}\n"
    )


def versions(packages: Sequence[str]) -> list[str]:
    """Return each package with its version, or that it is missing."""
    found = []
    for package in packages:
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            found.append(f"{package} not installed")
    return found


def cpu_model(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Return the processor's model name, or what is known of it."""
    lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines() if cpuinfo.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or "processor unknown"


def leave_out(keys: Collection[str], value: Any) -> Any:
    """Return a JSON value without the entries of these keys, wherever they stand."""
    if isinstance(value, dict):
        return {key: leave_out(keys, inner) for key, inner in value.items() if key not in keys}
    return [leave_out(keys, inner) for inner in value] if isinstance(value, list) else value
