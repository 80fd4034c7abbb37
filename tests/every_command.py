"""Run every command once; end with 1 if one fails or a kernel was compiled, and name it.

    python -m tests.every_command OUT

The gate runs it after `warm-up`, which must have compiled everything.
"""

import sys
from pathlib import Path

from numba.core import event as events

from sfm_shapefit.cli import app

COMMANDS = """
    locate data_synthetic/courtyard/sparse/0 {out}/located -q
    locate data_synthetic/ring8/sparse/0 {out}/adjusted --adjust full -q
    evaluate {out}/located data_synthetic/courtyard/truth
    inspect data_synthetic/courtyard/sparse/0
    solve data_synthetic/graph40.txt {out}/solved -q
    solve data_synthetic/graph40.txt {out}/split --config {admm} -q
    map data_synthetic/ring8/database.db {out}/mapped -q
    map data_synthetic/courtyard/database.db {out}/mapped_and_adjusted --adjust full -q
    locate data_synthetic/ring8/sparse/0 {out}/fixed --fix data_synthetic/names.txt -q
    map data_synthetic/ring8/database.db {out}/halves --without data_synthetic/across.txt -q
    join {out}/halves/0 {out}/halves/1 {out}/whole --database data_synthetic/ring8/database.db -q
    check {out}/located --report {out}/check.html
    convert {out}/located {out}/scene.glb -q
    convert {out}/located {out}/transforms.json -q
    locate {out}/transforms.json {out}/exact --database data_synthetic/courtyard/database.db --rotations 2 -q
    synth {out}/drive --shape drive --num-images 6 --num-points 300
    inspect data_synthetic/ring8/sparse/0
    place data_synthetic/graph40.txt {out}/lud --objective lud -q
"""


class Names(events.Listener):
    """Hears of kernels that are compiled."""

    def __init__(self):
        self.compiled = []

    def on_start(self, event):
        self.compiled.append(event.data["dispatcher"].py_func.__qualname__)

    def on_end(self, event):
        pass


if __name__ == "__main__":
    names = Names()
    admm = Path(sys.argv[1] + ".toml")
    admm.write_text('solver = "admm"', encoding="utf-8")
    with events.install_listener("numba:compile", names):
        for command in COMMANDS.format(out=sys.argv[1], admm=admm).strip().splitlines():
            if app(command.split(), standalone_mode=False):
                sys.exit(f"failed: {command}")
    if names.compiled:
        sys.exit(f"compiled: {' '.join(names.compiled)}")
