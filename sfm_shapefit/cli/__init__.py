"""The commands: parse, call, write. The door to typer and rich.

A module per command, under its name. Flags are the fields of the settings classes. Results go to stdout,
progress and messages to stderr.
"""

from sfm_shapefit.cli import convert, evaluate, inspect, locate, map, place, report, synth, warm_up  # noqa: A004
from sfm_shapefit.cli.app import app, main

__all__ = [
    "app",
    "convert",
    "evaluate",
    "inspect",
    "locate",
    "main",
    "map",
    "place",
    "report",
    "synth",
    "warm_up",
]
