"""The commands: parse, call, write. The door to typer and rich.

A module per command, under its name. Flags are the fields of the settings classes. Results go to stdout,
progress and messages to stderr.
"""

import os

# One thread does all that is large in BLAS (`laplacian.dense`): its others would wait, and keep a core busy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

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
