"""The commands: parse, call, write. The door to typer and rich.

A module per command. Flags are the fields of the options dataclasses. Results go to stdout, progress and
messages to stderr.
"""

from sfm_shapefit.cli import (
    conversion,
    evaluate,
    inspection,
    locate,
    mapping,
    pictures,
    solve,
    synth,
)
from sfm_shapefit.cli.app import app, main

__all__ = [
    "app",
    "conversion",
    "evaluate",
    "inspection",
    "locate",
    "main",
    "mapping",
    "pictures",
    "solve",
    "synth",
]
