"""How two recordings of `answers` differ: by how much positions, rotations and figures, and which words.

Positions count as shares of the scene's extent; other numbers relative to the larger of the two, and below
`ROUNDOFF` they are equal. Strings of several words are wording, which a change of code may improve; single
words, such as verdicts, are values.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.record import table

POSITION, ROTATION, FIGURE, ROUNDOFF = 1e-9, 1e-9, 1e-7, 1e-12
KINDS = ("exit", "positions", "rotations", "figures", "values", "words")
_LIMITS = {"positions": POSITION, "rotations": ROTATION, "figures": FIGURE}
_SHOWN = 3
_KEYS = ("name", "name1", "name2")


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """One thing that differs, or a position or rotation that does not by more than its limit."""

    case: str
    kind: str
    where: str
    amount: float = math.inf
    text: str = ""

    @property
    def counts(self) -> bool:
        """Whether it is beyond its limit."""
        return not self.amount <= _LIMITS.get(self.kind, -1.0)  # NaN counts


def compare(name: str, old: dict[str, Any], new: dict[str, Any]) -> list[Difference]:
    """Return how two answers of one case differ, and the worst position and rotation of each model."""
    found = [*_trees(name, "exit", old["exit"], new["exit"], kind="exit")]
    for part in ("models", "tables"):
        for key in sorted({*old[part], *new[part]}):
            a, b = old[part].get(key), new[part].get(key)
            if a is None or b is None:
                found.append(_value(name, f"{part[:-1]} {key}", "missing" if b is None else "new"))
            else:
                found += (_models if part == "models" else _tables)(name, key, a, b)
    for part in ("files", "json", "texts", "said", "printed"):
        found += _trees(name, part, old[part], new[part])
    return found


def _value(case: str, where: str, text: str, kind: str = "values") -> Difference:
    return Difference(case=case, kind=kind, where=where, text=text)


def _models(case: str, key: str, old: dict[str, Any], new: dict[str, Any]) -> Iterator[Difference]:
    yield from _trees(case, f"{key}: images", sorted(old["poses"]), sorted(new["poses"]))
    names = sorted(set(old["poses"]) & set(new["poses"]))
    if names:
        a, b = (np.array([model["poses"][name] for name in names]) for model in (old, new))
        yield _worst(case, "positions", key, names, _move(a[:, :3], b[:, :3]))
        sign = np.sign(np.sum(a[:, 3:] * b[:, 3:], axis=1, keepdims=True))
        yield _worst(case, "rotations", key, names, np.abs(a[:, 3:] - sign * b[:, 3:]).max(axis=1))
    yield from _trees(case, f"{key}: structure", old["structure"], new["structure"])


def _move(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return how far each position moved, as a share of the old ones' extent."""
    extent = float(np.linalg.norm(np.ptp(a, axis=0))) or 1.0
    return np.linalg.norm(a - b, axis=1) / extent


def _worst(case: str, kind: str, where: str, names: list[str], amounts: np.ndarray) -> Difference:
    worst = int(np.argmax(np.where(np.isnan(amounts), np.inf, amounts)))
    return Difference(case=case, kind=kind, where=f"{where} {names[worst]}", amount=float(amounts[worst]))


def _tables(
    case: str, key: str, old: dict[str, list[str]], new: dict[str, list[str]]
) -> Iterator[Difference]:
    """Compare the rows of a table by their names, column by column."""
    yield from _trees(case, f"{key}: columns", list(old), list(new))
    rows = [_rows(old), _rows(new)]
    if list(rows[0]) != list(rows[1]):
        gone, added = len(rows[0].keys() - rows[1].keys()), len(rows[1].keys() - rows[0].keys())
        yield _value(case, f"{key}: rows", f"{gone} gone, {added} new; or in another order")
    names = [name for name in rows[0] if name in rows[1]]
    axes = [name for name in old if name in new and name in ("x", "y", "z")]
    both = [name for name in names if all(row[name][axis] for row in rows for axis in axes)]
    if axes and both:
        a, b = (np.array([[float(row[n][axis]) for axis in axes] for n in both]) for row in rows)
        yield _worst(case, "positions", key, both, _move(a, b))
    for column in [name for name in old if name in new and name not in axes and name not in _KEYS]:
        differing = [
            d
            for name in names
            for d in _texts(case, f"{key}: {column} of {name}", rows[0][name][column], rows[1][name][column])
        ]
        for kind in KINDS:
            same = [d for d in differing if d.kind == kind]
            if same:
                worst = max(same, key=lambda d: d.amount)
                text = f"{worst.text} ({len(same)} rows)"
                yield Difference(case=case, kind=kind, where=worst.where, amount=worst.amount, text=text)


def _rows(columns: dict[str, list[str]]) -> dict[str, dict[str, str]]:
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    names = [" ".join(row[key] for key in _KEYS if key in row) for row in rows]
    return {name or f"row {k}": row for k, (name, row) in enumerate(zip(names, rows, strict=True))}


def _trees(case: str, where: str, old: Any, new: Any, kind: str = "values") -> Iterator[Difference]:
    """Compare what JSON can hold."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(key for key in new if key not in old)]:
            if key in old and key in new:
                yield from _trees(case, f"{where}.{key}", old[key], new[key], kind)
            else:
                yield _value(case, f"{where}.{key}", "missing" if key in old else "new", kind)
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for k, (a, b) in enumerate(zip(old, new, strict=True)):
            yield from _trees(case, f"{where}[{k}]", a, b, kind)
    elif isinstance(old, list) and isinstance(new, list):
        yield _value(case, where, f"{len(old)} entries -> {len(new)}", kind)
    elif _is_number(old) and _is_number(new):
        yield from _numbers(case, where, old, new, kind)
    elif isinstance(old, str) and isinstance(new, str):
        yield from _texts(case, where, old, new, kind)
    elif old != new or type(old) is not type(new):
        yield _value(case, where, f"{_short(old)} -> {_short(new)}", kind)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _numbers(case: str, where: str, old: float, new: float, kind: str = "values") -> Iterator[Difference]:
    if old == new or (math.isnan(old) and math.isnan(new)):
        return
    text = f"{old!r} -> {new!r}"
    if kind == "exit" or (isinstance(old, int) and isinstance(new, int)):
        yield _value(case, where, text, kind)
    elif not abs(old - new) <= ROUNDOFF:
        amount = abs(old - new) / max(abs(old), abs(new))
        amount = math.inf if math.isnan(amount) else amount
        if amount > FIGURE:
            yield Difference(case=case, kind="figures", where=where, amount=amount, text=text)


def _texts(case: str, where: str, old: str, new: str, kind: str = "values") -> Iterator[Difference]:
    """Compare two strings: as numbers if they are, and say whether it is wording that differs."""
    if old == new:
        return
    try:
        numbers = [int(text) if text.lstrip("-").isdigit() else float(text) for text in (old, new)]
    except ValueError:
        wording = len(old.split()) > 1 and len(new.split()) > 1
        yield _value(case, where, f"{_short(old)} -> {_short(new)}", "words" if wording else kind)
    else:
        yield from _numbers(case, where, numbers[0], numbers[1], kind)


def _short(value: Any, most: int = 150) -> str:
    text = repr(value)
    return text if len(text) <= most else f"{text[:most]}..."


def report(differences: list[Difference], compared: int, strict_words: bool) -> tuple[str, bool]:
    """Return the tables and the summary line, and whether all cases are equal."""
    counting = [d for d in differences if d.counts]
    values = [d for d in counting if d.kind != "words" or strict_words]
    rows = [
        _row(case, [d for d in values if d.case == case]) for case in dict.fromkeys(d.case for d in values)
    ]
    lines = [table(("case", *KINDS[: 6 if strict_words else 5]), _cut(rows, strict_words))] if rows else []
    words = [] if strict_words else [d for d in counting if d.kind == "words"]
    if words:
        lines += [f"words ({len(words)}):", *(f"  {d.case}: {d.where}: {d.text}" for d in words), ""]
    for kind in ("positions", "rotations"):
        measured = [d for d in differences if d.kind == kind]
        if measured:
            worst = max(measured, key=lambda d: math.inf if math.isnan(d.amount) else d.amount)
            lines.append(f"worst of {kind}: {worst.amount:.1e} ({worst.case}, {worst.where})")
    lines.append(f"{compared - len(rows)} of {compared} cases equal")
    return "\n".join(lines), not rows


def _cut(rows: list[list[str]], strict_words: bool) -> list[list[str]]:
    return rows if strict_words else [row[:-1] for row in rows]


def _row(case: str, differences: list[Difference]) -> list[str]:
    """Return the table's row of one case: the worst of each kind, and how many there are."""
    cells = [case]
    for kind in KINDS:
        some = sorted((d for d in differences if d.kind == kind), key=lambda d: -d.amount)
        shown = [
            f"{d.where} {'' if math.isinf(d.amount) else f'{d.amount:.1e} '}{d.text}".strip()
            for d in some[:_SHOWN]
        ]
        more = [f"and {len(some) - _SHOWN} more"] if len(some) > _SHOWN else []
        cells.append("; ".join([*shown, *more]))
    return cells
