"""The program as users type it, run in this process."""

from click.testing import Result
from typer.testing import CliRunner

from sfm_shapefit.cli import app


def run(*arguments: object, code: int | None = None) -> Result:
    """Run `sfm-shapefit` with arguments of any type, and check its exit code if one is given."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert code in (None, result.exit_code), result.output
    return result
