"""Fresh environments with this package, as a clone or from a wheel, and the dependencies of this Python."""

import os
import subprocess
import sys
import venv
from dataclasses import dataclass
from pathlib import Path
from shutil import copytree, ignore_patterns

import numpy as np

from harness.driver import ROOT


@dataclass(frozen=True, slots=True)
class Installed:
    """An environment whose caches were empty when it was made."""

    folder: Path

    @property
    def site(self) -> Path:
        """The folder of its packages."""
        (found,) = self.folder.glob("lib/python*/site-packages")
        return found

    def run(self, *arguments: object) -> subprocess.CompletedProcess[str]:
        """Run its Python where the bundled data is, with a home of its own; return how it ended."""
        own = {name: value for name, value in os.environ.items() if not name.startswith(("NUMBA", "PYTHON"))}
        home = self.folder / "home"
        return subprocess.run(
            [str(self.folder / "bin" / "python"), "-P", *map(str, arguments)],  # not the package that is here
            env=own | {"HOME": str(home), "XDG_CACHE_HOME": str(home / "cache")},
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
        )

    def kernels(self) -> set[Path]:
        """Return the files of compiled kernels that its runs left."""
        files = {path for path in self.folder.rglob("*.nbc") if "_kernels" not in path.parts}
        return {path for path in files if "." in path.name.split("-py")[0]}


def install(folder: Path, wheel: Path | None = None) -> Installed:
    """Make an environment with a wheel, or with a copy of the sources here that is used where it stands."""
    venv.create(folder, symlinks=True)
    made = Installed(folder)
    (folder / "home").mkdir()
    paths = [Path(np.__file__).parents[1]]
    if wheel is None:
        clone = folder / "clone"
        copytree(ROOT / "sfm_shapefit", clone / "sfm_shapefit", ignore=ignore_patterns("__pycache__"))
        paths.insert(0, clone)
    else:
        pip = [sys.executable, "-m", "pip", "install", "-q", "--disable-pip-version-check", "--no-deps"]
        subprocess.run([*pip, "--target", str(made.site), str(wheel)], check=True)
    (made.site / "dependencies.pth").write_text("\n".join(map(str, paths)))
    return made
