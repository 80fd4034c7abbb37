"""Faults while running: signals at random moments, full disks, little memory, rivals, locks.

What must hold each time: OUT is absent or whole, the input is untouched, the message is one sentence, and
what a killed run left behind is gone after the next run.
"""

import argparse
import os
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from abuse import verdicts
from abuse.fuzz import caches, command_line, make_base, warm_locate
from abuse.sandbox import Child, Outcome, run_forked, start_forked

HELP = "signals, full disks, little memory, rivals and locks while a command runs"
_PROJECT = Path(__file__).resolve().parents[2]
_NOBODY = 65534
# The address space may grow by so much beyond what the idle process maps.
_EXTRA_MEMORY = tuple(megabytes * 10**6 for megabytes in (0, 2, 5, 10, 20, 40, 80, 160, 320))
# A file may have so many bytes.
_FILE_SIZES = (0, 8, 100, 1000, 3000, 6000)

Problems = Iterator[str]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--moments", type=int, default=50, help="per signal, in a warm process")
    parser.add_argument("--cold", type=int, default=5, help="per signal, in processes of their own")
    parser.add_argument("--rivals", type=int, default=20, help="rounds of two runs into the same place")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, help="where cases are made; a temporary folder by default")


def run(args: argparse.Namespace) -> int:
    """Run all faults, print each problem and a table; 1 if there is a problem."""
    with tempfile.TemporaryDirectory() as temporary:
        # Another user reads the input later.
        Path(temporary).chmod(0o711)
        bench = Bench((args.work or Path(temporary)).resolve())
        rng = np.random.default_rng(args.seed)
        checks: dict[str, Callable[[], Problems]] = {
            **{
                f"{number.name} at {count} moments{words}": partial(check, bench, number, rng.random(count))
                for check, count, words in (
                    (signals, args.moments, ""),
                    (cold_signals, args.cold, " of a cold process"),
                )
                for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
                if count
            },
            "files that may not grow": partial(starve, bench, resource.RLIMIT_FSIZE, _FILE_SIZES),
            "a full disk": partial(full_disk, bench),
            "little memory": partial(starve, bench, resource.RLIMIT_AS, _EXTRA_MEMORY),
            f"two runs at once, {args.rivals} times": partial(rivals, bench, args.rivals),
            "a read-only input": partial(read_only_input, bench),
            "a database in use": partial(lock_database, bench),
        }
        failed = False
        for name, check in checks.items():
            bench.endings.clear()
            problems = list(check())
            failed |= bool(problems)
            endings = ", ".join(f"{count} x {ending}" for ending, count in bench.endings.most_common())
            print(f"{'FAILED' if problems else 'held':7}{name}: {endings}", flush=True)
            for problem in problems:
                print(f"    {problem}", flush=True)
    return int(failed)


class Bench:
    """A warm process with a sound scene, and folders to run commands in."""

    def __init__(self, work: Path) -> None:
        self.base = make_base(work / "base")
        self.expected = warm_locate(self.base)["database"]
        self.folder = work / "case"
        self.writable = [self.folder, *caches()]
        self.endings: Counter[str] = Counter()
        self.before: dict[str, str] = {}
        self.duration_s = float("inf")
        for _ in range(3):
            self.prepare()
            start = time.perf_counter()
            outcome = run_forked(self.locate(), self.folder, self.writable)
            self.duration_s = min(self.duration_s, time.perf_counter() - start)
            if outcome.code:
                raise RuntimeError(f"the sound run failed: {outcome.stderr}")

    def prepare(self) -> None:
        """Make a fresh folder with the input."""
        shutil.rmtree(self.folder, ignore_errors=True)
        (self.folder / "tmp").mkdir(parents=True)
        (self.folder / "place").mkdir()
        shutil.copytree(self.base / "sparse", self.folder / "sparse")
        shutil.copyfile(self.base / "database.db", self.folder / "database.db")
        self.before = verdicts.snapshot(self.folder)

    def arguments(self, *extra: str, out: str = "place/out") -> tuple[str, ...]:
        """Return the command that is disturbed."""
        return ("locate", "sparse/0", out, "--database", "database.db", "--threads", "1", *extra)

    def locate(self, *extra: str, out: str = "place/out") -> Callable[[], None]:
        """Return the command as a function for a child."""
        return partial(command_line, self.arguments(*extra, out=out), self.folder / "tmp")

    def start(self, *extra: str, logs: str = "log") -> Child:
        """Start the command in a child."""
        return start_forked(self.locate(*extra), self.folder, self.writable, logs=logs)

    def judge(self, main: Callable[[], None], label: str, cut: int | None = None) -> Problems:
        """Run a disturbed command: it must succeed or say one sentence, of which `cut` bytes may be kept."""
        outcome = self.note(run_forked(main, self.folder, self.writable))
        is_cut = cut is not None and len(outcome.stderr) >= cut
        if outcome.code not in (0, 3) or (outcome.stderr.count("\n") != outcome.code // 3 and not is_cut):
            yield f"{label}: exit {outcome.code}, {outcome.stderr[-300:]!r}"
        yield from self.problems()

    def note(self, outcome: Outcome) -> Outcome:
        """Count how a run ended."""
        sentence = outcome.stderr.strip().replace(str(self.folder), "").removeprefix("sfm-shapefit: ")
        self.endings[f"exit {outcome.code}" + (f" ({sentence[:90]})" if sentence else "")] += 1
        return outcome

    def problems(self, *, strays: bool = False) -> Problems:
        """Yield what is not as it must be: the input, OUT, and, unless accepted, strays."""
        after = verdicts.snapshot(self.folder)
        yield from (f"changed {name}" for name in self.before if after.get(name) != self.before[name])
        out = self.folder / "place" / "out"
        try:
            if out.exists():
                yield from verdicts.faults_of_tables(out)
                yield from verdicts.faults_of_model(out)
            if out.exists() and verdicts.differs(verdicts.positions(out), self.expected):
                yield "another answer"
        except OSError as error:
            yield f"the output is not whole: {error}"
        new = [name for name in after.keys() - self.before.keys() if not name.startswith("place/out")]
        if new and not strays:
            yield f"left {sorted(new)[0]}"


def signals(bench: Bench, number: signal.Signals, moments: np.ndarray) -> Problems:
    """Send a signal at random moments of a run; every other run replaces an earlier output."""
    for k, moment in enumerate(moments.tolist()):
        bench.prepare()
        overwrite = k % 2 == 1
        if overwrite:
            run_forked(bench.locate(), bench.folder, [bench.folder])
        extra = ("--overwrite",) if overwrite else ()
        child = bench.start(*extra)
        time.sleep(moment * 1.05 * bench.duration_s)
        os.kill(child.pid, number)
        outcome = bench.note(child.finish())
        yield from _after_signal(bench, number, outcome.code, outcome.stderr, overwrite=overwrite)


def cold_signals(bench: Bench, number: signal.Signals, moments: np.ndarray) -> Problems:
    """The same in processes that start afresh: most of their time goes into loading."""
    command = [sys.executable, "-m", "sfm_shapefit.cli", *bench.arguments()]
    environment = {**os.environ, "PYTHONPATH": str(_PROJECT), "TMPDIR": str(bench.folder / "tmp")}
    start = time.perf_counter()
    bench.prepare()
    subprocess.run(command, cwd=bench.folder, env=environment, check=True, capture_output=True)
    duration_s = time.perf_counter() - start
    for moment in moments.tolist():
        bench.prepare()
        process = subprocess.Popen(
            command, cwd=bench.folder, env=environment, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL
        )
        time.sleep((0.3 + 0.7 * moment) * duration_s)
        process.send_signal(number)
        _, raw = process.communicate(timeout=60)
        stderr = raw.decode(errors="replace")
        bench.endings[f"exit {process.returncode} ({stderr.strip().splitlines()[-1:]})"] += 1
        yield from _after_signal(bench, number, process.returncode, stderr, overwrite=False, cold=True)


def _after_signal(
    bench: Bench, number: signal.Signals, code: int, stderr: str, *, overwrite: bool, cold: bool = False
) -> Problems:
    """Yield what is wrong after a run was hit, and after the next run."""
    killed = number == signal.SIGKILL
    accepted = {0, -number if killed else 130, *([-number] if cold else [])}
    if code not in accepted:
        yield f"exit {code} after {number.name}: {stderr[-300:]}"
    exists = (bench.folder / "place" / "out").exists()
    if code == 130 and stderr not in (
        "sfm-shapefit: interrupted; nothing was written\n",
        "sfm-shapefit: interrupted; the output is complete\n",
        "",  # before the command began or after it ended
    ):
        yield f"the message is {stderr!r}"
    if code == 130 and stderr and not overwrite and exists != ("complete" in stderr):
        yield f"the message is {stderr!r}, and OUT {'exists' if exists else 'does not exist'}"
    if overwrite and not exists:
        yield "the earlier output is gone"
    yield from bench.problems(strays=killed or code < 0)
    if killed:
        run_forked(bench.locate("-q", out="place/later"), bench.folder, bench.writable)
        shutil.rmtree(bench.folder / "place" / "later")
        yield from (f"after the next run: {problem}" for problem in bench.problems())


def starve(bench: Bench, what: int, sizes: Iterable[int]) -> Problems:
    """No file may be larger than so many bytes, or the address space may grow by so many."""
    for size in sizes:
        bench.prepare()
        main = partial(_limit_resource, bench.locate("-q"), what, size)
        # What the child prints goes into files too, and is cut.
        yield from bench.judge(main, f"{size} bytes", cut=size if what == resource.RLIMIT_FSIZE else None)


def _limit_resource(main: Callable[[], None], what: int, size: int) -> None:
    if what == resource.RLIMIT_AS:
        size += int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(what, (size, size))
    main()


def full_disk(bench: Bench) -> Problems:
    """OUT on a file system of a few pages."""
    for pages in (2, 4, 6, 8):
        bench.prepare()
        with _small_disk(bench.folder / "place", pages * 4096) as mounted:
            if not mounted:
                bench.endings["left out: no file system can be mounted here"] += 1
                return
            yield from bench.judge(bench.locate("-q"), f"{pages} pages")


@contextmanager
def _small_disk(folder: Path, size: int) -> Iterator[bool]:
    """Mount a small file system on a folder, if this user may."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    mounted = subprocess.run(command, check=False, capture_output=True).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", str(folder)], check=True)


def rivals(bench: Bench, rounds: int) -> Problems:
    """Two runs into the same OUT: one wins, the other says so."""
    for k in range(rounds):
        bench.prepare()
        extra = ("--overwrite", "-q") if k % 2 else ("-q",)
        children = [bench.start(*extra, logs=str(side)) for side in range(2)]
        outcomes = [bench.note(child.finish()) for child in children]
        codes = sorted(outcome.code for outcome in outcomes)
        if codes != [0, 3]:
            yield f"round {k}: exits {codes}, {[outcome.stderr for outcome in outcomes]}"
        yield from bench.problems()


def read_only_input(bench: Bench) -> Problems:
    """A user who may read the input and write to OUT's parent only."""
    bench.prepare()
    for path in (bench.folder, *bench.folder.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    for name in ("place", "tmp"):
        (bench.folder / name).chmod(0o777)
    for parent in bench.folder.parents:
        if not parent.stat().st_mode & 0o001:
            bench.endings[f"left out: others may not enter {parent}"] += 1
            return
    main = partial(_as_nobody, bench.locate("-q"))
    outcome = bench.note(run_forked(main, bench.folder, bench.writable))
    if outcome.code:
        yield f"exit {outcome.code}: {outcome.stderr[-300:]}"
    yield from bench.problems()


def _as_nobody(main: Callable[[], None]) -> None:
    if os.geteuid() == 0:
        os.setgroups([])
        os.setresgid(_NOBODY, _NOBODY, _NOBODY)
        os.setresuid(_NOBODY, _NOBODY, _NOBODY)
    main()


def lock_database(bench: Bench) -> Problems:
    """Another program in the middle of a transaction, in either journal mode."""
    for mode in ("delete", "wal"):
        for begin in ("BEGIN EXCLUSIVE", "BEGIN IMMEDIATE", "written"):
            bench.prepare()
            path = bench.folder / "database.db"
            with closing(sqlite3.connect(path, isolation_level=None)) as connection:
                connection.execute(f"PRAGMA journal_mode = {mode}")
                connection.execute("BEGIN EXCLUSIVE" if begin == "written" else begin)
                if begin == "written":
                    connection.execute("PRAGMA cache_size = 1")  # so that it reaches the file
                    connection.execute("UPDATE keypoints SET data = zeroblob(100000)")
                bench.before = verdicts.snapshot(bench.folder)
                yield from bench.judge(bench.locate("-q"), f"{mode}, {begin}")
                connection.execute("ROLLBACK")
