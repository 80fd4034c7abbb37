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
