"""The program as users type it, and Python, in this process or in one of their own."""

import os
import re
import subprocess
import sys

from click.testing import Result
from typer.testing import CliRunner

from sfm_shapefit.cli import app
from tests.scenes import ROOT

_PROGRESS = re.compile(rb"^sfm-shapefit: (?!compiling).*[0-9] (?:s|min) so far\n", re.MULTILINE)
"""Lines of progress, which say nothing of a command: a machine that is slow or at work has some."""


def run(*arguments: object, code: int | None = None) -> Result:
    """Run `sfm-shapefit` with arguments of any type, and check its exit code if one is given."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    result.stderr_bytes = _PROGRESS.sub(b"", result.stderr_bytes or b"")
    result.output_bytes = _PROGRESS.sub(b"", result.output_bytes)
    assert code in (None, result.exit_code), result.output
    return result


def run_refused(*arguments: object, code: int = 3) -> str:
    """Run a command that must end with an exit code and one sentence, and return the sentence."""
    result = run(*arguments, code=code)
    assert result.stdout == ""
    assert result.stderr.startswith("sfm-shapefit: ")
    assert result.stderr.count("\n") == 1
    assert "Traceback" not in result.stderr
    return result.stderr


def run_python(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a Python that finds the package, in a process of its own; return how it ended and what it said."""
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)} | environment,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    done.stderr = re.sub(_PROGRESS.pattern.decode(), "", done.stderr, flags=re.MULTILINE)
    return done
