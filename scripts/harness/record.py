"""What stands around the figures: tables, the machine, versions. No host name and no path is recorded."""

import datetime
import os
import platform
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from harness.metrics import Quantity
from sfm_shapefit import __version__


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table.

    Raises:
        ValueError: if a row has another number of cells than the header.
    """
    for row in rows:
        if len(row) != len(header):
            raise ValueError(
                f"row {row[0] if row else ''!r} has {len(row)} cells, the header has {len(header)}"
            )
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in lines) + "\n"


def table_of(rows: Iterable[Any], columns: Mapping[str, Callable[[Any], str]]) -> str:
    """Return a Markdown table with a row per value; `columns` has the heading and the text of each column."""
    return table([*columns], [[show(row) for show in columns.values()] for row in rows])


def legend(quantities: Sequence[Quantity]) -> str:
    """Return the table that says what each column means."""
    return table(
        ["column", "unit", "better", "tolerance between runs", "meaning"],
        [[q.name, q.unit, q.better, f"{q.rel_tol:.0%}", q.meaning] for q in quantities],
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
    """Return each package with its version."""
    return [f"{name} {_version(name)}" for name in packages]


def cpu_model(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Return the processor's model name, or what is known of it."""
    try:
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or "processor unknown"


def leave_out(keys: Collection[str], value: Any) -> Any:
    """Return a JSON value without the entries of these keys, wherever they stand."""
    if isinstance(value, dict):
        return {key: leave_out(keys, inner) for key, inner in value.items() if key not in keys}
    return [leave_out(keys, inner) for inner in value] if isinstance(value, list) else value


def _version(package: str) -> str:
    """Return a package's version, or that it is missing."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
