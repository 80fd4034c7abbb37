"""What every command answers, recorded, and compared with an earlier recording.

For changes of the code that shall change no answer. Commands run as processes of their own, so that nothing
is known here of how the package is built, and a recording of one checkout can be compared with another's:

    python scripts/benchmark.py answers --package OTHER/CHECKOUT --out old.json.gz
    python scripts/benchmark.py answers --out new.json.gz --against old.json.gz

Of each run are kept: the exit code and the last line of stderr; poses of every model that was written, and
the tables, JSON objects and texts beside it; what was printed, without its numbers. Times, forecasts and
versions are left out, and paths are those below a temporary folder.
"""

import argparse
import csv
import gzip
import hashlib
import json
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from benchmarks.answer_cases import BUNDLED, Case, all_cases
from benchmarks.answer_differences import compare, report
from benchmarks.answer_inputs import MADE, MADRID, make_inputs
from harness.driver import DATA, ROOT
from harness.record import leave_out

LIMIT_S = 300
"""Seconds after which a case is ended; its exit code is then recorded as "timeout"."""
_VARIABLE = {"timings_s", "seconds", "versions", "expected"}
"""Keys of JSON objects that are not kept, wherever they stand."""
_PAIR_COLUMNS = {"name1", "name2", "support", "residual_deg", "verdict", "reason"}
_NUMBER = re.compile(r"[-+]?\d[\d.,]*(e[-+]?\d+)?")
_BORDERS = re.compile(r"[\s\u2500-\u257f|+]+")
_MODEL_FILES = {f"{stem}.txt" for stem in ("cameras", "images", "points3D", "rigs", "frames")}

Answer = dict[str, Any]


class Runner(NamedTuple):
    """Runs commands of one checkout in the folder of the inputs."""

    package: Path
    work: Path

    def ask(self, case: Case) -> dict[str, Answer]:
        """Return the answers of a case and of those that follow it, by name."""
        answers = {case.name: self._answer(case)}
        for follower in case.followers:
            answers[follower.name] = self._answer(follower)
        for out in {c.out for c in (case, *case.followers)} - {""}:
            shutil.rmtree(self.work / out, ignore_errors=True)
        return answers

    def _answer(self, case: Case) -> Answer:
        start = time.perf_counter()
        code, stdout, stderr = self.run([sys.executable, "-m", "sfm_shapefit.cli", *case.argv])
        said = [line for line in stderr.splitlines() if line.strip()]
        answer = {"exit": code, "said": said[-1] if said else "", "files": [], "printed": ""}
        answer |= {"models": {}, "tables": {}, "json": {}, "texts": {}}
        if stdout.startswith("{"):
            answer["json"]["stdout"] = leave_out(_VARIABLE, json.loads(stdout))
        else:
            printed = stdout.replace(f"{self.work}/", "")
            answer["printed"] = _NUMBER.sub("#", _BORDERS.sub(" ", printed)).strip()
        if case.out and (self.work / case.out).exists():
            _collect(self.work / case.out, answer)
        text = json.dumps(answer).replace(f"{self.work}/", "")
        return {**json.loads(text), "seconds": round(time.perf_counter() - start, 1)}

    def run(self, command: list[str]) -> tuple[int | str, str, str]:
        """Run a command in a process group of its own; return its exit code, stdout and stderr."""
        process = subprocess.Popen(
            command,
            cwd=self.work,
            env={**os.environ, "PYTHONPATH": str(self.package), "COLUMNS": "1000", "NO_COLOR": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            stdin=subprocess.DEVNULL,
            encoding="utf-8",
            start_new_session=True,
        )
        try:
            stdout, stderr = process.communicate(timeout=LIMIT_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            return "timeout", "", ""
        return process.returncode, stdout, stderr

    def check(self) -> None:
        """Refuse if another package than that of the checkout would run."""
        code = "import sfm_shapefit; print(sfm_shapefit.__file__)"
        _, stdout, stderr = self.run([sys.executable, "-c", code])
        if not Path(stdout.strip()).is_relative_to(self.package) or not stdout.strip():
            raise SystemExit(
                f"{self.package} has no package sfm_shapefit that can be loaded: {stderr}{stdout}"
            )


def _collect(out: Path, answer: Answer) -> None:
    """Add what was written to an answer, file by file."""
    files = sorted(path for path in (out.rglob("*") if out.is_dir() else [out]) if path.is_file())
    for path in files:
        key = path.relative_to(out if out.is_dir() else out.parent).as_posix()
        answer["files"].append(key)
        if path.stem == "images" and path.suffix in (".bin", ".txt"):
            answer["models"][Path(key).parent.as_posix()] = _model(path.parent)
        elif path.suffix == ".csv":
            answer["tables"][key] = _table(path)
        elif path.suffix == ".json":
            answer["json"][key] = leave_out(_VARIABLE, json.loads(path.read_text(encoding="utf-8")))
        elif path.suffix == ".db":
            answer["texts"][key] = _digest(path)
        elif path.suffix in (".txt", ".tum", ".g2o") and path.name not in _MODEL_FILES:
            answer["texts"][key] = path.read_text(encoding="utf-8").split()


def _model(folder: Path) -> dict[str, Any]:
    """Return the poses of a model by image name, center and quaternion, and figures of its points."""
    model = pycolmap.Reconstruction(folder)
    posed = {image.name: image for image in model.images.values() if image.has_pose}
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    return {
        "poses": {
            name: [
                *posed[name].projection_center().tolist(),
                *posed[name].cam_from_world().rotation.quat.tolist(),
            ]
            for name in sorted(posed)
        },
        "structure": {
            "images": len(model.images),
            "points": len(points),
            "observations": model.compute_num_observations(),
            "mean_distance": float(np.linalg.norm(points, axis=1).mean()) if len(points) else 0.0,
            "reprojection_px": model.compute_mean_reprojection_error(),
            "intrinsics": [model.camera(k).params.tolist() for k in sorted(model.cameras)],
        },
    }


def _table(path: Path) -> dict[str, list[str]]:
    """Return the columns of a table, numbers as they are written."""
    with path.open(encoding="utf-8", newline="") as stream:
        header, *rows = csv.reader(stream)
    columns = {name: [row[k] for row in rows] for k, name in enumerate(header)}
    return {k: v for k, v in columns.items() if path.name != "pairs.csv" or k in _PAIR_COLUMNS}


def _digest(path: Path) -> str:
    """Return a hash of all rows of a database."""
    connection = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    lines = "\n".join(connection.iterdump())
    connection.close()
    return hashlib.sha256(lines.encode()).hexdigest()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, help="file of the recording, .json.gz")
    parser.add_argument("--against", type=Path, help="earlier recording to compare with")
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--quick", action="store_true", help="a few cases on bundled scenes")
    parser.add_argument("--jobs", type=int, default=2, help="cases side by side")
    parser.add_argument("--package", type=Path, default=ROOT, help="root of the checkout whose code runs")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the real sets")


def run(args: argparse.Namespace) -> int:
    old = _read(args.against) if args.against else None
    recorded = record(args.package, args.data, only=args.only, quick=args.quick, jobs=args.jobs)
    _write(args.out, recorded)
    if old is None:
        return 0
    text, is_equal = compare_recordings(old, recorded)
    print(text)
    return 0 if is_equal else 1


def record(
    package: Path, data: Path, *, only: str = "", quick: bool = False, jobs: int = 2
) -> dict[str, Any]:
    """Run the cases and return their answers by name, and the names of those whose set is missing."""
    folders = _folders(data)
    chosen = [
        case
        for case in all_cases(folders)
        if any(only in c.name for c in (case, *case.followers)) and (case.quick or not quick)
    ]
    missing = [c for c in chosen if c.scene and c.scene not in (*folders, *MADE)]
    present = [c for c in chosen if c not in missing]
    for case in missing:
        print(f"{case.name}: skipped, {case.scene} is not at hand", file=sys.stderr)
    answers: dict[str, Answer] = {}
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(jobs) as pool:
        runner = Runner(package.resolve(), Path(name).resolve())
        runner.check()
        wanted = {*BUNDLED, *(case.scene for case in present)}
        make_inputs(runner.work, {name: folders[name] for name in folders if name in wanted})
        for found in pool.map(runner.ask, present):
            answers |= found
            print(
                *(f"{k}: {a['exit']}, {a['seconds']} s" for k, a in found.items()), sep="; ", file=sys.stderr
            )
    return {"answers": answers, "skipped": [case.name for case in missing]}


def _folders(data: Path) -> dict[str, Path]:
    """Return the folders of scenes and sets that are at hand, by name."""
    found = {name: ROOT / "data_synthetic" / name for name in BUNDLED}
    for folder in sorted(data.glob("*")):
        if folder.name == MADRID or all((folder / part).exists() for part in ("sparse/0", "database.db")):
            found[folder.name] = folder
    return found


def compare_recordings(old: dict[str, Any], new: dict[str, Any]) -> tuple[str, bool]:
    """Return what is to be said of two recordings, and whether the cases that both have are equal."""
    before, now = old["answers"], new["answers"]
    differences = {name: compare(before[name], now[name]) for name in now if name in before}
    text, is_equal = report(differences)
    for words, alone in (("only before", before.keys() - now), ("only now", now.keys() - before)):
        text += f"\n{words}, not compared: {len(alone)} cases, {sorted(alone)[:5]}" if alone else ""
    return text, is_equal and bool(differences)


def _read(path: Path) -> dict[str, Any]:
    with gzip.open(path, "rt", encoding="utf-8") as stream:
        found: dict[str, Any] = json.load(stream)
    return found


def _write(path: Path, recorded: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with gzip.open(path, "wt", encoding="utf-8") as stream:
        json.dump(recorded, stream)
    count, skipped = len(recorded["answers"]), len(recorded["skipped"])
    print(f"{count} cases recorded, {skipped} skipped{': ' * bool(skipped)}{', '.join(recorded['skipped'])}")
