"""What every call must keep to, whatever its input: one sentence or a correct result, and no trace."""

import csv
import hashlib
import json
import math
import stat
from collections.abc import Iterator
from pathlib import Path

from abuse.layouts import binary_fields
from abuse.sandbox import MEMORY_LIMIT_BYTES, Outcome

MODEL_FILES = ("cameras", "images", "points3D", "rigs", "frames")
_REFUSALS = (2, 3, 4)
# Of the largest coordinate: names decide the order of images, and the solver stops at 1e-8.
_SAME_ANSWER = 1e-6


def snapshot(folder: Path) -> dict[str, str]:
    """Return what every entry below a folder is: the hash of a file, the target of a link, or its kind."""
    found = {}
    for path in sorted(folder.rglob("*")):
        mode = path.lstat().st_mode
        if stat.S_ISREG(mode):
            found[str(path.relative_to(folder))] = hashlib.sha256(path.read_bytes()).hexdigest()
        elif stat.S_ISLNK(mode):
            found[str(path.relative_to(folder))] = f"-> {path.readlink()}"
        else:
            found[str(path.relative_to(folder))] = f"kind {stat.S_IFMT(mode):o}"
    return found


def faults(outcome: Outcome) -> Iterator[str]:
    """Yield what is wrong with how a call ended, whatever it wrote."""
    if outcome.code < 0:
        yield f"ended by signal {-outcome.code} after {outcome.cpu_s:.1f} s"
    elif outcome.code not in (0, *_REFUSALS):
        yield f"exit code {outcome.code}"
    if outcome.peak_bytes > MEMORY_LIMIT_BYTES:
        yield f"{outcome.peak_bytes / 1e9:.1f} GB of memory"
    if outcome.deeds:
        yield f"did {outcome.deeds[0]}"
    if "Traceback" in outcome.stderr:
        yield "a traceback"
    text = outcome.stderr
    if outcome.code == 0 and text:
        yield f"stderr in spite of success: {text[:200]!r}"
    if outcome.stdout and outcome.code == 3:
        yield "stdout in spite of a refusal"
    if outcome.code not in (3, 4):
        return
    if not text.startswith("sfm-shapefit: ") or text.count("\n") != 1 or not text.endswith("\n"):
        yield f"not one sentence: {text[:300]!r}"
    if not text[:-1].isprintable():
        yield "control characters in the sentence"
    if "memory" in text:
        yield f"asked for too much memory: {text[:200]!r}"


def faults_of_tables(out: Path) -> Iterator[str]:
    """Yield what is wrong with the tables of an output folder."""
    facts = json.loads((out / "locate.json").read_text(encoding="utf-8"))
    rows = read_cameras(out)
    placed = [row for row in rows if row["placed"] == "true"]
    axes = [name for name in rows[0] if name in "xyz" or name.startswith("x")] if rows else []
    if any(not math.isfinite(float(row[axis] or "nan")) for row in placed for axis in axes):
        yield "a placed camera without a finite center"
    if any(row[axis] for row in rows if row["placed"] != "true" and not row["piece"] for axis in axes):
        yield "a camera that is not placed has a center"
    if facts["num_placed"] != len(placed):
        yield f"{facts['num_placed']} placed in locate.json, {len(placed)} in cameras.csv"
    gap = facts["solve"]["gap"]
    if gap is None or not math.isfinite(gap):
        yield "the certificate is not finite"


def faults_of_model(out: Path) -> Iterator[str]:
    """Yield what is wrong with a written model: every file must have COLMAP's layout and finite numbers."""
    for name in MODEL_FILES:
        data = (out / f"{name}.bin").read_bytes()
        try:
            fields = binary_fields(name, data)
        except (ValueError, IndexError, KeyError, ArithmeticError) as error:
            yield f"{name}.bin of the output is broken: {error}"
            continue
        numbers = (data[f.offset : f.offset + 8] for f in fields if f.kind == "d")
        if any(number[7] & 0x7F == 0x7F and number[6] & 0xF0 == 0xF0 for number in numbers):
            yield f"{name}.bin of the output holds a number that is not finite"


def read_cameras(out: Path) -> list[dict[str, str]]:
    """Return the rows of cameras.csv."""
    with (out / "cameras.csv").open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def positions(out: Path) -> list[tuple[float, ...]]:
    """Return the centers of the placed cameras, sorted: they identify cameras whose names were changed."""
    rows = (row for row in read_cameras(out) if row["placed"] == "true")
    return sorted(tuple(float(row[axis]) for axis in "xyz") for row in rows)


def differs(found: list[tuple[float, ...]], expected: list[tuple[float, ...]]) -> bool:
    """Tell whether two lists of positions differ by more than rounding."""
    if len(found) != len(expected):
        return True
    size = max(abs(x) for row in expected for x in row)
    pairs = zip(found, expected, strict=True)
    return any(abs(x - y) > _SAME_ANSWER * size for a, b in pairs for x, y in zip(a, b, strict=True))
