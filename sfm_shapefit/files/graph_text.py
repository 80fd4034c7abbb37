"""Bare view graphs as text.

A graph file has one pair per line,

    i j v1 v2 ... vd [weight]        # comments and empty lines are skipped

with the unit direction of t_i - t_j (it points from j to i). Node ids are words; they need not be
numbers, nor contiguous. All lines have the same number of columns. The last column is a weight if it is
positive and the columns before it are unit vectors, in every line; otherwise it belongs to the direction.
"""

from pathlib import Path

import numpy as np

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.wording import counted
from sfm_shapefit.files.lines import read_lines
from sfm_shapefit.graph.viewgraph import ViewGraph

_UNIT_TOLERANCE = 1e-4  # error of a direction's length; one that is printed with 5 digits passes
_ROUNDED = 1e-7  # error of a direction's length beyond which it is scaled; it was printed with few digits
_LARGEST_WEIGHT = 1e30  # weight, and 1 over the smallest; sums of squares of products must not overflow
_MIN_COLUMNS = 4  # columns; two ids and a direction in the plane


def read_graph(path: Path | str) -> ViewGraph:
    """Read a bare view graph; the ids become its names, numbers in numerical order, else alphabetically.

    Directions are normalized; a pair that appears twice is merged (see `ViewGraph`).

    Raises:
        InputError: if the file cannot be read, naming the first malformed line by its number.
    """
    file = Path(path)
    table = read_lines(file, "i j vx vy vz [weight]")
    width = len(table.rows[0])
    if width < _MIN_COLUMNS:
        raise InputError(
            f"{file}, line {table.numbers[0]}: expected i j and a direction, got {counted(width, 'column')}; "
            "give the text file of a bare graph, or the folder of a COLMAP model"
        )
    values = table.values(first=2, width=width)
    with np.errstate(over="ignore"):  # a length that overflows is no unit length
        head, last = values[:, :-1], values[:, -1]
        is_unit = np.abs(np.linalg.norm(head, axis=1) - 1.0) <= _UNIT_TOLERANCE
        has_weights = width > _MIN_COLUMNS and bool(np.all(is_unit)) and not np.all(last == 0.0)
        directions, weights = (head, last) if has_weights else (values, np.ones(len(values)))
        lengths = np.linalg.norm(directions, axis=1)
    ids, edges = table.pairs()
    table.refuse(edges[:, 0] == edges[:, 1], "joins a node with itself")
    table.refuse(np.asarray(~(np.abs(lengths - 1.0) <= _UNIT_TOLERANCE)), "has no unit direction")
    table.refuse(~(weights > 0.0), "has a weight that is not positive")
    extreme = (weights < 1.0 / _LARGEST_WEIGHT) | (weights > _LARGEST_WEIGHT)
    table.refuse(extreme, f"has a weight beyond 1 / {_LARGEST_WEIGHT:g} to {_LARGEST_WEIGHT:g}")
    rounded = np.abs(lengths - 1.0) > _ROUNDED  # ViewGraph sees to the rest
    directions = np.where(rounded[:, None], directions / lengths[:, None], directions)
    try:
        return ViewGraph(len(ids), edges, directions, weights, ids)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error


def graph_text(graph: ViewGraph) -> str:
    """Return a view graph in the text format that `read_graph` takes; numbers round-trip."""
    ids = graph.names or tuple(str(k) for k in range(graph.num_nodes))
    values = graph.directions
    if np.any(graph.weights != 1.0):
        values = np.column_stack([values, graph.weights])
    lines = []
    for (i, j), numbers in zip(graph.edges.tolist(), values.tolist(), strict=True):
        lines.append(" ".join([ids[i], ids[j], *map(repr, numbers)]))
    return "\n".join(lines) + "\n"
