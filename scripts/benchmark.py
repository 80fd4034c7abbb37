"""Benchmarks of sfm_shapefit: `python scripts/benchmark.py real --help`; scripts/README.md lists them."""

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module

from benchmarks import INDEX


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    subparsers = parser.add_subparsers(dest="name", required=True)
    words = sys.argv[1:] if argv is None else list(argv)
    for name, purpose in INDEX.items():
        shown = purpose.replace("%", "%%")  # argparse takes a bare one for a format
        subparser = subparsers.add_parser(name, help=shown, description=shown)
        if words and words[0] == name:
            # Only the module that is asked for is loaded: another may need what it does not.
            module = import_module(f"benchmarks.{name}")
            command = getattr(module, "BENCHMARK", module)
            command.add_arguments(subparser)
    args = parser.parse_args(words)
    code: int = command.run(args)
    return code


if __name__ == "__main__":
    sys.exit(main())
