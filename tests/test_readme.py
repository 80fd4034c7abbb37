"""The README's example runs as it stands, and what it names exists."""

import os
import re
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from sfm_shapefit.cli import app
from tests.scenes import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_python_example_runs():
    (example,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", example],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert re.search(r"^25 cameras, optimal to \d\.\de-\d+$", done.stdout, flags=re.MULTILINE)
    assert float(re.search(r"median error (\S+) mm", done.stdout).group(1)) < 5.0


@pytest.mark.parametrize(
    "command", re.findall(r"^    sfm-shapefit (.+?)(?:  +#.*)?$", README, flags=re.MULTILINE)
)
def test_every_command_of_the_readme_runs(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data_synthetic").symlink_to(ROOT / "data_synthetic")
    if command.startswith("evaluate out"):
        courtyard = "data_synthetic/courtyard/sparse/0"
        assert CliRunner().invoke(app, ["locate", courtyard, "out", "-q"]).exit_code == 0
    result = CliRunner().invoke(app, command.split())
    assert result.exit_code == 0, result.output


def test_every_file_that_the_readme_points_to_exists():
    for target in re.findall(r"\]\((?!http)([^)]+)\)", README) + re.findall(
        r"^    (scripts/\S+)", README, re.MULTILINE
    ):
        assert (ROOT / target).exists(), target
