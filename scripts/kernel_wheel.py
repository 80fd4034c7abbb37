"""Build a wheel that carries compiled kernels, `python scripts/kernel_wheel.py dist`, or take its kernels.

The wheel that hatchling makes is unpacked, `warm-up` compiles from its sources, where this checkout has not
compiled all, and what it kept becomes the package's folder `_kernels`, see `base/kernel_cache`. Machine
code and its wrapping depend on the minor versions of Python and numba, so the wheel requires those, and runs
where numba's own wheel does.

With `--take` a checkout gets what wheels have compiled of its own sources, which `scripts/setup` asks for.
"""

import argparse
import base64
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from contextlib import suppress
from importlib.metadata import distribution
from pathlib import Path

from sfm_shapefit.base.kernel_cache import PACKAGE, RUNTIME, stamp_of, write_whole
from sfm_shapefit.commands.warm_up import FURTHER, NEEDED

ROOT = Path(__file__).parents[1]
_NOTES = Path("commands")
"""Where warm-up notes the examples that are done; it has no kernels."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, nargs="?", default=ROOT / "dist", help="folder of the wheel (dist)")
    parser.add_argument("--take", action="store_true", help="take the kernels of the wheels in the folder")
    args = parser.parse_args()
    if not args.take:
        print(build(args.out))
    for wheel in sorted(args.out.glob("sfm_shapefit-*.whl")) if args.take else ():
        print(f"{wheel}: took {take(wheel, PACKAGE)} kernels")


def take(wheel: Path, package: Path) -> int:
    """Put the kernels of a wheel where a checkout keeps its own, if they are of its sources; return how many.

    None are taken of what is no wheel.
    """
    taken = 0
    with suppress(zipfile.BadZipFile), zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            place = Path(name.removeprefix("sfm_shapefit/_kernels/"))
            if place.suffix == ".nbc" and _is_of_these_sources(place):
                write_whole(package / place.parent / "__pycache__" / place.name, archive.read(name))
                taken += 1
    return taken


def build(out: Path) -> Path:
    """Build the wheel in a folder, and return it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _run("-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", folder, ROOT)
        (pure,) = folder.glob("*.whl")
        tree = folder / "tree"
        with zipfile.ZipFile(pure) as archive:
            archive.extractall(tree)
        unpacked = {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
        done = _copy_kernels(ROOT / "sfm_shapefit", tree / "sfm_shapefit")
        if not done >= {*NEEDED, *FURTHER}:
            _run("-m", "sfm_shapefit", "warm-up", **unpacked)
        made_for = _run("-c", "from sfm_shapefit.base.kernel_cache import here; print(here())", **unpacked)
        _carry_kernels(tree / "sfm_shapefit", made_for)
        (info,) = tree.glob("*.dist-info")
        tags = _adapt_metadata(info)
        out.mkdir(parents=True, exist_ok=True)
        wheel = out / f"{info.name.removesuffix('.dist-info')}-{tags}.whl"
        _pack(tree, info / "RECORD", wheel)
        return wheel


def _run(*arguments: object, **environment: str) -> str:
    """Run this Python in an environment without settings of numba's; return what it prints."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    words = [sys.executable, *map(str, arguments)]
    return subprocess.run(
        words, check=True, env=own | environment, stdout=subprocess.PIPE, text=True, cwd=ROOT / "scripts"
    ).stdout


def _copy_kernels(checkout: Path, package: Path) -> set[str]:
    """Copy what is compiled beside the sources of this checkout and not stale; return the examples done."""
    done = set()
    for file in checkout.rglob("__pycache__/*.nbc"):
        folder = file.parent.parent.relative_to(checkout)
        if _is_of_these_sources(folder / file.name):
            place = package / file.relative_to(checkout)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, place)
            done |= {file.name.partition("-")[0]} if folder == _NOTES else set()
    return done


def _is_of_these_sources(file: Path) -> bool:
    """Return whether a kernel, or the note that an example is done, holds for this checkout and this numba.

    `file` is in the folder of its source, relative to the package.
    """
    source = "examples.py" if file.parent == _NOTES else f"{file.name.partition('.')[0]}.py"
    return f"-{RUNTIME}-{stamp_of(PACKAGE / file.parent / source)}-" in file.name


def _carry_kernels(package: Path, made_for: str) -> None:
    """Move what was compiled beside the sources into the folder that the package reads."""
    kernels = package / "_kernels"
    for file in sorted(package.rglob("__pycache__/*.nbc")):
        place = kernels / file.parent.parent.relative_to(package) / file.name
        place.parent.mkdir(parents=True, exist_ok=True)
        file.rename(place)
    (kernels / "made_for.txt").write_text(made_for, encoding="utf-8")


def _adapt_metadata(info: Path) -> str:
    """State what the wheel needs: its tags, which are numba's, and numba's minor version; return the tags."""
    numba = distribution("numba")
    lines = (numba.read_text("WHEEL") or "").splitlines()
    tags = [line.removeprefix("Tag: ") for line in lines if line.startswith("Tag: ")]
    kept = [
        line for line in (info / "WHEEL").read_text().splitlines() if not line.startswith(("Root", "Tag"))
    ]
    stated = [*kept, "Root-Is-Purelib: false", *(f"Tag: {tag}" for tag in tags)]
    (info / "WHEEL").write_text("\n".join(stated) + "\n")
    metadata = (info / "METADATA").read_text(encoding="utf-8").splitlines()
    minor = ".".join(numba.version.split(".")[:2])
    needed = [f"Requires-Dist: numba=={minor}.*" if "Dist: numba" in line else line for line in metadata]
    (info / "METADATA").write_text("\n".join(needed) + "\n", encoding="utf-8")
    parts = zip(*(tag.split("-") for tag in tags), strict=True)
    return "-".join(".".join(dict.fromkeys(part)) for part in parts)


def _pack(tree: Path, record: Path, wheel: Path) -> None:
    """Write the files of a tree into a wheel, with a record of their hashes."""
    rows = []
    files = sorted(path for path in tree.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    for path in files:
        content = path.read_bytes()
        digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
        name = path.relative_to(tree).as_posix()
        rows.append(f"{name},," if path == record else f"{name},sha256={digest},{len(content)}")
    record.write_text("\n".join(rows) + "\n")
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in files:
            archive.write(path, path.relative_to(tree).as_posix())


if __name__ == "__main__":
    main()
