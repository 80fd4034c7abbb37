"""How sfm_shapefit holds up against damaged input, faults of the machine, and another order, at length.

    python -m tests.abuse fuzz --cases 10000 --seed 0
    python -m tests.abuse faults
    python -m tests.abuse determinism

Each prints what fails and ends with 1 if anything does. `test_abuse.py` runs short rounds of them.
"""

import argparse
import os
import sys


def main():
    # One thread in all libraries, before any is loaded: a process with threads must not fork.
    os.environ.update({f"{name}_NUM_THREADS": "1" for name in ("OPENBLAS", "OMP", "MKL", "NUMBA", "RAYON")})
    from tests.abuse import determinism, faults, fuzz

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    modules = {"fuzz": fuzz, "faults": faults, "determinism": determinism}
    for name, module in modules.items():
        about = module.__doc__.splitlines()[0]
        module.add_arguments(commands.add_parser(name, help=about, description=about))
    args = parser.parse_args()
    return modules[args.command].run(args)


if __name__ == "__main__":
    sys.exit(main())
