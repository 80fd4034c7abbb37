"""scripts/kernel_wheel.py: with the wheel that it builds no command compiles, and nothing is written."""

import os
import zipfile
from pathlib import Path

import pytest

import kernel_wheel
from harness.installed import install
from tests.scenes import fingerprint

COMMANDS = """
import sys
import sfm_shapefit
from sfm_shapefit.cli import app
commands = (
    "locate data_synthetic/courtyard/sparse/0 {out}/located -q",
    "map data_synthetic/ring8/database.db {out}/mapped -q",
    "place data_synthetic/graph40.txt {out}/placed -q",
    "inspect data_synthetic/courtyard/sparse/0",
    "evaluate {out}/located data_synthetic/courtyard/truth",
)
for command in commands:
    app(command.format(out=sys.argv[1]).split(), standalone_mode=False)
print(sfm_shapefit.__file__)
"""


def clone_compiles_nothing(folder, wheel):
    """A clone that takes the kernels of a wheel has nothing to compile, nor has `warm-up`."""
    clone = install(folder)
    taken = kernel_wheel.take(wheel, clone.folder / "clone/sfm_shapefit")
    before = clone.kernels()
    assert len(before) > 100
    for command in ("locate data_synthetic/courtyard/sparse/0 {out} -q", "warm-up"):
        done = clone.run("-m", "sfm_shapefit", *command.format(out=folder / "out").split())
        assert done.returncode == 0, done.stderr
    assert "since before" in done.stdout
    assert clone.kernels() == before
    assert taken > len(before)  # the notes of examples, too


def test_nothing_is_taken_of_what_is_no_wheel_nor_of_other_sources(tmp_path):
    (tmp_path / "damaged.whl").write_bytes(b"no archive")
    with zipfile.ZipFile(tmp_path / "other.whl", "w") as archive:
        for name in ("base/losses._weigh-py311-numba0.68-0123456789ab-1.nbc", "../outside-x.nbc", "a.nbc"):
            archive.writestr(f"sfm_shapefit/_kernels/{name}", b"")
    for name in ("damaged.whl", "other.whl"):
        assert kernel_wheel.take(tmp_path / name, tmp_path / "package") == 0
    assert not (tmp_path / "package").exists()


@pytest.mark.slow
def test_with_the_wheel_no_command_compiles_and_nothing_is_written(tmp_path):
    wheel = kernel_wheel.build(Path(os.environ.get("KEEP_WHEEL_IN", tmp_path / "dist")))
    assert "none-any" not in wheel.name
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        assert not [name for name in names if "__pycache__" in name]
        assert len([name for name in names if name.startswith("sfm_shapefit/_kernels/")]) > 100
        (metadata,) = [name for name in names if name.endswith("/METADATA")]
        assert "\nRequires-Dist: numba==0." in archive.read(metadata).decode()
    clone_compiles_nothing(tmp_path / "clone", wheel)
    installed = install(tmp_path / "environment", wheel)
    # Asked of a new process: in this one another test may have had numba choose its processor.
    here = "from sfm_shapefit.base.kernel_cache import here; print(here())"
    told = installed.run("-c", here).stdout.strip()
    assert (installed.site / "sfm_shapefit/_kernels/made_for.txt").read_text().strip() == told
    for path in [installed.site, *installed.site.rglob("*")]:
        path.chmod(path.stat().st_mode & ~0o222)  # which does not stop root: what is there is compared, too
    before = fingerprint(installed.folder)
    try:
        done = installed.run("-c", COMMANDS, tmp_path / "out")
        assert done.returncode == 0, done.stderr[-500:]
        assert done.stdout.splitlines()[-1].startswith(str(installed.site))
        assert "compil" not in done.stderr
        assert fingerprint(installed.folder) == before
    finally:
        for folder, _, _ in os.walk(installed.site):
            os.chmod(folder, 0o755)
