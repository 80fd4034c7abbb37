"""Run every command once with the oldest versions that pyproject.toml allows.

    python scripts/lower_bounds.py

They are installed into a fresh environment in a temporary folder, for the Python that runs this, best 3.11.
It takes minutes, since all kernels are compiled there, and is no part of the gate.
"""

import os
import subprocess
import sys
import tempfile
import tomllib
import venv
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]


def lowest(text: str) -> str:
    """Return a requirement of the very version that is its lower bound."""
    requirement = Requirement(text)
    (bound,) = (one.version for one in requirement.specifier if one.operator == ">=")
    return f"{requirement.name}=={bound}"


def main() -> None:
    """Install, and run every command."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    with tempfile.TemporaryDirectory(prefix="lower-bounds-") as name:
        folder = Path(name)
        venv.create(folder / "venv", with_pip=True)
        python = folder / "venv" / "bin" / "python"
        environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "kernels")}
        pins = [lowest(text) for text in project["dependencies"]]
        for command in (
            ("-m", "pip", "install", "--quiet", *pins, str(ROOT)),
            ("-m", "pip", "freeze"),
            ("-m", "sfm_shapefit.cli", "warm-up"),
            ("-m", "tests.every_command", str(folder / "out")),
        ):
            print("python", *command, flush=True)
            subprocess.run([python, *command], cwd=ROOT, env=environment, check=True)


if __name__ == "__main__":
    sys.exit(main())
