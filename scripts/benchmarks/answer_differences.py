"""How two recordings of `answers` differ: nested values compared leaf by leaf.

Positions and rotations count as shares of the scene's extent and of a quaternion's length; other numbers
relative to the larger of the two, and below `ROUNDOFF` they are equal. Strings of several words are wording,
which a change of code may improve: they are told, and do not count. Single words, such as verdicts, are
values. Where answers must be equal to the bit, all numbers are, and the bytes of the models' files.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from harness.record import leave_out

NOT_COMPARED = {
    *("options", "timings_s", "seconds", "versions", "schema_version", "expected"),
    *("num_pairs_filtered", "theory"),
}
"""Keys of JSON objects, wherever they stand, that tell of the run and not of its answer (names of stages are
keys of `timings_s` and `expected`), or of features that left."""
ROUNDOFF = 1e-9
_LIMITS = {"positions": 1e-6, "rotations": 1e-6, "figures": 1e-5}
_PARTS = ("exit", "verdict", "said", "printed", "files", "models", "tables", "json", "texts", "pages")
_EXACT_PARTS = (*_PARTS, "digests")
_MEMORY_SHARE, _MEMORY_MB = 0.02, 5.0
"""Change of a peak that is told: beyond both."""
_SHOWN = 3
_KEYS = ("name", "name1", "name2")


class Difference(NamedTuple):
    """One thing that differs, or the worst position or rotation of a model, which may be equal."""

    where: str
    text: str
    kind: str = "values"
    amount: float = math.inf

    def counts(self, exact: bool) -> bool:
        """Return whether it is beyond its limit; NaN is."""
        limit = 0.0 if exact else _LIMITS.get(self.kind, -1.0)
        return self.kind != "words" and not self.amount <= limit


class Vectors(dict[str, list[float]]):
    """Positions or rotations by name, which are compared as a whole."""

    kind = "positions"


class Rotations(Vectors):
    """Quaternions, which have two signs."""

    kind = "rotations"


def compare(old: dict[str, Any], new: dict[str, Any], *, exact: bool = False) -> list[Difference]:
    """Return how two answers of one case differ, and the worst position and rotation of each model."""
    parts = _EXACT_PARTS if exact else _PARTS
    return [d for part in parts for d in _walk(part, _part(old, part), _part(new, part), exact)]


def _part(answer: dict[str, Any], part: str) -> Any:
    """Return a part of an answer, with models and tables by name."""
    if part == "models":
        return {key: _by_image(model) for key, model in answer[part].items()}
    if part == "tables":
        return {key: _by_row(columns) for key, columns in answer[part].items()}
    return leave_out(NOT_COMPARED, answer[part])


def _by_image(model: dict[str, Any]) -> dict[str, Any]:
    poses = model["poses"].items()
    return {
        "images": sorted(model["poses"]),
        "positions": Vectors({name: pose[:3] for name, pose in poses}),
        "rotations": Rotations({name: pose[3:] for name, pose in poses}),
        "structure": model["structure"],
    }


def _by_row(columns: dict[str, list[str]]) -> dict[str, Any]:
    """Return the rows of a table by their names, and apart from them the positions that are known."""
    rows, positions, axes = {}, Vectors(), [axis for axis in "xyz" if axis in columns]
    for k, cells in enumerate(zip(*columns.values(), strict=True)):
        row = dict(zip(columns, cells, strict=True))
        name = " ".join(row.pop(key) for key in _KEYS if key in row) or f"row {k}"
        position = [row.pop(axis) for axis in axes]
        if axes and all(position):
            positions[name] = [float(coordinate) for coordinate in position]
        rows[name] = row
    return {"columns": list(columns), "order": list(rows), "positions": positions, "rows": rows}


def _walk(where: str, old: Any, new: Any, exact: bool) -> Iterator[Difference]:
    """Yield how two nested values differ."""
    if isinstance(old, Vectors) and isinstance(new, Vectors):
        yield from _compare_vectors(where, old, new)
    elif isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys([*old, *new]):
            if key in old and key in new:
                yield from _walk(f"{where} {key}", old[key], new[key], exact)
            else:
                yield Difference(f"{where} {key}", "missing" if key in old else "new")
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for k, (a, b) in enumerate(zip(old, new, strict=True)):
            yield from _walk(f"{where}[{k}]", a, b, exact)
    elif type(old) is not type(new) or old != new:
        yield from _compare_leaves(where, old, new, exact)


def _compare_vectors(where: str, old: Vectors, new: Vectors) -> Iterator[Difference]:
    """Yield the worst of the names that both have, and that others have no vector any more or newly."""
    if old.keys() != new.keys():
        yield Difference(where, f"{len(old)} -> {len(new)}, of other names")
    names = [name for name in old if name in new]
    if not names:
        return
    a, b = (np.array([vectors[name] for name in names]) for vectors in (old, new))
    if isinstance(old, Rotations):
        b = b * np.where(np.sum(a * b, axis=1, keepdims=True) < 0.0, -1.0, 1.0)
        amounts = np.abs(a - b).max(axis=1)
    else:
        amounts = np.linalg.norm(a - b, axis=1) / (float(np.linalg.norm(np.ptp(a, axis=0))) or 1.0)
    worst = int(np.argmax(np.where(np.isnan(amounts), np.inf, amounts)))
    yield Difference(f"{where} {names[worst]}", f"{amounts[worst]:.1e}", old.kind, float(amounts[worst]))


def _compare_leaves(where: str, old: Any, new: Any, exact: bool) -> Iterator[Difference]:
    """Yield how two unequal values differ: as numbers if they are, as strings may be."""
    text = f"{repr(old)[:150]} -> {repr(new)[:150]}"
    a, b = _number(old), _number(new)
    if a is None or b is None:
        is_wording = all(isinstance(value, str) and len(value.split()) > 1 for value in (old, new))
        yield Difference(where, text, "words" if is_wording else "values")
    elif not (a == b or (math.isnan(a) and math.isnan(b)) or (abs(a - b) <= ROUNDOFF and not exact)):
        amount = abs(a - b) / max(abs(a), abs(b))
        if exact or not amount <= _LIMITS["figures"]:
            yield Difference(where, f"{text}, {amount:.1e}", "figures", amount)


def _number(value: Any) -> float | None:
    """Return a number, or that which a string of a table says; None for anything else."""
    if isinstance(value, str):
        try:
            return int(value) if value.lstrip("-").isdigit() else float(value)
        except ValueError:
            return None
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None


def report(differences: dict[str, list[Difference]], *, exact: bool = False) -> tuple[str, bool]:
    """Return what is to be said of the differences of each case, and whether all cases are equal."""
    lines, num_equal = [], 0
    for case, found in differences.items():
        counting = sorted((d for d in found if d.counts(exact)), key=lambda d: -d.amount)
        num_equal += not counting
        lines += [f"{case}: {d.where} {d.text}" for d in counting[:_SHOWN]]
        lines += [f"{case}: and {len(counting) - _SHOWN} more"] * (len(counting) > _SHOWN)
    words = [
        f"  {case}: {d.where} {d.text}"
        for case, found in differences.items()
        for d in found
        if d.kind == "words"
    ]
    if words:
        lines += [f"words ({len(words)}), which do not count:", *words]
    for kind in ("positions", "rotations"):
        amounts = [d.amount for found in differences.values() for d in found if d.kind == kind]
        if amounts:
            lines.append(f"worst of {kind}: {np.max(amounts):.1e}")
    how = "to the bit" if exact else "within the limits"
    lines.append(f"{num_equal} of {len(differences)} cases equal {how}")
    return "\n".join(lines), num_equal == len(differences)


def compare_use(pairs: dict[str, tuple[dict[str, Any], dict[str, Any]]]) -> tuple[str, bool]:
    """Return what is to be said of memory and CPU time, and whether no peak has grown."""
    if not pairs:
        return "", True
    lines, is_within = [], True
    for key, name in (("memory_mb", "peak memory"), ("cpu_s", "CPU time")):
        ratios = [new[key] / old[key] for old, new in pairs.values() if old[key] > 0.0]
        sums = [sum(answer[key] for answer in answers) for answers in zip(*pairs.values(), strict=True)]
        lines.append(f"{name}: median ratio {np.median(ratios):.3f}, of the sums {sums[1] / sums[0]:.3f}")
    for case, (old, new) in pairs.items():
        before, now = old["memory_mb"], new["memory_mb"]
        if abs(now - before) > max(_MEMORY_MB, _MEMORY_SHARE * before):
            lines.append(f"  {case}: peak {before:.0f} -> {now:.0f} MB, {now / before - 1.0:+.1%}")
            is_within &= now < before
    return "\n".join(lines), is_within
