"""Damage to what other programs and people write: their models, databases without a model, tables beside.

Each function takes the folder of sound files, that of a case, and a generator. The sound files in `samples`
are the fuzzer's own scene as openMVG, OpenSfM and Bundler would write it, a bare graph, position priors,
names of images that stay, and options.
"""

import json
import shutil
import sqlite3
import struct
from contextlib import closing
from pathlib import Path
from typing import Any

from numpy.random import Generator

from abuse import databases, mutations
from abuse.mutations import Case

SAMPLES = Path(__file__).with_name("samples")
_MODELS = {
    "openmvg/sfm_data.json": (),
    "opensfm/reconstruction.json": ("opensfm/tracks.csv",),
    "bundler/bundle.out": ("bundler/list.txt",),
}
"""Files of other programs, and what stands beside them."""
_TABLES = {"priors.txt": "--priors", "fix.txt": "--fix", "options.toml": "--config"}
_CAMERA_COLUMNS = ("camera_id", "model", "width", "height", "params", "prior_focal_length")
STAGES_OF_MAP = ((), ("--adjust", "full"), ("--adjust", "none"))
"""Flags of `map` that choose among its stages."""


def damage_stranger(base: Path, folder: Path, rng: Generator) -> Case:
    """A damaged model of another program, or a damaged list beside it."""
    source = str(mutations.pick(rng, sorted(_MODELS)))
    shutil.copytree((base / source).parent, (folder / source).parent)
    target = str(mutations.pick(rng, (source, source, *_MODELS[source])))
    path = folder / target
    if path.suffix == ".json" and rng.random() < 0.8:
        label = "json"
        path.write_bytes(_change_json(path.read_bytes(), rng))
    else:
        label = mutations.damage_text(path, rng)
    commands = (
        *[("locate", source, "out", "--threads", "1")] * 3,
        *(("convert", source, out) for out in ("out", "out.json", "out.csv")),
        *(("inspect", source), ("evaluate", source, "truth")),
    )
    command = mutations.pick(rng, commands)
    if command[0] == "evaluate":
        shutil.copytree(base / "truth", folder / "truth")
    return Case(f"stranger: {target} {label}", command)


def damage_database(base: Path, folder: Path, rng: Generator) -> Case:
    """A damaged database alone, from which `map` takes cameras and rotations too."""
    shutil.copyfile(base / "database.db", folder / "database.db")
    way = mutations.pick(rng, (*databases.WAYS, odd_cameras, odd_cameras, odd_cameras))
    way(folder / "database.db", rng)
    stages = mutations.pick(rng, STAGES_OF_MAP)
    return Case(f"map: {way.__name__}", ("map", "database.db", "out", *stages, "--threads", "1"))


def odd_cameras(path: Path, rng: Generator) -> bool:
    """Change the intrinsics in a database: their type, their values, their number."""
    column = str(mutations.pick(rng, (*_CAMERA_COLUMNS, "params", "params")))
    doubles = [struct.pack("<d", value) for value in mutations.DOUBLES]
    value = mutations.pick(rng, databases.ODD_VALUES)
    with closing(sqlite3.connect(path)) as connection:
        (params,) = connection.execute("SELECT params FROM cameras").fetchone()
        if column == "params" and rng.random() < 0.7:
            at = 8 * int(rng.integers(len(params) // 8))
            value = params[:at] + bytes(mutations.pick(rng, doubles)) + params[at + 8 :]
            if rng.random() < 0.2:
                value = value[: int(rng.integers(len(value)))]
        names = ", ".join(_CAMERA_COLUMNS)
        connection.execute(f"CREATE TABLE untyped ({names})")
        connection.execute(f"INSERT INTO untyped SELECT {names} FROM cameras")
        connection.execute("DROP TABLE cameras")
        connection.execute("ALTER TABLE untyped RENAME TO cameras")
        connection.execute(f"UPDATE cameras SET {column} = ?", (value,))
        if rng.random() < 0.1:
            connection.execute("INSERT INTO cameras SELECT * FROM cameras")
        connection.commit()
    return False


def damage_table(base: Path, folder: Path, rng: Generator) -> Case:
    """A damaged table of priors, of names or of options beside a sound model."""
    name = str(mutations.pick(rng, sorted(_TABLES)))
    shutil.copytree(base / "sparse", folder / "sparse")
    for sound in ("database.db", name):
        shutil.copyfile(base / sound, folder / sound)
    way = mutations.damage_text(folder / name, rng)
    refine = ("--refine-with-priors",) if name == "priors.txt" and rng.random() < 0.5 else ()
    arguments = ("locate", "sparse/0", "out", "--database", "database.db", _TABLES[name], name, *refine)
    threads = () if name == "options.toml" else ("--threads", "1")
    return Case(f"table: {name} {way}", (*arguments, *threads))


def _change_json(data: bytes, rng: Generator) -> bytes:
    """Replace, remove or repeat one to three values somewhere in a JSON file."""
    content = json.loads(data)
    for _ in range(int(rng.integers(1, 4))):
        holder, key = _random_place(content, rng)
        if rng.random() < 0.25:
            del holder[key]
        else:
            odd = (None, True, [], {}, [[]], *mutations.INTEGERS, *mutations.DOUBLES, *mutations.WORDS)
            holder[key] = mutations.pick(rng, (*odd, [holder[key]] * 2))
        if not content:
            break
    return json.dumps(content).encode("utf-8", errors="surrogatepass")


def _random_place(content: Any, rng: Generator) -> tuple[Any, Any]:
    """Return a container inside a JSON value and one of its keys or indices, found by a walk down."""
    holder = content
    while True:
        keys = [*holder] if isinstance(holder, dict) else [*range(len(holder))]
        key = mutations.pick(rng, keys)
        below = holder[key]
        if not isinstance(below, dict | list) or not below or rng.random() < 0.15:
            return holder, key
        holder = below
