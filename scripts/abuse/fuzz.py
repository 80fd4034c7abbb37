"""Hostile and broken input: thousands of damaged models, databases and graphs through the real commands.

Case k of seed s is always the same, so a failure is repeated by `--only k`. Each runs in a forked child of
one warm process (see `abuse/sandbox.py`) in a folder of its own, and must end in a correct result or in one
sentence with exit code 2, 3 or 4; where the damage does not concern what is asked, the answer must stay.
"""

import argparse
import collections
import contextlib
import io
import os
import shutil
import sqlite3
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
from numpy.random import Generator

from abuse import databases, mutations, strangers
from abuse.layouts import binary_fields, cut_records
from abuse.mutations import Case
from abuse.sandbox import Outcome, run_forked
from abuse.verdicts import (
    MODEL_FILES,
    differs,
    faults,
    faults_of_model,
    faults_of_tables,
    positions,
    snapshot,
)

HELP = "damaged models, databases and graphs through the commands"
_OLD_FILES = ("cameras", "images", "points3D")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="first case: to go on where a run ended")
    parser.add_argument("--only", type=int, help="run this case alone, and keep its folder")
    parser.add_argument("--work", type=Path, help="where cases are made; a temporary folder by default")


def run(args: argparse.Namespace) -> int:
    """Run all cases, print what failed and a summary; 1 if any failed."""
    with tempfile.TemporaryDirectory() as temporary:
        work = (args.work or Path(temporary)).resolve()
        base = make_base(work / "base")
        expected = warm(base)
        numbers = range(args.first, args.first + args.cases) if args.only is None else [args.only]
        start = time.perf_counter()
        done: list[tuple[str, Outcome]] = []
        failed = 0
        with contextlib.suppress(KeyboardInterrupt):  # which ends it early, with the figures so far
            for number in numbers:
                case, outcome, found = try_case(base, work / "case", [args.seed, number], expected)
                done.append((case.label.partition(":")[0], outcome))
                if found:
                    failed += 1
                    print(f"case {number} ({case.label}): {'; '.join(found)}")
                    print(f"    {' '.join(case.arguments)}: {outcome.stderr[-1200:]}", flush=True)
                if args.only is not None:
                    print(case, outcome)
        print(f"{len(done)} cases, {failed} failed, in {time.perf_counter() - start:.0f} s")
        slowest_s = max((outcome.cpu_s for _, outcome in done), default=0.0)
        largest_gb = max((outcome.peak_bytes for _, outcome in done), default=0) / 1e9
        print(f"slowest {slowest_s:.1f} s of processor time, largest {largest_gb:.2f} GB")
        for (kind, code), count in sorted(collections.Counter((k, o.code) for k, o in done).items()):
            print(f"{kind:10} exit {code:3}: {count}")
    return int(failed > 0)


def make_base(folder: Path) -> Path:
    """Write a small sound scene in every form that is read, of COLMAP and of others."""
    import pycolmap

    from sfm_shapefit.synthetic import SceneOptions, WorkspaceOptions, make_scene
    from sfm_shapefit.synthetic.workspace import write_workspace

    options = SceneOptions(shape="cloud", num_images=6, num_points=60, pixel_noise_px=0.2, min_matches=15)
    shutil.rmtree(folder, ignore_errors=True)
    write_workspace(make_scene(options), folder, WorkspaceOptions(relative_poses=True))
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    for name in ("text", "truth"):
        (folder / name).mkdir()
    model.write_text(folder / "text")
    model.write_binary(folder / "truth")
    shutil.copytree(strangers.SAMPLES, folder, dirs_exist_ok=True)
    shutil.copytree(folder / "sparse" / "0", folder / "old")
    for name in ("rigs", "frames"):
        (folder / "old" / f"{name}.bin").unlink()
    return folder


def warm_locate(base: Path) -> dict[str, list[tuple[float, ...]]]:
    """Run `locate` once on every form of the model, and return the positions that each form leads to.

    So this process has loaded what its children call.
    """
    expected = {}
    out = base.parent / "warm"
    database = ("--database", str(base / "database.db"))
    for form, extra in {"sparse/0": database, "old": (), "text": ()}.items():
        _command("locate", str(base / form), str(out), *extra, "--threads", "1", "-q")
        expected["database" if extra else form] = positions(out)
        shutil.rmtree(out)
    return expected


def warm(base: Path) -> dict[str, list[tuple[float, ...]]]:
    """Run every command once in this process, so that the children find all code loaded and compiled.

    Returns the positions that each form of the input leads to.
    """
    expected = warm_locate(base)
    out = base.parent / "warm"
    database = ("--database", str(base / "database.db"))
    old = ("locate", str(base / "old"), str(out), "--overwrite", "--threads", "1", "-q")
    for command in (
        (*old, *database),
        (*old, "--adjust", "full"),
        (*old, *database, "--rotations", "free"),
        ("solve", str(base / "graph.txt"), str(out), "--overwrite", "-q"),
        ("locate", str(base / "openmvg/sfm_data.json"), str(out), "--overwrite", "--threads", "1", "-q"),
        (*old, *database, "--priors", str(base / "priors.txt"), "--refine-with-priors"),
        (*old, *database, "--fix", str(base / "fix.txt")),
        ("evaluate", str(base / "opensfm/reconstruction.json"), str(base / "truth")),
        ("inspect", str(base / "bundler/bundle.out")),
        *(
            ("map", str(base / "database.db"), str(out), "--overwrite", "--threads", "1", "-q", *stages)
            for stages in strangers.STAGES_OF_MAP
        ),
    ):
        _command(*command)
    shutil.rmtree(out)
    return expected


def _command(*arguments: str) -> None:
    """Run a sound command in this process."""
    from typer.testing import CliRunner

    from sfm_shapefit.cli import app

    with contextlib.redirect_stdout(io.StringIO()):
        result = CliRunner().invoke(app, list(arguments))
    if result.exit_code:
        raise RuntimeError(f"{' '.join(arguments)} failed: {result.output} {result.exception!r}")


def try_case(
    base: Path, folder: Path, seed: list[int], expected: dict[str, list[tuple[float, ...]]]
) -> tuple[Case, Outcome, list[str]]:
    """Make, run and judge a case, whose folder stays until the next one."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "tmp").mkdir(parents=True)
    rng = np.random.default_rng(seed)
    case = mutations.pick(rng, _KINDS)(base, folder, rng)
    before = snapshot(folder)
    main = partial(command_line, case.arguments, folder / "tmp")
    encoding = "ascii" if rng.random() < 0.1 else "utf-8"
    outcome = run_forked(main, folder, [folder, *caches()], encoding=encoding)
    return case, outcome, list(_judge(case, outcome, folder, before, expected))


def command_line(arguments: tuple[str, ...], temporary: Path) -> None:
    """Be `sfm-shapefit`, in a child."""
    from sfm_shapefit.cli import main

    tempfile.tempdir = str(temporary)
    sys.argv = ["sfm-shapefit", *arguments]
    main()


def caches() -> list[Path]:
    """Return where numba keeps compiled code."""
    own = Path(__file__).resolve().parents[2] / "sfm_shapefit"
    return [own, *([Path(os.environ["NUMBA_CACHE_DIR"])] if "NUMBA_CACHE_DIR" in os.environ else [])]


def _judge(
    case: Case,
    outcome: Outcome,
    folder: Path,
    before: dict[str, str],
    expected: dict[str, list[tuple[float, ...]]],
) -> Iterator[str]:
    yield from faults(outcome)
    after = snapshot(folder)
    changed = [name for name in before if after.get(name) != before[name]]
    if changed:
        yield f"changed its input {changed[0]}"
    new = sorted({Path(name).parts[0] for name in after.keys() - before.keys()})
    writes = outcome.code == 0 and case.arguments[0] in ("locate", "solve", "map", "convert")
    if new != ([case.arguments[2]] if writes else []):
        yield f"left {', '.join(new) or 'nothing'} behind"
    strays = [name for name in after if name.startswith("tmp/")]
    if strays:
        yield f"left {strays[0]} behind"
    if writes and (folder / case.arguments[2]).is_dir():
        out = folder / case.arguments[2]
        for written in sorted(out.glob("*/")) if case.arguments[0] == "map" else [out]:
            yield from faults_of_tables(written) if case.arguments[0] != "convert" else ()
            yield from faults_of_model(written) if case.arguments[0] != "solve" else ()
    if case.same_answer:
        if outcome.code:
            yield f"refused what is sound: {outcome.stderr[:300]!r}"
        form = "database" if "--database" in case.arguments else case.arguments[1]
        if not outcome.code and differs(positions(folder / "out"), expected[form]):
            yield "another answer"


def _choose_command(
    source: str, rng: Generator, *, database: bool, locate_only: bool = False
) -> tuple[str, ...]:
    """Return a command that reads a model, most often locate."""
    choice = 1.0 if locate_only else rng.random()
    extra = ("--database", "database.db") if database else ()
    if choice < 0.1:
        return ("evaluate", *mutations.pick(rng, ((source, "truth"), ("truth", source))))
    if choice < 0.2:
        return ("inspect", source, *extra)
    adjust = ("--adjust", "full") if choice < 0.24 else ()
    json = ("--json",) if rng.random() < 0.3 else ()
    return ("locate", source, "out", *extra, *adjust, *json, "--threads", "1")


def _copy(base: Path, folder: Path, *names: str) -> None:
    for name in names:
        if (base / name).is_dir():
            shutil.copytree(base / name, folder / name)
        else:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(base / name, folder / name)


def _binary(base: Path, folder: Path, rng: Generator) -> Case:
    """One damaged binary file; if it holds points, which a database makes superfluous, the answer stays."""
    source = str(mutations.pick(rng, ("sparse/0", "sparse/0", "old")))
    database = rng.random() < 0.3
    _copy(base, folder, source, "truth", *(["database.db"] if database else []))
    name = str(mutations.pick(rng, MODEL_FILES if source != "old" else _OLD_FILES))
    path = folder / source / f"{name}.bin"
    data = path.read_bytes()
    fields = binary_fields(name, data)
    ways = (*[mutations.change_fields] * 3, mutations.cut_at_field, mutations.shuffle_fields)
    way = mutations.pick(rng, (*ways, mutations.change_bytes, mutations.change_bytes))
    path.write_bytes(way(data, rng) if way is mutations.change_bytes else way(data, fields, rng))
    return Case(f"binary: {name} {way.__name__}", _choose_command(source, rng, database=database))


def _text(base: Path, folder: Path, rng: Generator) -> Case:
    database = rng.random() < 0.3
    _copy(base, folder, "text", "truth", *(["database.db"] if database else []))
    name = str(mutations.pick(rng, MODEL_FILES))
    way = mutations.damage_text(folder / "text" / f"{name}.txt", rng)
    return Case(f"text: {name} {way}", _choose_command("text", rng, database=database))


def _database(base: Path, folder: Path, rng: Generator) -> Case:
    _copy(base, folder, "sparse/0", "database.db", "truth")
    way = mutations.pick(rng, databases.WAYS)
    same = way(folder / "database.db", rng)
    arguments = _choose_command("sparse/0", rng, database=True, locate_only=same)
    return Case(f"database: {way.__name__}", arguments=arguments, same_answer=same)


def _graph(base: Path, folder: Path, rng: Generator) -> Case:
    _copy(base, folder, "graph.txt")
    way = mutations.damage_text(folder / "graph.txt", rng)
    command = ("inspect", "graph.txt") if rng.random() < 0.15 else ("solve", "graph.txt", "out")
    return Case(f"graph: {way}", command)


def _names(base: Path, folder: Path, rng: Generator) -> Case:
    """Hostile but sound names, the same in the model and in the database: the answer must stay."""
    _copy(base, folder, "sparse/0", "database.db")
    path = folder / "sparse" / "0" / "images.bin"
    data = path.read_bytes()
    names = [field for field in binary_fields("images", data) if field.kind == "name"]
    chosen = rng.permutation(len(mutations.HOSTILE_NAMES))[: int(rng.integers(1, len(names) + 1))]
    with closing(sqlite3.connect(folder / "database.db")) as connection:
        for field, k in sorted(zip(names, chosen, strict=False), key=lambda item: -item[0].offset):
            old, new = data[field.offset : field.offset + field.size - 1], mutations.HOSTILE_NAMES[int(k)]
            data = data[: field.offset] + new + data[field.offset + field.size - 1 :]
            connection.execute("UPDATE images SET name = CAST(? AS TEXT) WHERE name = ?", (new, old.decode()))
        connection.commit()
    path.write_bytes(data)
    arguments = _choose_command("sparse/0", rng, database=True, locate_only=True)
    return Case("names: hostile", arguments, same_answer=True)


def _place(base: Path, folder: Path, rng: Generator) -> Case:
    """Something else in the place of a file, or a place for OUT that cannot be."""
    _copy(base, folder, "sparse/0", "text", "database.db", "graph.txt", "truth")
    models = (
        *(f"sparse/0/{name}.bin" for name in MODEL_FILES),
        *(f"text/{name}.txt" for name in MODEL_FILES),
    )
    target = str(mutations.pick(rng, (*models, "database.db", "graph.txt")))
    kind = mutations.misplace(folder / target, rng)
    if target == "graph.txt":
        return Case(f"place: {kind}", ("solve", "graph.txt", "out"))
    source = "text" if target.startswith("text") else "sparse/0"
    arguments = _choose_command(source, rng, database=target == "database.db")
    return Case(f"place: {kind} as {target}", arguments)


def _several(base: Path, folder: Path, rng: Generator) -> Case:
    """All files of a model damaged consistently: records removed or repeated with the count put right."""
    _copy(base, folder, "sparse/0", "truth")
    name = str(mutations.pick(rng, MODEL_FILES))
    path = folder / "sparse" / "0" / f"{name}.bin"
    records = cut_records(name, path.read_bytes())
    order = rng.integers(len(records), size=int(rng.integers(0, 2 * len(records) + 1)))
    if rng.random() < 0.5:
        order = rng.permutation(len(records))[: int(rng.integers(0, len(records) + 1))]
    path.write_bytes(struct.pack("<Q", len(order)) + b"".join(records[int(k)] for k in order))
    return Case(f"records: {name}", _choose_command("sparse/0", rng, database=False))


_KINDS: tuple[Callable[[Path, Path, Generator], Case], ...] = (
    *(_binary, _binary, _binary, _text, _text, _database, _database, _database, _graph, _graph),
    *(_names, _place, _several),
    *(
        strangers.damage_stranger,
        strangers.damage_database,
        strangers.damage_database,
        strangers.damage_table,
    ),
)
