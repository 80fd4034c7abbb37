"""The same answer, byte by byte, for any threads, executor, hash seed and repetition, and any order of input.

Reordered input has the same images, matches and points under other ids and in another order: positions must
agree to 1e-12 of the extent.
"""

import argparse
import json
import os
import shutil
import sqlite3
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.random import Generator

from abuse import strangers
from abuse.layouts import binary_fields, cut_records, read_field
from abuse.verdicts import MODEL_FILES, read_cameras
from harness.record import leave_out
from sfm_shapefit.facts.options import Adjust

HELP = "byte-identical output for threads, hash seeds and repetition; the same positions for reordered input"
_PROJECT = Path(__file__).resolve().parents[2]
_MAX_NUM_IMAGES = 2147483647
_AGREEMENT = 1e-12


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenes", nargs="*", type=Path, help="folders with sparse/0 and, maybe, database.db")
    parser.add_argument("--orders", type=int, default=5, help="reordered copies of each scene")
    parser.add_argument("--seed", type=int, default=0)


def run(args: argparse.Namespace) -> int:
    """Check all scenes and print a table; 1 if anything differs."""
    bundled = _PROJECT / "data_synthetic"
    scenes = args.scenes or [bundled / name for name in ("ring8", "facade9", "courtyard")]
    failed = False
    for scene in scenes:
        with tempfile.TemporaryDirectory() as temporary:
            work = Path(temporary)
            different = list(differing_files(scene, work))
            adjusted = differing_files(scene, work / "adjusted", always=("--adjust", "full"))
            different += [f"adjusted, {name}" for name in adjusted]
            for flags in strangers.STAGES_OF_MAP if (scene / "database.db").exists() else ():
                mapped = differing_files(scene, work / "map", command="map", always=flags)
                different += [f"map {' '.join(flags)}, {name}" for name in mapped]
                shutil.rmtree(work / "map")
            worst = max(
                (measure_reordering(scene, work, seed) for seed in range(args.seed, args.seed + args.orders)),
                default=0.0,
            )
        failed |= bool(different) or worst > _AGREEMENT
        print(
            f"{scene.name}: {len(different)} files differ {different[:3]}, reordered by {worst:.1e}",
            flush=True,
        )
    return int(failed)


VARIANTS: dict[str, tuple[tuple[str, ...], dict[str, str]]] = {
    "again, by two threads, hash seed 4242": (("--threads", "2"), {"PYTHONHASHSEED": "4242"}),
    "two processes": (("--threads", "2", "--executor", "processes"), {"PYTHONHASHSEED": "random"}),
}
"""What differs from the first run, by one thread and with hash seed 0: all at once, as none may matter."""


def differing_files(
    scene: Path, work: Path, command: str = "locate", always: tuple[str, ...] = ()
) -> Iterator[str]:
    """Yield which file differs in which variant of the run, of those that the command has.

    All runs have the flags `always`.
    """
    once = {"PYTHONHASHSEED": "0"}
    first = contents(_run(command, scene, work / "first", ("--threads", "1", *always), once))
    for name, (flags, environment) in VARIANTS.items():
        if command == "map" and "--executor" in flags:
            continue
        other = contents(_run(command, scene, work / "other", (*flags, *always), environment))
        yield from (f"{name}: {file}" for file in sorted(first | other) if first.get(file) != other.get(file))
        shutil.rmtree(work / "other")


def contents(out: Path) -> dict[str, object]:
    """Return the bytes of every file of an output, and of JSON files all but times and threads."""
    return {
        str(path.relative_to(out)): leave_out(
            ("timings_s", "seconds", "threads"), json.loads(path.read_bytes())
        )
        if path.suffix == ".json"
        else path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file()
    }


def _run(command: str, scene: Path, out: Path, flags: tuple[str, ...], environment: dict[str, str]) -> Path:
    """Run a command on a scene, without the report, whose page shows how long each stage took."""
    source = scene / "sparse" / "0" if command == "locate" else scene / "database.db"
    out.parent.mkdir(parents=True, exist_ok=True)
    words = (command, str(source), str(out), "-q", "--no-report", *flags)
    subprocess.run(
        [sys.executable, "-m", "sfm_shapefit.cli", *words],
        env={**os.environ, "PYTHONPATH": str(_PROJECT), **environment},
        cwd=_PROJECT,
        check=True,
    )
    return out


def measure_reordering(scene: Path, work: Path, seed: int, *, adjust: Adjust = "none") -> float:
    """Return by how much of the extent positions move when everything is listed in another order.

    An adjustment ends at a tolerance, which another order of sums reaches elsewhere.
    """
    from sfm_shapefit.facts.options import LocateOptions
    from sfm_shapefit.pipeline.locate import locate
    from sfm_shapefit.pipeline.write import write_result

    copy = reorder(scene, work / f"order{seed}", np.random.default_rng(seed))
    tables = []
    for place in (scene, copy):
        out = work / "out"
        options = LocateOptions(threads=1, adjust=adjust)
        write_result(locate(place / "sparse" / "0", options=options), out, overwrite=True)
        tables.append({row["name"]: row for row in read_cameras(out)})
    shutil.rmtree(copy)
    shutil.rmtree(out)
    if [row["placed"] for row in tables[0].values()] != [tables[1][name]["placed"] for name in tables[0]]:
        return float("inf")
    names = [name for name, row in tables[0].items() if row["placed"] == "true"]
    centers = [np.array([[float(table[name][axis]) for axis in "xyz"] for name in names]) for table in tables]
    extent = np.linalg.norm(np.ptp(centers[0], axis=0))
    return float(np.abs(centers[0] - centers[1]).max() / extent)


def reorder(scene: Path, target: Path, rng: Generator) -> Path:
    """Write a copy of a scene with other image and point ids and everything listed in another order."""
    source, model = scene / "sparse" / "0", target / "sparse" / "0"
    model.mkdir(parents=True)
    data = {name: (source / f"{name}.bin").read_bytes() for name in MODEL_FILES}
    images, points = (
        [read_field(data[name], field) for field in binary_fields(name, data[name]) if field.meaning == "id"]
        for name in ("images", "points3D")
    )
    image_ids = dict(zip(images, (1 + rng.permutation(2 * len(images)))[: len(images)].tolist(), strict=True))
    point_ids = dict(zip(points, (1 + rng.permutation(len(points))).tolist(), strict=True))
    for name in MODEL_FILES:
        (model / f"{name}.bin").write_bytes(_reorder_file(name, data[name], image_ids, point_ids, rng))
    if (scene / "database.db").exists():
        _reorder_database(scene / "database.db", target / "database.db", image_ids, rng)
    return target


def _reorder_file(
    name: str, data: bytes, image_ids: dict[int, int], point_ids: dict[int, int], rng: Generator
) -> bytes:
    """Rename ids in a model file and shuffle its records."""
    maps = {
        ("images", "id"): image_ids,
        ("images", "point reference"): point_ids,
        ("points3D", "id"): point_ids,
        ("points3D", "image reference"): image_ids,
        ("frames", "image reference"): image_ids,
    }
    changed = bytearray(data)
    for field in binary_fields(name, data):
        if (name, field.meaning) in maps:
            value = read_field(data, field)
            renamed = maps[name, field.meaning].get(value, value)  # no point: stays
            struct.pack_into(f"<{field.kind}", changed, field.offset, renamed)
    records = cut_records(name, bytes(changed))
    if name not in ("cameras", "rigs"):
        records = [records[int(k)] for k in rng.permutation(len(records))]
    return bytes(changed[:8]) + b"".join(records)


def _reorder_database(source: Path, target: Path, image_ids: dict[int, int], rng: Generator) -> None:
    """Rename images in a database and list rows, matches, and the images of pairs in another order."""
    shutil.copyfile(source, target)
    with closing(sqlite3.connect(target)) as connection:
        tables = {}
        for table in ("images", "keypoints", "two_view_geometries"):
            cursor = connection.execute(f"SELECT * FROM {table}")
            names = [column[0] for column in cursor.description]
            tables[table] = [dict(zip(names, row, strict=True)) for row in cursor]
            connection.execute(f"DELETE FROM {table}")
        for row in (*tables["images"], *tables["keypoints"]):
            row["image_id"] = image_ids[row["image_id"]]
        for row in tables["two_view_geometries"]:
            first, second = (image_ids[i] for i in divmod(row["pair_id"], _MAX_NUM_IMAGES))
            row["pair_id"] = min(first, second) * _MAX_NUM_IMAGES + max(first, second)
            matches = np.frombuffer(row["data"] or b"", dtype="<u4").reshape(-1, 2)
            row["data"] = rng.permutation(matches if first < second else matches[:, ::-1], axis=0).tobytes()
            # Of the pair in its old order, and not read for directions.
            row.update(dict.fromkeys(("F", "E", "H", "qvec", "tvec")))
        for table, rows in tables.items():
            for k in rng.permutation(len(rows)):
                row = rows[int(k)]
                marks = ", ".join("?" * len(row))
                connection.execute(
                    f"INSERT INTO {table} ({', '.join(row)}) VALUES ({marks})", [*row.values()]
                )
        connection.commit()
