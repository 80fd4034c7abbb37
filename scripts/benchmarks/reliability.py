"""How sfm_shapefit holds up against input, machine and users.

    python scripts/benchmark.py reliability fuzz --help

One subcommand per module of scripts/abuse that has a `run`. They print what fails and write no section.
"""

import argparse
import os
from types import ModuleType

from harness.process import thread_environment


def subcommands() -> dict[str, ModuleType]:
    """Return the module of each subcommand."""
    # One thread in all libraries, before any is loaded: a process with threads must not fork.
    os.environ.update(thread_environment(1))
    from abuse import determinism, faults, fuzz

    return {"fuzz": fuzz, "faults": faults, "determinism": determinism}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    subparsers = parser.add_subparsers(dest="subcommand", required=True)
    for name, module in subcommands().items():
        module.add_arguments(subparsers.add_parser(name, help=module.HELP, description=module.HELP))


def run(args: argparse.Namespace) -> int:
    code: int = subcommands()[args.subcommand].run(args)
    return code
