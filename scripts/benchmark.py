"""Benchmarks of sfm_shapefit: `python scripts/benchmark.py real --help`.

One subcommand per module of scripts/benchmarks; each rewrites its own section of scripts/results.md.
"""

import argparse
import sys
from collections.abc import Sequence
from types import ModuleType


def subcommands() -> dict[str, ModuleType]:
    """Return the module of each subcommand.

    They are imported here, not above, because measured processes import this file, too: what the other
    subcommands need, such as pycolmap, would count as memory of what is measured.
    """
    from benchmarks import (
        answers,
        coherent,
        directions,
        endtoend,
        families,
        forecasts,
        onedsfm,
        peers,
        real,
        rigid,
        rigs,
        scale,
        solver,
        trust,
    )
    from benchmarks import (
        map as mapping,
    )

    return {
        "real": real,
        "solver": solver,
        "scale": scale,
        "graphs": families,
        "rigidity": rigid,
        "peers": peers,
        "onedsfm": onedsfm,
        "directions": directions,
        "trust": trust,
        "coherent": coherent,
        "rigs": rigs,
        "map": mapping,
        "endtoend": endtoend,
        "forecast": forecasts,
        "answers": answers,
    }


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    modules = subcommands()
    subparsers = parser.add_subparsers(dest="subcommand", required=True)
    for name, module in modules.items():
        module.add_arguments(subparsers.add_parser(name, help=module.HELP, description=module.HELP))
    args = parser.parse_args(argv)
    code: int = modules[args.subcommand].run(args)
    return code


if __name__ == "__main__":
    sys.exit(main())
