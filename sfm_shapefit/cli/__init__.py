"""The commands: parse, call, write. The door to typer and rich.

A module per command, under its name. Flags are the fields of the settings classes. Results go to stdout,
progress and messages to stderr.
"""

import os
import sys
from typing import TYPE_CHECKING, Any

# One thread does all that is large in BLAS (`laplacian.dense`): its others would wait, and keep a core busy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

if TYPE_CHECKING:
    from sfm_shapefit.cli.root import app

__all__ = ["app", "main"]


def main() -> None:
    """Run the command line; an interrupt while typer is loaded, the first tenths of a second, ends it too."""
    try:
        from sfm_shapefit.cli import root
    except KeyboardInterrupt:
        sys.exit(130)  # as `console` has it, which is not loaded yet
    root.run_command()


def __getattr__(name: str) -> Any:
    """Return the `app` with all its commands; the program itself loads the one that is called."""
    if name == "app":
        from sfm_shapefit.cli import root

        root.load_commands()
        return root.app
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
