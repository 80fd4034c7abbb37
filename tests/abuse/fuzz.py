"""Damaged models, databases, graphs and tables through the real commands.

Case k of seed s is always the same, so a failure is repeated by `--only k`. Each runs in a forked child of
one warm process (see `sandbox`) in a folder of its own, and must end in a correct result or in one sentence
with exit code 2, 3 or 4; where the damage does not concern what is asked, the answer must stay.
"""

import argparse
import collections
import contextlib
import os
import shutil
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.synthetic import SceneOptions, WorkspaceOptions, make_scene
from sfm_shapefit.synthetic.workspace import write_workspace
from tests.abuse import databases, mutations
from tests.abuse.layouts import MODEL_FILES, binary_fields
from tests.abuse.mutations import pick
from tests.abuse.sandbox import run_forked
from tests.abuse.verdicts import differs, faults, faults_of_model, faults_of_tables, positions
from tests.program import run as run_here
from tests.scenes import ROOT, fingerprint

_SAMPLES = Path(__file__).with_name("samples")
_FOREIGN = "opensfm/reconstruction.json"
_TABLES = {"priors.txt": "--priors", "fix.txt": "--fix", "options.toml": "--config"}
_MANY_CASES = 100
STAGES_OF_MAP = ((), ("--adjust", "full"), ("--adjust", "none"))
"""Flags of `map` that choose among its stages."""


class Case(NamedTuple):
    """A damaged input and how it is used."""

    label: str
    """What was damaged and how."""
    arguments: tuple[str, ...]
    """Of the command line, relative to the case's folder."""
    same_answer: bool = False
    """Whether the positions must be those of the sound input, since the damage does not concern them."""
    may_fail: bool = True
    """Whether bad input is to be expected."""
    made: str = ""
    """File that is made, or replaced, where it is not the third argument."""


def add_arguments(parser: argparse.ArgumentParser):
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="first case: to go on where a run ended")
    parser.add_argument("--only", type=int, help="run this case alone")


def run(args):
    """Run all cases, print what failed and a summary; 1 if any failed."""
    numbers = range(args.first, args.first + args.cases) if args.only is None else [args.only]
    done, failed, start = [], 0, time.perf_counter()
    with tempfile.TemporaryDirectory() as temporary, contextlib.suppress(KeyboardInterrupt):
        base = make_base(Path(temporary, "base"))
        # To warm all commands takes as long as a hundred cases are slower without.
        expected = (warm if len(numbers) > _MANY_CASES else warm_locate)(base)
        for number in numbers:
            case, outcome, found = try_case(base, Path(temporary, "case"), [args.seed, number], expected)
            done.append((case.label.partition(":")[0], outcome))
            failed += bool(found)
            if found or args.only is not None:
                print(f"case {number} ({case.label}): {'; '.join(found) or outcome}")
                print(f"    {' '.join(case.arguments)}: {outcome.stderr[-1200:]}", flush=True)
    print(f"{len(done)} cases, {failed} failed, in {time.perf_counter() - start:.0f} s")
    for (kind, code), count in sorted(collections.Counter((k, o.code) for k, o in done).items()):
        print(f"{kind:10} exit {code:3}: {count}")
    return int(failed > 0)


def make_base(folder):
    """Write a small sound scene in every form that is read."""
    options = SceneOptions(shape="cloud", num_images=6, num_points=60, pixel_noise_px=0.2, min_matches=15)
    shutil.rmtree(folder, ignore_errors=True)
    write_workspace(make_scene(options), folder, WorkspaceOptions(relative_poses=True))
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    for name in ("text", "truth"):
        (folder / name).mkdir()
    model.write_text(folder / "text")
    model.write_binary(folder / "truth")
    shutil.copytree(_SAMPLES, folder, dirs_exist_ok=True)
    shutil.copytree(folder / "sparse/0", folder / "old", ignore=shutil.ignore_patterns("rigs*", "frames*"))
    return folder


def warm_locate(base):
    """Run `locate` on every form of the model, so that this process has loaded what its children call.

    Returns the positions that each form leads to.
    """
    expected, out = {}, base.parent / "warm"
    for form, *extra in (("sparse/0", "--database", base / "database.db"), ("old",), ("text",)):
        run_here("locate", base / form, out, *extra, "--threads", 1, "-q", "--overwrite", code=0)
        expected["database" if extra else form] = positions(out)
    return expected


def warm(base):
    """Run every command as cases do, so that the children find all code loaded and compiled."""
    expected, out = warm_locate(base), base.parent / "warm"
    old = ("locate", base / "old", out, "--threads", 1)
    seen = (*old, "--database", base / "database.db")
    for command in (
        (*seen,),
        (*old, "--adjust", "full"),
        (*seen, "--rotations", "free"),
        (*seen, "--priors", base / "priors.txt"),
        (*seen, "--fix", base / "fix.txt"),
        ("solve", base / "graph.txt", out),
        *(("map", base / "database.db", out, "--threads", 1, *stages) for stages in STAGES_OF_MAP),
    ):
        run_here(*command, "-q", "--overwrite", code=0)
    run_here("evaluate", base / "old", base / "truth", code=0)
    run_here("inspect", base / "old", code=0)
    for name in ("foreign", "scene.glb"):
        run_here("convert", base / _FOREIGN, out / name, code=0)
    shutil.rmtree(out)
    return expected


def try_case(base, folder, seed, expected):
    """Make, run and judge a case, whose folder stays until the next one."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "tmp").mkdir(parents=True)
    rng = np.random.default_rng(seed)
    case = pick(rng, _KINDS)(base, folder, rng)
    before = fingerprint(folder)
    main = partial(command_line, case.arguments, folder / "tmp")
    encoding = "ascii" if rng.random() < 0.1 else "utf-8"
    outcome = run_forked(main, folder, [folder, *caches()], encoding=encoding)
    return case, outcome, [*faults(outcome), *_judge(case, outcome, folder, before, expected)]


def command_line(arguments, temporary):
    """Be `sfm-shapefit`, in a child."""
    from sfm_shapefit.cli import main

    tempfile.tempdir = str(temporary)
    sys.argv = ["sfm-shapefit", *arguments]
    main()


def caches():
    """Return where compiled code is kept."""
    return [ROOT / "sfm_shapefit", Path(os.environ.get("NUMBA_CACHE_DIR", ROOT / "sfm_shapefit"))]


def _judge(case, outcome, folder, before, expected):
    """Yield what is wrong with what a case left behind."""
    after = fingerprint(folder)
    command, source, target, *_ = (*case.arguments, "")
    writes = outcome.code == 0 and (case.made or command in ("locate", "solve", "map", "convert"))
    target = case.made or target
    kept = [name for name in before if not (writes and name == case.made)]
    yield from (f"changed its input {name}" for name in kept if after.get(name) != before[name])
    if outcome.code == 3 and not case.may_fail:
        yield f"stopped by what it need not use: {outcome.stderr[:300]!r}"
    stem = Path(target).stem  # of what is written beside a file
    beside = {f"{stem}_points.ply", f"{stem}_cameras{Path(target).suffix}"} if writes else set()
    new = {Path(name).parts[0] for name in after.keys() - before.keys()} - beside
    if new != ({target} if writes and target not in before else set()):
        yield f"left {', '.join(sorted(new)) or 'nothing'} behind"
    yield from (f"left {name} behind" for name in after if name.startswith("tmp/"))
    if writes and (folder / target).is_dir():
        for written in sorted((folder / target).glob("*/")) if command == "map" else [folder / target]:
            yield from faults_of_tables(written) if command != "convert" else ()
            yield from faults_of_model(written) if command != "solve" else ()
    if case.same_answer and outcome.code:
        yield f"refused what is sound: {outcome.stderr[:300]!r}"
    elif case.same_answer:
        form = "database" if "--database" in case.arguments else source
        yield from ["another answer"] * differs(positions(folder / "out"), expected[form])


def _copy(base, folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if (base / name).is_dir() else shutil.copyfile)(base / name, folder / name)


def _choose_command(source, rng, *, database, locate_only=False):
    """Return a command that reads a model, most often locate."""
    choice = 1.0 if locate_only else rng.random()
    extra = ("--database", "database.db") if database else ()
    if choice < 0.1:
        return ("evaluate", *pick(rng, ((source, "truth"), ("truth", source))))
    if choice < 0.2:
        return ("inspect", source, *extra)
    adjust = ("--adjust", "full") if choice < 0.24 else ()
    json = ("--json",) if rng.random() < 0.3 else ()
    return ("locate", source, "out", *extra, *adjust, *json, "--threads", "1")


def _damage_model(kind, sources, suffix, damage, base, folder, rng):
    """One damaged file of a model, with or without a database."""
    source, database = pick(rng, sources), rng.random() < 0.3
    _copy(base, folder, source, "truth", *(["database.db"] if database else []))
    path = folder / source / f"{pick(rng, MODEL_FILES[: 3 if source == 'old' else 5])}{suffix}"
    label = f"{kind}: {path.name} {damage(path, rng)}"
    return Case(label, _choose_command(source, rng, database=database))


_binary = partial(_damage_model, "binary", ("sparse/0", "sparse/0", "old"), ".bin", mutations.damage_binary)
_text = partial(_damage_model, "text", ("text",), ".txt", mutations.damage_text)
_records = partial(_damage_model, "records", ("sparse/0",), ".bin", mutations.draw_records)


def _database(base, folder, rng):
    _copy(base, folder, "sparse/0", "database.db", "truth")
    way = pick(rng, databases.WAYS)
    same = way(folder / "database.db", rng)
    arguments = _choose_command("sparse/0", rng, database=True, locate_only=same)
    return Case(f"database: {way.__name__}", arguments, same_answer=same)


def _found(base, folder, rng):
    """A damaged database beside a sound model, which nobody asked for."""
    _copy(base, folder, "sparse/0", "database.db", "truth")
    way = pick(rng, (*databases.WAYS, *[databases.odd_cameras] * 3))
    way(folder / "database.db", rng)
    command = pick(rng, (("locate", "sparse/0", "out"), ("check", "sparse/0"), ("inspect", "sparse/0")))
    return Case(f"found: {way.__name__}", command, may_fail=False)


def _outputs(base, folder, rng):
    """A file to be made where an input, a link, a folder or something odd is."""
    _copy(base, folder, "sparse/0", "database.db", "truth", "priors.txt")
    earlier = pick(rng, ("earlier.csv", "earlier.glb", "earlier.html"))
    (folder / earlier).write_text("of before")
    (folder / "loop").symlink_to("loop")
    (folder / "nowhere").symlink_to("gone/away")
    (folder / "link").symlink_to("sparse")
    os.link(folder / "sparse/0/points3D.bin", folder / "hard.bin")
    os.mkfifo(folder / "fifo")
    target = pick(
        rng,
        (
            *(
                "new.csv",
                "new",
                "sparse/0/images.bin",
                "link/0/cameras.bin",
                "hard.bin",
                "database.db",
                earlier,
            ),
            *(
                "database.db-wal",
                "database.db-journal",
                "priors.txt",
                "truth",
                "loop",
                "nowhere",
                "fifo",
                ".",
            ),
            *("sparse/0/../0/points3D.bin", "gone/new.csv", "/dev/null", "/dev/full", "", "n" * 300, "a\0b"),
        ),
    )
    if "\0" in target:  # which no command line has
        target = "caf\udce9.csv"
    how = ("--overwrite",) if rng.random() < 0.7 else ()
    kinds = ("csv", "tum", "nerf", "glb", "ply")
    command = pick(
        rng,
        (
            ("convert", "sparse/0", target, "--format", pick(rng, kinds), "-q"),
            ("check", "sparse/0", "--report", target, "-q", *["--no-second-opinion"] * (rng.random() < 0.7)),
            ("check", "sparse/0", "--database", "database.db", "--report", target, "-q"),
            ("evaluate", "sparse/0", "truth", "--csv", target),
        ),
    )
    return Case(f"outputs: {command[0]} {how}", (*command, *how), made=target)


def _map(base, folder, rng):
    """A damaged database alone, from which `map` takes cameras and rotations too."""
    _copy(base, folder, "database.db")
    way = pick(rng, (*databases.WAYS, *[databases.odd_cameras] * 3))
    way(folder / "database.db", rng)
    flags = (*pick(rng, STAGES_OF_MAP), "--threads", "1")
    return Case(f"map: {way.__name__}", ("map", "database.db", "out", *flags))


def _graph(base, folder, rng):
    _copy(base, folder, "graph.txt")
    way = mutations.damage_text(folder / "graph.txt", rng)
    command = ("inspect", "graph.txt") if rng.random() < 0.15 else ("solve", "graph.txt", "out")
    return Case(f"graph: {way}", command)


def _table(base, folder, rng):
    """A damaged table of priors, of names or of options beside a sound model."""
    name = pick(rng, sorted(_TABLES))
    _copy(base, folder, "sparse/0", "database.db", name)
    way = mutations.damage_text(folder / name, rng)
    threads = () if name == "options.toml" else ("--threads", "1")
    command = ("locate", "sparse/0", "out", "--database", "database.db", _TABLES[name], name)
    return Case(f"table: {name} {way}", (*command, *threads))


def _foreign(base, folder, rng):
    """A damaged model of OpenSfM, or a damaged table of tracks beside it."""
    _copy(base, folder, "opensfm", "truth")
    path = folder / pick(rng, (_FOREIGN, _FOREIGN, "opensfm/tracks.csv"))
    further = [mutations.change_values] * 10 if path.suffix == ".json" else []
    way = mutations.damage_text(path, rng, *further)
    commands = (
        *(("convert", _FOREIGN, out) for out in ("out", "out", "out.json", "out.csv", "out.tum", "out.glb")),
        *(("locate", _FOREIGN, "out"), ("inspect", _FOREIGN), ("evaluate", _FOREIGN, "truth")),
    )
    return Case(f"foreign: {path.name} {way}", pick(rng, commands))


def _names(base, folder, rng):
    """Hostile but sound names, the same in the model and in the database: the answer must stay."""
    _copy(base, folder, "sparse/0", "database.db")
    path = folder / "sparse/0/images.bin"
    data = path.read_bytes()
    names = [field for field in binary_fields("images", data) if field.kind == "name"]
    chosen = rng.permutation(len(mutations.HOSTILE_NAMES))[: int(rng.integers(1, len(names) + 1))]
    for field, k in reversed([*zip(names, chosen.tolist(), strict=False)]):
        end = field.offset + field.size - 1
        old, new = data[field.offset : end], mutations.HOSTILE_NAMES[k]
        data = data[: field.offset] + new + data[end:]
        was = f"name = '{old.decode()}'"
        databases.set_values(folder / "database.db", "images", "name", new, was)
    path.write_bytes(data)
    arguments = _choose_command("sparse/0", rng, database=True, locate_only=True)
    return Case("names: hostile", arguments, same_answer=True)


def _place(base, folder, rng):
    """Something else in the place of a file."""
    _copy(base, folder, "sparse/0", "text", "database.db", "graph.txt", "truth")
    models = [form.format(name) for name in MODEL_FILES for form in ("sparse/0/{}.bin", "text/{}.txt")]
    target = pick(rng, (*models, "database.db", "graph.txt"))
    label = f"place: {mutations.misplace(folder / target, rng)} as {target}"
    if target == "graph.txt":
        return Case(label, ("solve", "graph.txt", "out"))
    source = "text" if target.startswith("text") else "sparse/0"
    return Case(label, _choose_command(source, rng, database=target == "database.db"))


_KINDS = (
    *(_binary, _binary, _binary, _text, _text, _records, _database, _database, _database, _map, _map),
    *(_graph, _graph, _table, _foreign, _names, _place, _found, _found, _outputs, _outputs),
)
