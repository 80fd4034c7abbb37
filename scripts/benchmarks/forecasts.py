"""What `inspect` forecasts of `locate`, against what `locate` takes: peak memory and processor time."""

import argparse
import json
import sys
import tempfile
from pathlib import Path

from benchmarks.endtoend import command
from benchmarks.metrics import Check, number, ratio, verdict
from benchmarks.record import environment, table, write_section

HELP = "The forecast of inspect against what locate takes."
ROOT = Path(__file__).parents[2]
PACKAGES = ("numpy", "scipy", "numba", "pycolmap")
SETS = ("fountain-P11", "Herz-Jesus-P8", "Herz-Jesus-P25", "castle-P19", "castle-P30", "lego100", "liberty")
FACTOR = 1.5
"""By which a forecast may be off, either way."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `forecast`."""
    parser.add_argument("--sets", nargs="+", default=list(SETS), help="names of real sets")
    parser.add_argument(
        "--scenes", nargs="*", type=Path, default=[], help="further workspaces, such as synth's"
    )
    parser.add_argument(
        "--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the real sets"
    )
    parser.add_argument("--out", type=Path, default=ROOT / "scripts" / "results.md", help="file of results")


def run(args: argparse.Namespace) -> int:
    """Measure, print the section and write it; a missed limit is no failure."""
    about = environment(PACKAGES, "python scripts/benchmark.py forecast")
    rows = [measure(name, args.data / name) for name in args.sets]
    rows += [measure(path.name, path) for path in args.scenes]
    header = ["set", "MB forecast", "MB", "ratio", "CPU s forecast", "CPU s", "ratio", "verdict"]
    body = "\n".join(
        [
            "## Reliability: memory and time told beforehand\n",
            about,
            f"\nA forecast may be off by a factor {FACTOR:g}. Processor time includes the process's start.\n",
            table(header, rows),
        ]
    )
    print(body)
    write_section(args.out, "forecast", body)
    return 0


def measure(name: str, workspace: Path) -> list[str]:
    """Return the row of one set."""
    model = workspace / "sparse" / "0"
    expected = json.loads(command("inspect", model, "--json")[1])["expected"]
    with tempfile.TemporaryDirectory() as temporary:
        used, _ = command("locate", model, Path(temporary) / "out", "--quiet")
    pairs = [(expected["peak_mb"], used.peak_mb), (expected["total_s"], used.cpu_s)]
    checks = [Check(name="factor", value=max(ratio(a, b), ratio(b, a)), limit=FACTOR) for a, b in pairs]
    cells = [cell for a, b in pairs for cell in (number(a), number(b), f"{ratio(a, b):.2f}")]
    print(name, *cells, file=sys.stderr, flush=True)
    return [name, *cells, verdict(checks)]
