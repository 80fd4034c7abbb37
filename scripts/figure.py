"""The figures of the docs: `python scripts/figure.py phase_transition --help`.

Each is a module of figures with `run(args)`, which prints what it has to say and returns the picture.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

NAMES = ("beyond", "fold", "noise_robustness", "phase_transition", "photographs", "theory_plot")


def main(argv: Sequence[str] | None = None) -> None:
    words = sys.argv[1:] if argv is None else list(argv)
    parser = argparse.ArgumentParser(description=__doc__)
    subparsers = parser.add_subparsers(dest="name", required=True)
    for name in NAMES:
        subparser = subparsers.add_parser(name)
        if words[:1] == [name]:
            module = import_module(f"paper.{name}")
            subparser.description = module.__doc__
            add = subparser.add_argument
            add("--out", type=Path, required=True, help="PNG to write")
            add("--quick", action="store_true", help="a small version that takes seconds")
            add("--trials", type=int, default=5 if name == "theory_plot" else 10, help="problems per setting")
            add("--processes", type=int, default=2, help="worker processes, one thread each")
            add("--cache", type=Path, help="file that keeps results between runs")
            if hasattr(module, "add_arguments"):
                module.add_arguments(subparser)
    args = parser.parse_args(words)
    start = time.perf_counter()
    picture = module.run(args)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    picture.savefig(args.out)
    print(f"{args.out.name}: {time.perf_counter() - start:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
