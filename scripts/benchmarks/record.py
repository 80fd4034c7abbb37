"""What stands around the figures: tables, the machine and the versions, and the file of results.

Every benchmark owns one section of the file, between two comment lines that name it, and rewrites only that.
Neither host names nor paths are recorded.
"""

import datetime
import os
import platform
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from benchmarks.metrics import Quantity
from sfm_shapefit import __version__

TITLE = (
    "# Benchmark results\n\nEach section is written by the command it names; edit between sections only.\n"
)


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


def legend(quantities: Sequence[Quantity]) -> str:
    """Return the table that says what each column means."""
    return table(
        ["column", "unit", "better", "tolerance between runs", "meaning"],
        [[q.name, q.unit, q.better, f"{q.rel_tol:.0%}", q.meaning] for q in quantities],
    )


def environment(packages: Sequence[str], command: str) -> str:
    """Return when, how and on what the figures were measured, as a Markdown list."""
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


def _version(package: str) -> str:
    """Return a package's version, or that it is missing."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def write_section(file: Path, name: str, body: str) -> None:
    """Put `body` into the section `name` of a file; other sections and text between them stay as they are.

    Raises:
        ValueError: if the markers of the section do not stand once each, in order; nothing is written then.
    """
    text = file.read_text(encoding="utf-8") if file.exists() else TITLE
    replaced = with_section(text, name, body)
    partial = file.with_name(f".{file.name}.partial")
    partial.write_text(replaced, encoding="utf-8")
    partial.replace(file)


def with_section(text: str, name: str, body: str) -> str:
    """Return `text` with the section `name` replaced, or appended if it has none; see `write_section`."""
    begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
    section = f"{begin}\n{body.strip()}\n{end}"
    counts = (text.count(begin), text.count(end))
    if counts == (0, 0):
        return f"{text.rstrip()}\n\n{section}\n"
    if counts != (1, 1) or text.index(begin) > text.index(end):
        raise ValueError(f"the markers of section '{name}' must stand once each, in order; repair the file")
    before, _, rest = text.partition(begin)
    return before + section + rest.partition(end)[2]
