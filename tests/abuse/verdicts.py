"""What every call must keep to, whatever its input: one sentence or a correct result, and no trace."""

import json
import math
import struct

import numpy as np

from tests.abuse.layouts import MODEL_FILES, binary_fields
from tests.abuse.sandbox import MEMORY_LIMIT_BYTES
from tests.scenes import rows_of

# Share of the largest coordinate: names decide the order of images, and the solver stops at 1e-8.
_SAME_ANSWER = 1e-6


def faults(outcome):
    """Yield what is wrong with how a call ended, whatever it wrote."""
    code, text = outcome.code, outcome.stderr
    if code not in (0, 2, 3, 4):
        yield f"ended by signal {-code} after {outcome.cpu_s:.1f} s" if code < 0 else f"exit code {code}"
    if outcome.peak_bytes > MEMORY_LIMIT_BYTES:
        yield f"{outcome.peak_bytes / 1e9:.1f} GB of memory"
    if outcome.deeds:
        yield f"did {outcome.deeds[0]}"
    if "Traceback" in text:
        yield "a traceback"
    if code == 0 and text:
        yield f"stderr in spite of success: {text[:200]!r}"
    if outcome.stdout and code == 3:
        yield "stdout in spite of a refusal"
    if code not in (3, 4):
        return
    if not text.startswith("sfm-shapefit: ") or text.count("\n") != 1 or not text.endswith("\n"):
        yield f"not one sentence: {text[:300]!r}"
    if not text[:-1].isprintable():
        yield "control characters in the sentence"
    if "memory" in text:
        yield f"asked for too much memory: {text[:200]!r}"


def faults_of_tables(out):
    """Yield what is wrong with the tables of an output folder."""
    facts = json.loads((out / "locate.json").read_text(encoding="utf-8"))
    rows = rows_of(out / "cameras.csv")
    placed = [row for row in rows if row["placed"] == "true"]
    axes = [name for name in rows[0] if name in "xyz" or name.startswith("x")] if rows else []
    if any(not math.isfinite(float(row[axis] or "nan")) for row in placed for axis in axes):
        yield "a placed camera without a finite center"
    if any(row[axis] for row in rows if row["placed"] != "true" and not row["piece"] for axis in axes):
        yield "a camera that is not placed has a center"
    if facts["num_placed"] != len(placed):
        yield f"{facts['num_placed']} placed in locate.json, {len(placed)} in cameras.csv"
    if not math.isfinite(facts["solve"]["gap"] or math.nan):
        yield "the certificate is not finite"


def faults_of_model(out):
    """Yield what is wrong with a written model: every file must have COLMAP's layout and finite numbers."""
    for name in MODEL_FILES:
        data = (out / f"{name}.bin").read_bytes()
        try:
            offsets = [field.offset for field in binary_fields(name, data) if field.kind == "d"]
        except (ValueError, IndexError, KeyError, struct.error) as error:
            yield f"{name}.bin of the output is broken: {error}"
            continue
        if not all(math.isfinite(struct.unpack_from("<d", data, offset)[0]) for offset in offsets):
            yield f"{name}.bin of the output holds a number that is not finite"


def positions(out):
    """Return the centers of the placed cameras, sorted: they identify cameras whose names were changed."""
    rows = (row for row in rows_of(out / "cameras.csv") if row["placed"] == "true")
    return sorted(tuple(float(row[axis]) for axis in "xyz") for row in rows)


def differs(found, expected):
    """Tell whether two lists of positions differ by more than rounding."""
    if len(found) != len(expected):
        return True
    return bool(np.abs(np.subtract(found, expected)).max() > _SAME_ANSWER * np.abs(expected).max())
