"""Where the scenes are, and how their files are watched."""

import hashlib
import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BUNDLED = ROOT / "data_synthetic"
COURTYARD, RING, FACADE = BUNDLED / "courtyard", BUNDLED / "ring8", BUNDLED / "facade9"
SHARED = ROOT.parent / "shared" / "data"


def real_scene(name: str) -> Path:
    """Return a real scene's folder, or skip the test: these scenes are not part of the project."""
    if not (SHARED / name).is_dir():
        pytest.skip(f"the real scene {name} is not at hand (../shared/data)")
    return SHARED / name


def copied(scene: Path, folder: Path) -> Path:
    """Return a private copy of a scene that a test may damage."""
    return Path(shutil.copytree(scene, folder / scene.name))


def fingerprint(folder: Path) -> dict[str, str]:
    """Return the hash of every file below a folder."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
