"""The same answer, byte by byte, for any threads and hash seed, and for any order of the input.

Reordered input has the same images, matches and points under other ids and in another order: positions must
agree to 1e-12 of the extent.
"""

import argparse
import json
import shutil
import sqlite3
import struct
import tempfile
from contextlib import closing
from pathlib import Path

import numpy as np

from sfm_shapefit.commands.locate import locate
from sfm_shapefit.commands.write import write_result
from tests.abuse.fuzz import STAGES_OF_MAP
from tests.abuse.layouts import MODEL_FILES, binary_fields, cut_records, read_field
from tests.program import run_python
from tests.scenes import COURTYARD, FACADE, RING, rows_of

_MAX_NUM_IMAGES = 2147483647
_AGREEMENT = 1e-12
_VARIABLE = ("timings_s", "seconds", "threads")
"""Keys of JSON files whose values may differ."""


def add_arguments(parser: argparse.ArgumentParser):
    parser.add_argument("scenes", nargs="*", type=Path, help="folders with sparse/0 and, maybe, database.db")
    parser.add_argument("--orders", type=int, default=5, help="reordered copies of each scene")
    parser.add_argument("--seed", type=int, default=0)


def run(args):
    """Check all scenes and print a line for each; 1 if anything differs."""
    failed = False
    for scene in args.scenes or (RING, FACADE, COURTYARD):
        commands = [("locate", ()), ("locate", ("--adjust", "full"))]
        if (scene / "database.db").exists():
            commands += [("map", flags) for flags in STAGES_OF_MAP]
        different, worst = [], 0.0
        with tempfile.TemporaryDirectory() as work:
            for k, (command, flags) in enumerate(commands):
                files = differing_files(scene, Path(work, str(k)), command, flags)
                different += [f"{command} {' '.join(flags)}, {name}" for name in files]
            for seed in range(args.seed, args.seed + args.orders):
                worst = max(worst, measure_reordering(scene, Path(work), seed))
        failed |= bool(different) or worst > _AGREEMENT
        said = f"{len(different)} files differ {different[:3]}, reordered by {worst:.1e}"
        print(f"{scene.name}: {said}", flush=True)
    return int(failed)


def differing_files(scene, work, command="locate", always=()):
    """Yield what files differ between runs of a command with the flags `always`.

    The first has one thread and the hash seed 0; in the other everything differs that may not matter.
    """
    first = contents(_run(command, scene, work / "first", ("--threads", "1", *always), "0"))
    other = contents(_run(command, scene, work / "other", ("--threads", "3", *always), "random"))
    yield from (file for file in sorted(first | other) if first.get(file) != other.get(file))


def contents(out):
    """Return the bytes of every file of an output, and of JSON files the values that may not differ."""
    files = {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*") if path.is_file()}
    return {
        name: _lasting(json.loads(data)) if name.endswith(".json") else data for name, data in files.items()
    }


def _lasting(value):
    if isinstance(value, dict):
        return {key: _lasting(inner) for key, inner in value.items() if key not in _VARIABLE}
    return [_lasting(inner) for inner in value] if isinstance(value, list) else value


def _run(command, scene, out, flags, hash_seed):
    """Run a command on a scene, without the report, whose page shows how long each stage took."""
    source = scene / "sparse" / "0" if command == "locate" else scene / "database.db"
    out.parent.mkdir(parents=True, exist_ok=True)
    words = (command, source, out, "-q", "--no-report", *flags)
    done = run_python("-m", "sfm_shapefit.cli", *words, PYTHONHASHSEED=hash_seed)
    assert done.returncode == 0, done.stderr
    return out


def measure_reordering(scene, work, seed, *, adjust=False):
    """Return by how much of the extent positions move when everything is listed in another order.

    An adjustment ends at a tolerance, which another order of sums reaches elsewhere.
    """
    copy, out = reorder(scene, work / f"order{seed}", np.random.default_rng(seed)), work / "out"
    tables = []
    for place in (scene, copy):
        write_result(locate(place / "sparse" / "0", threads=1, adjust=adjust), out, overwrite=True)
        tables.append({row["name"]: row for row in rows_of(out / "cameras.csv")})
    shutil.rmtree(copy)
    placed = [sorted(name for name, row in table.items() if row["placed"] == "true") for table in tables]
    if placed[0] != placed[1]:
        return float("inf")
    centers = [np.array([[float(table[name][x]) for x in "xyz"] for name in placed[0]]) for table in tables]
    return float(np.abs(centers[0] - centers[1]).max() / np.linalg.norm(np.ptp(centers[0], axis=0)))


def reorder(scene, target, rng):
    """Write a copy of a scene with other image and point ids and everything listed in another order."""
    source, model = scene / "sparse" / "0", target / "sparse" / "0"
    model.mkdir(parents=True)
    data = {name: (source / f"{name}.bin").read_bytes() for name in MODEL_FILES}
    new_ids = {}
    for name, spread in (("images", 2), ("points3D", 1)):
        ids = [read_field(data[name], f) for f in binary_fields(name, data[name]) if f.meaning == "id"]
        permuted = (1 + rng.permutation(spread * len(ids)))[: len(ids)]
        new_ids[name] = dict(zip(ids, permuted.tolist(), strict=True))
    for name in MODEL_FILES:
        (model / f"{name}.bin").write_bytes(_reorder_file(name, data[name], new_ids, rng))
    if (scene / "database.db").exists():
        shutil.copyfile(scene / "database.db", target / "database.db")
        _reorder_database(target / "database.db", new_ids["images"], rng)
    return target


def _reorder_file(name, data, new_ids, rng):
    """Rename ids in a model file and shuffle its records."""
    images, points = new_ids["images"], new_ids["points3D"]
    maps = {
        "images": {"id": images, "point reference": points},
        "points3D": {"id": points, "image reference": images},
        "frames": {"image reference": images},
    }.get(name, {})
    changed = bytearray(data)
    for field in binary_fields(name, data):
        if field.meaning in maps:
            value = read_field(data, field)
            renamed = maps[field.meaning].get(value, value)  # the mark of no point stays
            struct.pack_into(f"<{field.kind}", changed, field.offset, renamed)
    records = cut_records(name, bytes(changed))
    if name not in ("cameras", "rigs"):
        records = [records[k] for k in rng.permutation(len(records)).tolist()]
    return bytes(changed[:8]) + b"".join(records)


def _reorder_database(path, image_ids, rng):
    """Rename images and list rows, matches, and the images of pairs in another order."""
    with closing(sqlite3.connect(path)) as connection, connection:
        for table in ("images", "keypoints", "two_view_geometries"):
            cursor = connection.execute(f"SELECT * FROM {table}")
            names = [column[0] for column in cursor.description]
            rows = [_renamed(dict(zip(names, row, strict=True)), image_ids, rng) for row in cursor]
            connection.execute(f"DELETE FROM {table}")
            marks = ", ".join(f":{name}" for name in names)
            shuffled = [rows[k] for k in rng.permutation(len(rows)).tolist()]
            connection.executemany(f"INSERT INTO {table} ({', '.join(names)}) VALUES ({marks})", shuffled)


def _renamed(row, image_ids, rng):
    """Return a row of an image, or of a pair, with other ids."""
    if "image_id" in row:
        return row | {"image_id": image_ids[row["image_id"]]}
    first, second = (image_ids[i] for i in divmod(row["pair_id"], _MAX_NUM_IMAGES))
    matches = np.frombuffer(row["data"] or b"", dtype="<u4").reshape(-1, 2)
    matches = rng.permutation(matches if first < second else matches[:, ::-1], axis=0)
    # Of the pair in its old order, and not read for directions.
    row |= dict.fromkeys(("F", "E", "H", "qvec", "tvec"))
    pair_id = min(first, second) * _MAX_NUM_IMAGES + max(first, second)
    return row | {"pair_id": pair_id, "data": matches.tobytes()}
