"""The commands: parse, call, write. The door to typer and rich.

A module per command. Flags are the fields of the options dataclasses. Results go to stdout, progress and
messages to stderr.
"""

from sfm_shapefit.cli import convert as conversion
from sfm_shapefit.cli import evaluate, locate, synth
from sfm_shapefit.cli import inspect as inspection
from sfm_shapefit.cli import map as mapping
from sfm_shapefit.cli import place as solve
from sfm_shapefit.cli import report as pictures
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
