"""Signals, full disks, little memory, rivals and locks while a command runs.

Each time OUT must be absent or whole, the input untouched, the message one sentence, and what a killed run
left behind gone after the next run.
"""

import argparse
import itertools
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
from contextlib import closing, contextmanager, nullcontext
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap

from tests.abuse import verdicts
from tests.abuse.fuzz import caches, command_line, make_base, warm_locate
from tests.abuse.sandbox import mapped_bytes, run_forked, start_forked
from tests.scenes import ROOT, fingerprint

_NOBODY = 65534
_EXTRA_MEMORY = tuple(megabytes * 10**6 for megabytes in (0, 2, 5, 10, 20, 40, 80, 160, 320))
"""Bytes by which the address space may grow beyond what the idle process maps."""
_FILE_SIZES = (0, 8, 100, 1000, 3000, 6000)
"""Bytes that a file may have."""
_OTHERS = {
    "synth": ("place/out", "--num-images", "4", "--num-points", "400"),
    "map": ("database.db", "place/out", "-q"),
    "join": ("first", "second", "place/out", "--database", "database.db", "-q"),
    "convert": ("sparse/0", "place/out", "-q"),
    "convert glb": ("sparse/0", "place/o.glb", "-q"),
    "convert json": ("sparse/0", "place/o.json", "-q"),
    "check": ("sparse/0", "--report", "place/o.html", "--no-second-opinion"),
    "evaluate": ("sparse/0", "truth", "--csv", "place/o.csv"),
}
"""Arguments of other commands, which write a folder or a file into `place`."""
_INTERRUPTED = "sfm-shapefit: interrupted; nothing was written\n"
_COMPLETE = "sfm-shapefit: interrupted; the output is complete\n"


def add_arguments(parser: argparse.ArgumentParser):
    parser.add_argument("--moments", type=int, default=50, help="per signal, in a warm process")
    parser.add_argument("--cold", type=int, default=5, help="per signal, in processes of their own")
    parser.add_argument("--rivals", type=int, default=20, help="rounds of two runs into the same place")
    parser.add_argument("--rooms", type=int, default=5, help="sizes of a place without room, per command")
    parser.add_argument("--seed", type=int, default=0)


def run(args):
    """Run all faults, print each problem and a line per fault; 1 if there is a problem."""
    rng, checks = np.random.default_rng(args.seed), {}
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        warm, cold = rng.random(args.moments), rng.random(args.cold)
        checks[f"{number.name} at {args.moments} moments"] = partial(signals, number, warm)
        checks[f"{number.name} at {args.moments} moments, other commands"] = partial(
            signals_of_others, number, rng.random(args.moments)
        )
        if args.cold:
            checks[f"{number.name} at {args.cold} moments, cold"] = partial(cold_signals, number, cold)
    checks |= {
        "files that may not grow": partial(starve, resource.RLIMIT_FSIZE, _FILE_SIZES),
        "a full disk": full_disk,
        "a full disk, other commands": partial(no_room, args.rooms, True),
        "files that may not grow, other commands": partial(no_room, args.rooms, False),
        "little memory": partial(starve, resource.RLIMIT_AS, _EXTRA_MEMORY),
        f"two runs at once, {args.rivals} times": partial(rivals, args.rivals),
        "a read-only input": read_only_input,
        "a database in use": lock_database,
    }
    failed = False
    with tempfile.TemporaryDirectory() as temporary:
        Path(temporary).chmod(0o711)  # another user reads the input
        bench = Bench(Path(temporary).resolve())
        for name, check in checks.items():
            bench.endings.clear()
            problems = list(check(bench))
            failed |= bool(problems)
            endings = ", ".join(f"{count} x {ending}" for ending, count in bench.endings.most_common())
            print(f"{'FAILED' if problems else 'held':7}{name}: {endings}", flush=True)
            print(*(f"    {problem}\n" for problem in problems), sep="", end="", flush=True)
    return int(failed)


class Bench:
    """A warm process with a sound scene, and folders to run `locate` in."""

    def __init__(self, work):
        self.base, self.folder = make_base(work / "base"), work / "case"
        for name, left_out in (("first", (1, 2)), ("second", (5, 6))):
            half = pycolmap.Reconstruction(self.base / "sparse" / "0")
            for frame in left_out:
                half.deregister_frame(frame)
            (self.base / name).mkdir()
            half.write(self.base / name)
        self.expected = warm_locate(self.base)["database"]
        self.writable = [self.folder, *caches()]
        self.endings, self.before, self._earlier = Counter(), {}, {}
        self.duration_s = min(self._time_a_sound_run() for _ in range(3))

    def _time_a_sound_run(self):
        self.prepare()
        start = time.perf_counter()
        outcome = run_forked(self.locate(), self.folder, self.writable)
        assert outcome.code == 0, outcome.stderr
        return time.perf_counter() - start

    def prepare(self, *names):
        """Make a fresh folder with the input, and with further parts of the scene."""
        shutil.rmtree(self.folder, ignore_errors=True)
        for name in ("tmp", "place"):
            (self.folder / name).mkdir(parents=True)
        shutil.copytree(self.base / "sparse", self.folder / "sparse")
        shutil.copyfile(self.base / "database.db", self.folder / "database.db")
        for name in names:
            shutil.copytree(self.base / name, self.folder / name)
        self.before = fingerprint(self.folder)

    def earlier(self, label):
        """Return a folder with what another command writes where nothing is in its way; it runs once."""
        if label not in self._earlier:
            self.prepare("truth", "first", "second")
            command = (label.split()[0], *_OTHERS[label])
            run_forked(partial(command_line, command, self.folder / "tmp"), self.folder, self.writable)
            kept = self.base.parent / f"earlier {label}"
            self._earlier[label] = shutil.copytree(self.folder / "place", kept)
        return self._earlier[label]

    def arguments(self, *extra, out="place/out"):
        return ("locate", "sparse/0", out, "--database", "database.db", "--threads", "1", *extra)

    def locate(self, *extra, out="place/out"):
        """Return the command as a function for a child."""
        return partial(command_line, self.arguments(*extra, out=out), self.folder / "tmp")

    def start(self, *extra, logs="log"):
        return start_forked(self.locate(*extra), self.folder, self.writable, logs=logs)

    def judge(self, main, label, cut=None):
        """Run a disturbed command: it must succeed or say one sentence, of which `cut` bytes may be kept."""
        code, _, stderr, *_ = self.note(run_forked(main, self.folder, self.writable))
        is_cut = cut is not None and len(stderr) >= cut
        if code not in (0, 3) or (stderr.count("\n") != code // 3 and not is_cut):
            yield f"{label}: exit {code}, {stderr[-300:]!r}"
        yield from self.problems()

    def note(self, outcome):
        """Count how a run ended."""
        sentence = outcome.stderr.strip().replace(str(self.folder), "").removeprefix("sfm-shapefit: ")
        self.endings[f"exit {outcome.code}" + (f" ({sentence[:90]})" if sentence else "")] += 1
        return outcome

    def problems(self, *, strays=False):
        """Yield what is not as it must be: the input, OUT, and, unless accepted, strays."""
        after, out = fingerprint(self.folder), self.folder / "place" / "out"
        yield from (f"changed {name}" for name in self.before if after.get(name) != self.before[name])
        try:
            if out.exists():
                yield from verdicts.faults_of_tables(out)
                yield from verdicts.faults_of_model(out)
                if verdicts.differs(verdicts.positions(out), self.expected):
                    yield "another answer"
        except OSError as error:
            yield f"the output is not whole: {error}"
        new = sorted(name for name in after.keys() - self.before.keys() if not name.startswith("place/out"))
        yield from (f"left {name}" for name in new[: 0 if strays else 1])


def signals(number, moments, bench):
    """Send a signal at random moments of a run; every other run replaces an earlier output."""
    for k, moment in enumerate(moments.tolist()):
        bench.prepare()
        overwrite = k % 2 == 1
        if overwrite:
            run_forked(bench.locate(), bench.folder, [bench.folder])
        child = bench.start(*["--overwrite"] * overwrite)
        time.sleep(moment * 1.05 * bench.duration_s)
        os.kill(child.pid, number)
        outcome = bench.note(child.finish())
        accepted = {0, -number if number == signal.SIGKILL else 130}
        yield from _after_signal(bench, outcome.code, outcome.stderr, accepted, overwrite=overwrite)


def signals_of_others(number, moments, bench):
    """Send a signal at random moments of other commands, each of which replaces an earlier output or file."""
    for k, moment in enumerate(moments.tolist()):
        label = list(_OTHERS)[k % len(_OTHERS)]
        command, again = (label.split()[0], *_OTHERS[label]), label not in ("synth", "convert")
        bench.prepare("truth", "first", "second")
        started = time.perf_counter()
        if again:
            run_forked(partial(command_line, command, bench.folder / "tmp"), bench.folder, bench.writable)
        duration_s = time.perf_counter() - started if again else bench.duration_s
        inputs = {name: kind for name, kind in fingerprint(bench.folder).items() if name[:5] != "place"}
        main = partial(command_line, (*command, *["--overwrite"] * again), bench.folder / "tmp")
        child = start_forked(main, bench.folder, bench.writable)
        time.sleep(moment * 1.05 * duration_s)
        os.kill(child.pid, number)
        outcome = bench.note(child.finish())
        if outcome.code not in (0, -number if number == signal.SIGKILL else 130):
            yield f"{label}: exit {outcome.code}, {outcome.stderr[-300:]!r}"
        if "Traceback" in outcome.stderr:
            yield f"{label}: {outcome.stderr[-300:]!r}"
        yield from (f"{label}: {problem}" for problem in _broken_outputs(bench.folder / "place", again))
        if number == signal.SIGKILL:
            later = ("convert", "sparse/0", "place/later.csv", "-q")
            run_forked(partial(command_line, later, bench.folder / "tmp"), bench.folder, bench.writable)
        after = fingerprint(bench.folder)
        yield from (f"{label}: changed {name}" for name in inputs if after.get(name) != inputs[name])
        yield from (f"{label}: left {name}" for name in after if ".partial" in name or name[:4] == "tmp/")


def _broken_outputs(place, again):
    """Yield which outputs or files in a place are lost, or not whole."""
    found = sorted(path for path in place.iterdir() if not path.name.startswith("."))
    if again and not found:
        yield "the earlier output is gone"
    for path in found:
        if path.is_dir():
            models = {file.parent for file in path.rglob("images.bin")}
            yield from itertools.chain.from_iterable(map(verdicts.faults_of_model, sorted(models)))
            if again and not any((path / name).exists() for name in ("locate.json", "map.json")):
                yield f"{path.name} is not whole"
            continue
        content = path.read_bytes()
        whole = {
            ".html": content.endswith(b"</html>\n"),
            ".json": content.endswith(b"}\n") or content.endswith(b"}"),
            ".csv": content.endswith(b"\n") and content.count(b"\n") == 7,
            ".ply": _is_whole_ply(content),
            ".glb": int.from_bytes(content[8:12], "little") == len(content),
        }
        if not whole[path.suffix]:
            yield f"{path.name} is not whole"


def _is_whole_ply(content):
    """Return whether points have the bytes that the header tells: three floats and a color each."""
    header, _, body = content.partition(b"end_header\n")
    count = header.partition(b"element vertex ")[2].split(b"\n")[0]
    return count.isdigit() and len(body) == 15 * int(count)


def cold_signals(number, moments, bench):
    """The same in processes that start afresh: most of their time goes into loading."""
    command = [sys.executable, "-m", "sfm_shapefit.cli", *bench.arguments()]
    place = {"cwd": bench.folder, "env": os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": "tmp"}}
    bench.prepare()
    start = time.perf_counter()
    subprocess.run(command, **place, check=True, capture_output=True)
    duration_s = time.perf_counter() - start
    for moment in moments.tolist():
        bench.prepare()
        process = subprocess.Popen(command, **place, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL)
        time.sleep((0.3 + 0.7 * moment) * duration_s)
        process.send_signal(number)
        stderr = process.communicate(timeout=60)[1].decode(errors="replace")
        bench.endings[f"exit {process.returncode} ({stderr.strip().splitlines()[-1:]})"] += 1
        yield from _after_signal(bench, process.returncode, stderr, {0, -number, 130})


def _after_signal(bench, code, stderr, accepted, *, overwrite=False):
    """Yield what is wrong after a run was hit, and after the next run."""
    exists = (bench.folder / "place" / "out").exists()
    if code not in accepted:
        yield f"exit {code}: {stderr[-300:]}"
    # It may say nothing before the command began or after it ended.
    if code == 130 and stderr not in (_INTERRUPTED, _COMPLETE, ""):
        yield f"the message is {stderr!r}"
    if code == 130 and stderr and not overwrite and exists != (stderr == _COMPLETE):
        yield f"the message is {stderr!r}, and OUT {'exists' if exists else 'does not exist'}"
    if code < 0 and stderr not in (_INTERRUPTED, _COMPLETE, ""):
        yield f"a stack trace: {stderr[:300]!r}"
    if overwrite and not exists:
        yield "the earlier output is gone"
    yield from bench.problems(strays=code < 0)
    if code == -signal.SIGKILL:
        run_forked(bench.locate("-q", out="place/later"), bench.folder, bench.writable)
        shutil.rmtree(bench.folder / "place" / "later")
        yield from (f"after the next run: {problem}" for problem in bench.problems())


def starve(what, sizes, bench):
    """No file may be larger than so many bytes, or the address space may grow by so many."""

    def limited(size):
        size += mapped_bytes() if what == resource.RLIMIT_AS else 0
        resource.setrlimit(what, (size, size))
        bench.locate("-q")()

    for size in sizes:
        bench.prepare()
        # What the child prints goes into files too, and is cut.
        cut = size if what == resource.RLIMIT_FSIZE else None
        yield from bench.judge(partial(limited, size), f"{size} bytes", cut)


def full_disk(bench):
    """OUT on a file system of a few pages."""
    for pages in (2, 4, 6, 8):
        bench.prepare()
        with _small_disk(bench.folder / "place", pages * 4096) as mounted:
            if not mounted:
                bench.endings["left out: no file system can be mounted here"] += 1
                return
            yield from bench.judge(bench.locate("-q"), f"{pages} pages")


def no_room(rooms, on_disk, bench):
    """Other commands in a place without room, or whose files may not grow, also over an earlier output."""
    for label, arguments in _OTHERS.items():
        command = (label.split()[0], *arguments)
        earlier = bench.earlier(label)
        size = sum(4096 + path.stat().st_size for path in earlier.rglob("*"))
        for pages, again in itertools.product((16, 4, 1, 2, 8)[:rooms], (False, True)):
            if again and label in ("synth", "convert"):  # folders of theirs are never replaced
                continue
            bench.prepare("truth", "first", "second")
            room = pages * 4096 + (size if again and on_disk else 0)
            with _small_disk(bench.folder / "place", room) if on_disk else nullcontext(True) as mounted:
                if not mounted:
                    bench.endings["left out: no file system can be mounted here"] += 1
                    return
                if again:
                    shutil.copytree(earlier, bench.folder / "place", dirs_exist_ok=True)
                main = partial(_run_limited, None if on_disk else room, (*command, *["--overwrite"] * again))
                yield from _after_no_room(bench, main, f"{label}, {pages} pages, {again}")


def _run_limited(most_bytes, command):
    """Be `sfm-shapefit`, whose files may not be larger than so many bytes."""
    if most_bytes is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))
    command_line(command, Path("tmp").absolute())


def _after_no_room(bench, main, label):
    """Run a command: it must succeed, or change nothing and say one sentence that names no private place."""
    before = fingerprint(bench.folder)
    code, _, stderr, *_ = bench.note(run_forked(main, bench.folder, bench.writable))
    if code not in (0, 3) or (code and stderr.count("\n") != 1):
        yield f"{label}: exit {code}, {stderr[-300:]!r}"
    if ".partial" in stderr:
        yield f"{label}: names its private place: {stderr[-300:]!r}"
    if code and fingerprint(bench.folder) != before:
        yield f"{label}: failed, and left or changed something"


@contextmanager
def _small_disk(folder, size):
    """Mount a small file system on a folder, if this user may."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    mounted = subprocess.run(command, check=False, capture_output=True).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", str(folder)], check=True)


def rivals(rounds, bench):
    """Two runs into the same OUT: one wins, the other says so."""
    for k in range(rounds):
        bench.prepare()
        children = [bench.start("-q", *["--overwrite"] * (k % 2), logs=str(side)) for side in range(2)]
        outcomes = [bench.note(child.finish()) for child in children]
        if sorted(outcome.code for outcome in outcomes) != [0, 3]:
            yield f"round {k}: {[(outcome.code, outcome.stderr) for outcome in outcomes]}"
        yield from bench.problems()


def read_only_input(bench):
    """A user who may read the input and write to OUT's parent only."""

    def locate_as_nobody():
        if os.geteuid() == 0:
            os.setgroups([])
            os.setresgid(_NOBODY, _NOBODY, _NOBODY)
            os.setresuid(_NOBODY, _NOBODY, _NOBODY)
        bench.locate("-q")()

    bench.prepare()
    for path in (bench.folder, *bench.folder.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    for name in ("place", "tmp"):
        (bench.folder / name).chmod(0o777)
    closed = [parent for parent in bench.folder.parents if not parent.stat().st_mode & 0o001]
    if closed:
        bench.endings[f"left out: others may not enter {closed[0]}"] += 1
        return
    outcome = bench.note(run_forked(locate_as_nobody, bench.folder, bench.writable))
    if outcome.code:
        yield f"exit {outcome.code}: {outcome.stderr[-300:]}"
    yield from bench.problems()


def lock_database(bench):
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
                bench.before = fingerprint(bench.folder)
                yield from bench.judge(bench.locate("-q"), f"{mode}, {begin}")
                connection.execute("ROLLBACK")
