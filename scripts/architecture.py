"""Draw the rooms of the package and who imports whom, from the sources: docs/architecture.svg.

    python scripts/architecture.py --out docs/architecture.svg

A room stands on its floor, the first line of its docstring beneath its name. An arrow is left out where a way
through other rooms leads to the same room, since whoever may import the first may import the last. An arrow
over several floors passes between the rooms of each; rooms and such passages are ordered by where their
arrows come from, the usual remedy against crossings (Sugiyama, Tagawa, Toda 1981).
"""

import argparse
import ast
import textwrap
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from harness.rooms import FLOORS, PACKAGE, ROOMS, essential_arrows, tree_of

_WIDTH, _ROOM, _LANE = 980, 236, 26  # pixels: of the picture, of a room, of a passage beside rooms
_HEIGHT, _STEP = 74, 112  # pixels: of a room, and from floor to floor
_LINE = 39  # characters in a line of a room
_SWEEPS = 8  # rounds of ordering; it settles in fewer


class _Stop(NamedTuple):
    """A room, or where an arrow passes a floor: then `past` is its other end."""

    room: str
    past: str = ""


def picture() -> str:
    """Return the picture as SVG."""
    links, floors = _lay_out()
    x = _place(links, floors)
    height = len(floors) * _STEP
    y = {stop: height - _STEP * floor - 20 for floor, stops in enumerate(floors) for stop in stops}
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" font-family="sans-serif">',
        "<title>Rooms of sfm_shapefit, and from which they import</title>",
        '<defs><marker id="end" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="7" markerHeight="7" '
        'orient="auto"><path d="M0 0L8 4L0 8z" fill="#7a8ca0"/></marker></defs>',
        f'<rect width="{_WIDTH}" height="{height}" fill="#ffffff"/>',
    ]
    lines += [_arrow(way, x, y) for way in links]
    lines += [_box(stop.room, x[stop], y[stop]) for stops in floors for stop in stops if not stop.past]
    return "\n".join([*lines, "</svg>", ""])


def _lay_out() -> tuple[list[list[_Stop]], list[list[_Stop]]]:
    """Return the stops of each arrow from above to below, and those of each floor, rooms and passages."""
    floors = [[_Stop(room) for room in rooms if room in _shown()] for rooms in FLOORS]
    links = []
    for own, to in sorted(essential_arrows()):
        if own in _shown():
            between = range(ROOMS[own] - 1, ROOMS[to], -1)
            passages = [_Stop(f"{own}@{floor}", to) for floor in between]
            for floor, passage in zip(between, passages, strict=True):
                floors[floor].append(passage)
            links.append([_Stop(own), *passages, _Stop(to)])
    return links, floors


def _shown() -> set[str]:
    return {room for room in ROOMS if room not in {"__main__", "synthetic/fixtures"}}  # doors, not rooms


def _place(links: list[list[_Stop]], floors: list[list[_Stop]]) -> dict[_Stop, float]:
    """Return the x of each stop's middle; sorts the floors by the middles of the neighbors."""
    near: dict[_Stop, list[_Stop]] = {stop: [] for stops in floors for stop in stops}
    for way in links:
        for above, below in pairwise(way):
            near[above].append(below)
            near[below].append(above)
    x = {stop: float(k) for stops in floors for k, stop in enumerate(stops)}
    for _ in range(_SWEEPS):
        for stops in [*floors, *reversed(floors)]:
            middle = {stop: sum(x[other] for other in near[stop]) / max(len(near[stop]), 1) for stop in stops}
            stops.sort(key=lambda stop: (middle[stop], stop))
            x |= _spread(stops)
    return x


def _spread(stops: list[_Stop]) -> dict[_Stop, float]:
    """Return the middles of stops in a row, in the middle of the picture."""
    widths = [_LANE if stop.past else _ROOM for stop in stops]
    gap = min(48.0, (_WIDTH - sum(widths)) / (len(stops) + 1))
    left = 0.5 * (_WIDTH - sum(widths) - gap * (len(stops) - 1))
    found = {}
    for stop, width in zip(stops, widths, strict=True):
        found[stop] = left + 0.5 * width
        left += width + gap
    return found


def _arrow(way: list[_Stop], x: dict[_Stop, float], y: dict[_Stop, int]) -> str:
    path = f"M{x[way[0]]:.0f} {y[way[0]]}"
    for above, below in pairwise(way):
        from_y, to_y = y[above], y[below] - _HEIGHT
        bend = 0.5 * (to_y - from_y)
        path += f"C{x[above]:.0f} {from_y + bend:.0f} {x[below]:.0f} {to_y - bend:.0f} {x[below]:.0f} {to_y}"
        path += f"V{y[below]}" if below.past else ""
    return f'<path d="{path}" fill="none" stroke="#7a8ca0" stroke-width="1.4" marker-end="url(#end)"/>'


def _box(room: str, x: float, y: int) -> str:
    left, top = x - 0.5 * _ROOM, y - _HEIGHT
    says = (ast.get_docstring(tree_of(PACKAGE / room / "__init__.py")) or "").splitlines()[0]
    rows = textwrap.wrap(says.split(";")[0].split(". ")[0].rstrip("."), _LINE)
    texts = [
        f'<text x="{x:.0f}" y="{top + 34 + 15 * k:.0f}" font-size="11" fill="#3b4754">{escape(row)}</text>'
        for k, row in enumerate(rows)
    ]
    return (
        f'<g text-anchor="middle"><rect x="{left:.0f}" y="{top:.0f}" width="{_ROOM}" height="{_HEIGHT}" '
        f'rx="6" fill="#eef3f8" stroke="#5b7083"/><text x="{x:.0f}" y="{top + 18:.0f}" font-size="14" '
        f'font-weight="bold" fill="#1c2833">{room}</text>{"".join(texts)}</g>'
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="the file to write")
    parser.parse_args().out.write_text(picture(), encoding="utf-8")
