"""Print the lock file of CI anew: `python scripts/lock.py > ci.lock`, where the gate has passed.

It is the closure of the base and the dev extra over what is installed, for this Python and system.
"""

import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

HEADER = """\
# What the gate (.ci/run) installs: every package of the base and the dev extra at the version tested with.
# A constraints file for CPython 3.11 on Linux; users install by the ranges of pyproject.toml.
# Made by scripts/lock.py; to renew it, install the newest, run the gate, run that."""


def closure(wanted: list[Requirement]) -> dict[str, str]:
    """Return the versions of all packages that these need, themselves included, by name.

    Raises:
        ValueError: if an installed version is not one that is asked for.
    """
    versions: dict[str, str] = {}
    open_ends, done = [*wanted], set()
    while open_ends:
        requirement = open_ends.pop()
        name = canonicalize_name(requirement.name)
        versions[name] = distribution(name).version
        if not requirement.specifier.contains(versions[name], prereleases=True):
            raise ValueError(f"{versions[name]} is installed, but {requirement} is asked for")
        fresh = {(name, extra) for extra in ("", *requirement.extras)} - done
        done |= fresh
        open_ends += [need for _, extra in sorted(fresh) for need in needs(name, extra)]
    return versions


def needs(name: str, extra: str) -> Iterator[Requirement]:
    """Yield what an installed package, or one extra of it, needs on this Python and system."""
    for text in distribution(name).requires or []:
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
            yield requirement


def main() -> int:
    path = Path(__file__).resolve().parents[1] / "pyproject.toml"
    project = tomllib.loads(path.read_text(encoding="utf-8"))["project"]
    wanted = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    versions = closure([Requirement(text) for text in wanted])
    print(HEADER, *(f"{name}=={versions[name]}" for name in sorted(versions)), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
