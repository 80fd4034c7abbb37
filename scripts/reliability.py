"""How sfm_shapefit holds up against input, machine and users: `python scripts/reliability.py fuzz --help`.

One subcommand per module of scripts/abuse.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

# One thread in all libraries, before any is loaded: a process with threads must not fork.
for _name in ("OPENBLAS", "OMP", "MKL", "NUMBA", "RAYON"):
    os.environ[f"{_name}_NUM_THREADS"] = "1"
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from abuse import determinism, faults, fuzz, soak, walkers  # noqa: E402

SUBCOMMANDS = {
    "fuzz": fuzz,
    "faults": faults,
    "determinism": determinism,
    "soak": soak,
    "walkers": walkers,
}


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    subparsers = parser.add_subparsers(dest="subcommand", required=True)
    for name, module in SUBCOMMANDS.items():
        module.add_arguments(subparsers.add_parser(name, help=module.HELP, description=module.HELP))
    args = parser.parse_args(argv)
    code: int = SUBCOMMANDS[args.subcommand].run(args)
    return code


if __name__ == "__main__":
    sys.exit(main())
