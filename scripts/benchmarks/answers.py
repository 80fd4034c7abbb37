"""What every command answers, recorded, and compared with an earlier recording.

For changes of the code that shall change no answer. Commands run as processes of their own, so that nothing
is known here of how the package is built, and a recording of one checkout can be compared with another's:

    python scripts/benchmark.py answers --package OTHER/CHECKOUT --out old.json.gz
    python scripts/benchmark.py answers --out new.json.gz --against old.json.gz

Answers are written one by one, and --resume continues a recording that was interrupted.

Of each run are kept: the exit code, the verdict and the last line of stderr; poses of every model that was
written, and the tables, JSON objects and texts beside it; what was printed, without its numbers; peak memory
and CPU time. Paths are those below a temporary folder. What counts as equal stands in `answer_differences`.
"""

import argparse
import base64
import contextlib
import csv
import gzip
import hashlib
import json
import math
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from benchmarks.answer_cases import BUNDLED, Case, all_cases
from benchmarks.answer_differences import compare, compare_use, report
from benchmarks.answer_inputs import MADE, MADRID, make_inputs
from harness.driver import DATA, ROOT
from harness.process import thread_environment

LIMIT_CPU_S, LIMIT_S = 300, 1200
"""Seconds of CPU time, and of waiting, after which a case is ended; its exit code is then "timeout"."""
_USAGE = """
import json, os, resource, sys
out, limit, *command = sys.argv[1:]
process = os.fork()
if process == 0:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (int(limit), int(limit) + 5))
    os.execv(command[0], command)
_, status, used = os.wait4(process, 0)
code = os.waitstatus_to_exitcode(status)
json.dump([code, used.ru_maxrss * 1024 / 1e6, used.ru_utime + used.ru_stime], open(out, "w"))
"""
"""Runs a command and writes its exit code, peak memory (10^6 bytes) and CPU seconds.

A process's peak, as the system tells it, begins with that of its parent, which is therefore a small process.
"""
_PAIR_COLUMNS = {"name1", "name2", "support", "residual_deg", "verdict", "reason"}
_KEY = re.compile(r"[a-z_]+=")
_NUMBER = re.compile(r"[-+]?\d[\d.,]*(e[-+]?\d+)?")
_BORDERS = re.compile(r"[\s\u2500-\u257f|+]+")
_MODEL_FILES = {f"{stem}.txt" for stem in ("cameras", "images", "points3D", "rigs", "frames")}

Answer = dict[str, Any]


class Run(NamedTuple):
    """What a process left."""

    code: int | str
    stdout: str
    stderr: str
    memory_mb: float
    """Peak of the process, or of the largest that it started."""
    cpu_s: float


class Runner:
    """Runs commands of one checkout in the folder of the inputs."""

    def __init__(self, package: Path, work: Path) -> None:
        self.package, self.work = package, work

    def ask(self, case: Case) -> dict[str, Answer]:
        """Return the answers of a case and of those that follow it, by name."""
        answers = {case.name: self._answer(case)}
        for follower in case.followers:
            answers[follower.name] = self._answer(follower)
        for out in {c.out for c in (case, *case.followers)} - {""}:
            shutil.rmtree(self.work / out, ignore_errors=True)
            (self.work / out).unlink(missing_ok=True)
        return answers

    def _answer(self, case: Case) -> Answer:
        words = [word for word in case.argv if not _KEY.match(word)]
        keys = [word.partition("=") for word in case.argv if _KEY.match(word)]
        if keys:
            told = self.work / f"told-{case.name.replace('/', '-')}.toml"
            told.write_text("".join(f"{key} = {_toml(value)}\n" for key, _, value in keys))
            words += ["--config", told.name]
        start = time.perf_counter()
        run = self.run([sys.executable, "-m", "sfm_shapefit.cli", *words])
        said = [line for line in run.stderr.splitlines() if line.strip() and not line.endswith(" so far")]
        answer: Answer = {"exit": run.code, "verdict": "", "said": said[-1] if said else ""}
        parts = ("models", "tables", "json", "texts", "pages", "digests")
        answer |= {"files": [], "printed": "", **{part: {} for part in parts}}
        if run.stdout.startswith("{"):
            answer["json"]["stdout"] = json.loads(run.stdout)
        else:
            printed = _BORDERS.sub(" ", run.stdout.replace(f"{self.work}/", ""))
            answer |= {"printed": _NUMBER.sub("#", printed).strip(), "verdict": _verdict(printed)}
        if case.out and (self.work / case.out).exists():
            _collect(self.work / case.out, answer)
        text = json.dumps(answer).replace(f"{self.work}/", "")
        used = {"memory_mb": round(run.memory_mb, 1), "cpu_s": round(run.cpu_s, 2)}
        return {**json.loads(text), **used, "seconds": round(time.perf_counter() - start, 1)}

    def run(self, command: list[str]) -> "Run":
        """Run a command in a process group of its own, with one thread."""
        with tempfile.TemporaryDirectory() as folder:
            usage = Path(folder) / "usage.json"
            process = subprocess.Popen(
                [sys.executable, "-I", "-S", "-c", _USAGE, str(usage), str(LIMIT_CPU_S), *command],
                cwd=self.work,
                env={
                    **os.environ,
                    **thread_environment(1),
                    **{"PYTHONPATH": str(self.package), "COLUMNS": "1000", "NO_COLOR": "1"},
                },
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                stdin=subprocess.DEVNULL,
                encoding="utf-8",
                start_new_session=True,
            )
            try:
                stdout, stderr = process.communicate(timeout=LIMIT_S)
                code, memory_mb, cpu_s = json.loads(usage.read_text())
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.communicate()
                return Run("timeout", "", "", math.nan, math.nan)
        return Run("timeout" if code == -signal.SIGXCPU else code, stdout, stderr, memory_mb, cpu_s)

    def check(self) -> None:
        """Refuse if another package than that of the checkout would run."""
        code = "import sfm_shapefit; print(sfm_shapefit.__file__)"
        run = self.run([sys.executable, "-c", code])
        if not Path(run.stdout.strip()).is_relative_to(self.package) or not run.stdout.strip():
            raise SystemExit(
                f"{self.package} has no package sfm_shapefit that can be loaded: {run.stderr}{run.stdout}"
            )

    def warm_up(self) -> None:
        """Compile all kernels, whose time and memory are no case's."""
        self.run([sys.executable, "-m", "sfm_shapefit.cli", "warm-up"])


def _toml(value: str) -> str:
    """Return a value as TOML spells it."""
    return value if value in ("true", "false") or _NUMBER.fullmatch(value) else json.dumps(value)


def _verdict(printed: str) -> str:
    """Return the first word of the verdict in a printed table, empty where there is none."""
    found = re.search(r"\bverdict (\w+)", printed)
    return found.group(1).lower() if found else ""


def _collect(out: Path, answer: Answer) -> None:
    """Add what was written to an answer, file by file."""
    files = sorted(path for path in (out.rglob("*") if out.is_dir() else [out]) if path.is_file())
    for path in files:
        key = path.relative_to(out if out.is_dir() else out.parent).as_posix()
        answer["files"].append(key)
        if path.suffix == ".bin":
            answer["digests"][key] = hashlib.sha256(path.read_bytes()).hexdigest()
        if path.stem == "images" and path.suffix in (".bin", ".txt"):
            answer["models"][Path(key).parent.as_posix()] = _model(path.parent)
        elif path.suffix == ".csv":
            answer["tables"][key] = _table(path)
        elif path.suffix == ".json":
            answer["json"][key] = json.loads(path.read_text(encoding="utf-8"))
        elif path.suffix == ".html" and out == path:
            answer["pages"][path.name] = _page(path.read_text(encoding="utf-8"))
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


def _page(text: str) -> dict[str, Any]:
    """Return what the page of a model shows: its verdict and the columns of its cameras and pairs."""
    data = json.loads(text.partition('id="data">')[2].partition("</script>")[0])
    columns = {
        f"{part} {name}": np.frombuffer(base64.b64decode(column["bytes"]), column["type"]).tolist()
        for part in ("cameras", "pairs")
        for name, column in data[part].items()
        if isinstance(column, dict) and "bytes" in column
    }
    return {"grade": data["banner"]["grade"], "looks": data["looks"], "columns": columns}


def _digest(path: Path) -> str:
    """Return a hash of all rows of a database."""
    connection = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    lines = "\n".join(connection.iterdump())
    connection.close()
    return hashlib.sha256(lines.encode()).hexdigest()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, help="file of the recording, .json.gz")
    parser.add_argument("--resume", action="store_true", help="keep what OUT has, and record the rest")
    parser.add_argument("--against", type=Path, help="earlier recording to compare with")
    parser.add_argument("--exact", action="store_true", help="numbers must be equal to the bit")
    parser.add_argument("--memory", action="store_true", help="larger peaks of memory count as differences")
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--quick", action="store_true", help="a telling part, on bundled scenes")
    parser.add_argument("--jobs", type=int, default=2, help="cases side by side")
    parser.add_argument("--package", type=Path, default=ROOT, help="root of the checkout whose code runs")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the real sets")


def run(args: argparse.Namespace) -> int:
    old = read(args.against) if args.against else None
    recorded = read(args.out) if args.resume and args.out.exists() else {}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write(args.out, recorded)
    chosen = choose(folders_of(args.data), only=args.only, quick=args.quick, done=recorded)
    for answers in record(args.package, folders_of(args.data), chosen, jobs=args.jobs):
        write(args.out, answers, mode="at")
        recorded |= answers
    skipped = {name: answer["skipped"] for name, answer in recorded.items() if "skipped" in answer}
    print(f"{len(recorded) - len(skipped)} cases recorded, {len(skipped)} skipped")
    print(*(f"  {name}: {reason}" for name, reason in skipped.items()), sep="\n")
    if old is None:
        return 0
    text, is_equal = compare_recordings(old, recorded, exact=args.exact, memory=args.memory)
    print(text)
    return 0 if is_equal else 1


def choose(
    folders: Mapping[str, Path], *, only: str = "", quick: bool = False, done: Collection[str] = ()
) -> list[Case]:
    """Return the cases that are asked for and not done."""
    return [
        case
        for case in all_cases(folders)
        if any(only in one.name for one in (case, *case.followers))
        and (case.quick or not quick)
        and not all(one.name in done for one in (case, *case.followers))
    ]


def record(
    package: Path, folders: Mapping[str, Path], cases: Sequence[Case], *, jobs: int = 2
) -> Iterator[dict[str, Answer]]:
    """Run cases, and yield the answers of each and of its followers by name."""
    present = [case for case in cases if not case.scene or case.scene in (*folders, *MADE)]
    for case in cases:
        if case not in present:
            reason = {"skipped": f"{case.scene} is not at hand"}
            yield dict.fromkeys((one.name for one in (case, *case.followers)), reason)
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(jobs) as pool:
        runner = Runner(package.resolve(), Path(name).resolve())
        runner.check()
        runner.warm_up()
        wanted = {*BUNDLED, *(case.scene for case in present)}
        make_inputs(runner.work, {name: folder for name, folder in folders.items() if name in wanted})
        try:
            for answers in pool.map(runner.ask, present):
                lines = (f"{k}: {a.get('exit')}, {a.get('seconds')} s" for k, a in answers.items())
                print(*lines, sep="; ", file=sys.stderr, flush=True)
                yield answers
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def folders_of(data: Path) -> dict[str, Path]:
    """Return the folders of scenes and sets that are at hand, by name."""
    found = {name: ROOT / "data_synthetic" / name for name in BUNDLED}
    for folder in sorted(data.glob("*")):
        if folder.name == MADRID or (folder / "database.db").exists():
            found[folder.name] = folder
    return found


def compare_recordings(
    old: dict[str, Answer], new: dict[str, Answer], *, exact: bool = False, memory: bool = False
) -> tuple[str, bool]:
    """Return what is to be said of two recordings, and whether the cases that both have are equal."""
    both = [name for name in new if name in old and _is_answered(old[name]) and _is_answered(new[name])]
    text, is_equal = report({name: compare(old[name], new[name], exact=exact) for name in both}, exact=exact)
    used, is_within = compare_use({name: (old[name], new[name]) for name in both})
    unanswered = {name for name in old.keys() & new.keys() if name not in both}
    for words, names in (
        ("only before", old.keys() - new.keys()),
        ("only now", new.keys() - old.keys()),
        ("skipped or without an answer in time", unanswered),
    ):
        used += f"\n{words}, not compared: {len(names)} cases, {sorted(names)[:5]}" if names else ""
    return f"{text}\n{used}", bool(both) and is_equal and (is_within or not memory)


def _is_answered(answer: Answer) -> bool:
    return "skipped" not in answer and answer["exit"] != "timeout"


def read(path: Path) -> dict[str, Answer]:
    """Return the answers of a recording by name; one that was interrupted may end amid a line."""
    found: dict[str, Answer] = {}
    with gzip.open(path, "rt", encoding="utf-8") as stream, contextlib.suppress(EOFError, ValueError):
        for line in stream:
            found |= json.loads(line)
    return found


def write(path: Path, answers: dict[str, Answer], mode: str = "wt") -> None:
    """Write answers, or add them to a recording, a line each."""
    with gzip.open(path, mode, encoding="utf-8") as stream:
        stream.writelines(json.dumps({name: answer}) + "\n" for name, answer in answers.items())
