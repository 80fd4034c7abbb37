"""What a sparse Cholesky factorization will do, from the graph alone: fill, work, and where all goes.

Eliminating node k joins its later neighbors. The first of them is its parent in the elimination tree,
and column k of the factor L is filled within the column of the parent (Liu 1990, "The role of elimination
trees in sparse factorization"). From that:

    column counts   entries per column of L, without forming L: count the leaves of the row subtrees
                    (Gilbert, Ng, Peyton 1994, "An efficient algorithm to compute row and column counts")
    supernodes      runs of columns with equal structure, stored as dense panels; small ones are merged
                    into their parents at the price of some explicit zeros (Ashcraft, Grimes 1989)
    fronts          one dense panel and one dense update matrix per supernode (Duff, Reid 1983); an update
                    waits for its parent on a stack whose every offset is known here, before any number is
    tasks           disjoint subtrees that can be worked on at the same time, and the few supernodes above
                    them (Geist, Ng 1989, "Task scheduling for parallel sparse Cholesky factorization"). They
                    depend on the graph alone, not on the number of threads, so that every sum has one order

All indices count nodes; a block size b enters only as a factor (positions times b, areas times b^2).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import BoolArray, Int32Array, IntArray, distinct, frozen
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.laplacian.operators import Adjacency, group_by

_MERGE_ALWAYS = 0.03  # share of zeros in the merged panel; up to it a child joins its parent in any case
_MERGE_LIMITS = ((64, 0.10), (24, 0.20), (8, 0.80))  # columns and share of zeros; small panels may have more
_LARGEST_TASK = 1 / 6  # share of all entries; subtrees with more are divided, so that threads end together
_SMALLEST_TASK = 1 / 40  # share of all entries; subtrees with less are left to the part above
_WORTH_TASKS = 50_000  # entries of the panels; with fewer, handing out work costs more than the work


@dataclass(frozen=True, slots=True, eq=False)
class EliminationTree:
    """The elimination tree of a graph under a fill-reducing order, postordered, with column counts."""

    permutation: IntArray
    """(n,) the node that is eliminated k-th; every subtree is a contiguous range of k."""
    parent: IntArray
    """(n,) parent of each elimination step, -1 at a root."""
    counts: IntArray
    """(n,) entries of each column of L, the diagonal included."""

    @property
    def num_nonzeros(self) -> int:
        """Entries of L without any explicit zero, nnz(L)."""
        return int(self.counts.sum())

    @property
    def flops(self) -> float:
        """Multiplications and additions of the factorization: the sum of squared column counts."""
        return float(np.sum(self.counts.astype(np.float64) ** 2))


@dataclass(frozen=True, slots=True, eq=False)
class SymbolicFactor:
    """The plan of a multifrontal Cholesky factorization; serves every block size and precision.

    Supernode s owns elimination steps `first[s]:first[s + 1]`. Its panel has those steps as columns, and
    as rows the same steps followed by `rows[row_pointers[s]:row_pointers[s + 1]]`, column-major.
    """

    permutation: IntArray
    """(n,) the node that is eliminated k-th."""
    inverse: IntArray
    """(n,) when each node is eliminated."""
    first: IntArray
    """(S + 1,) first column of each supernode."""
    parent: IntArray
    """(S,) parent supernode, -1 at a root; children come before parents."""
    child_pointers: IntArray
    """(S + 1,) into `children`."""
    children: IntArray
    """Children of each supernode, ascending; the order in which their updates are added."""
    row_pointers: IntArray
    """(S + 1,) into `rows` and `relative`."""
    rows: Int32Array
    """Rows below the own columns of each supernode, ascending."""
    relative: Int32Array
    """Position of each of these rows among all rows of the parent's panel."""
    panel_pointers: IntArray
    """(S + 1,) start of each panel in units of one (block) entry."""
    tasks: IntArray
    """(K, 2) supernodes begin..end-1 of each task: disjoint subtrees, end - 1 the root; ascending."""
    above: IntArray
    """(r, 2) runs begin..end-1 of the supernodes that are in no task; ascending. Small subtrees that follow
    one another are one run, and so is a chain of supernodes whose subtrees are too large for a task."""
    unit_of: IntArray
    """(S,) the unit of each supernode: tasks and runs above are counted together, ascending."""
    needs: tuple[tuple[int, ...], ...]
    """For each unit the others with children of its supernodes; all come before it."""
    update_offsets: IntArray
    """(S,) start of each update matrix, in (block) entries: in the arena where its unit runs, if the parent
    is in the same unit, else in the stack, where one thread does all; see `FrontMemory`."""
    stack_size: int
    """(Block) entries of that stack."""
    arena_size: int
    """(Block) entries that a running unit needs for itself."""
    largest_front: int
    """Rows of the tallest panel."""
    edge_pointers: IntArray
    """(S + 1,) into the three arrays below: the edges of each supernode."""
    edge_index: Int32Array
    """(m,) edges, grouped by the supernode that they enter."""
    edge_row: Int32Array
    """(m,) row of each of these edges in its panel."""
    edge_column: Int32Array
    """(m,) column of each of these edges in its panel."""
    is_turned: BoolArray
    """(m,) whether the second node of an edge is eliminated before the first; in the order of the edges."""
    num_nonzeros: int
    """Entries of the scalar factor L without any explicit zero."""
    flops: float
    """Multiplications and additions of the scalar factorization, without explicit zeros."""

    @property
    def units(self) -> IntArray:
        """The tasks and the runs above them, (U, 2), ascending."""
        return np.sort(np.concatenate([self.tasks, self.above]), axis=0)

    def needs_back(self) -> list[list[int]]:
        """Return `needs` for units that come from the last to the first: the places of those with parents."""
        last = len(self.needs) - 1
        needs: list[list[int]] = [[] for _ in self.needs]
        for unit, children in enumerate(self.needs):
            for child in children:
                needs[last - child].append(last - unit)
        return needs

    @property
    def num_nodes(self) -> int:
        """Number of nodes, n."""
        return len(self.permutation)

    @property
    def num_edges(self) -> int:
        """Number of edges, m."""
        return len(self.edge_index)

    @property
    def num_supernodes(self) -> int:
        """Number of supernodes, S."""
        return len(self.parent)

    @property
    def num_entries(self) -> int:
        """Entries of the scalar factor that are stored, explicit zeros included."""
        return int(self.panel_pointers[-1])

    def num_bytes(self, block: int = 1, dtype: npt.DTypeLike = np.float64, threads: int = 1) -> int:
        """Return the memory of the numeric factor: its panels, and the stack while it is computed."""
        entries = self.num_entries + self.stack_size + threads * self.arena_size
        return entries * block * block * np.dtype(dtype).itemsize


def elimination_tree(graph: Adjacency, order: npt.NDArray[np.integer]) -> EliminationTree:
    """Return the elimination tree and the column counts of L for a fill-reducing order (n,).

    The tree is for an equivalent order (same L up to renumbering) in which subtrees are contiguous.
    """
    permutation = np.ascontiguousarray(order, dtype=np.int64)
    inverse = _inverse(permutation)
    parent = _parents(graph.pointers, graph.neighbors, permutation, inverse)
    post = _postorder(parent)
    permutation = permutation[post]
    rank = _inverse(post)
    inverse = _inverse(permutation)
    moved = parent[post]
    parent = np.where(moved < 0, -1, rank[moved])
    counts = _column_counts(graph.pointers, graph.neighbors, permutation, inverse, parent)
    return EliminationTree(frozen(permutation), frozen(parent), frozen(counts))


def plan_factorization(graph: Adjacency, edges: IntArray, tree: EliminationTree) -> SymbolicFactor:
    """Find the supernodes, their rows, the slot of each edge and the offsets of the update stack.

    The edges (m, 2) are those of `graph`; `tree` is from `elimination_tree` on the same graph.
    """
    order, first, parent, below = _supernodes(tree.parent, tree.counts)
    permutation = tree.permutation[order]
    inverse = _inverse(permutation)
    row_pointers = np.concatenate([[0], np.cumsum(below)])
    owner = np.repeat(np.arange(len(parent)), np.diff(first))
    rows = _panel_rows(graph.pointers, graph.neighbors, permutation, inverse, owner, parent, row_pointers)
    relative = _relative_positions(first, parent, row_pointers, rows)
    sizes = np.diff(first) * (np.diff(first) + below)
    tasks, above = _tasks(parent, sizes)
    units = np.sort(np.concatenate([tasks, above]), axis=0)
    unit_of = np.repeat(np.arange(len(units)), units[:, 1] - units[:, 0])
    offsets, stack_size, arena_size = _stack_plan(parent, below, units, unit_of)
    children = np.argsort(parent, kind="stable")[int(np.sum(parent < 0)) :]
    child_pointers = np.searchsorted(parent[children], np.arange(len(parent) + 1))
    i, j = inverse[edges.T]
    edge_pointers, index, edge_row, edge_column = _edge_slots(
        np.minimum(i, j), np.maximum(i, j), owner, first, row_pointers, rows
    )
    return SymbolicFactor(
        permutation=frozen(permutation),
        inverse=frozen(inverse),
        first=frozen(first),
        parent=frozen(parent),
        child_pointers=frozen(child_pointers),
        children=frozen(children),
        row_pointers=frozen(row_pointers),
        rows=frozen(rows),
        relative=frozen(relative),
        panel_pointers=frozen(np.concatenate([[0], np.cumsum(sizes)])),
        tasks=frozen(tasks),
        above=frozen(above),
        unit_of=frozen(unit_of),
        needs=_needs(parent, unit_of, len(units)),
        update_offsets=frozen(offsets),
        stack_size=stack_size,
        arena_size=arena_size,
        largest_front=int(np.max(np.diff(first) + below, initial=0)),
        edge_pointers=frozen(edge_pointers),
        edge_index=frozen(index),
        edge_row=frozen(edge_row),
        edge_column=frozen(edge_column),
        is_turned=frozen(i > j),
        num_nonzeros=tree.num_nonzeros,
        flops=tree.flops,
    )


def _inverse(permutation: IntArray) -> IntArray:
    inverse = np.empty_like(permutation)
    inverse[permutation] = np.arange(len(permutation))
    return inverse


@kernel
def _parents(pointers: Any, neighbors: Any, permutation: Any, inverse: Any) -> Any:
    """Return the elimination tree: join the earlier neighbors' trees below each step (with compression)."""
    n = len(permutation)
    parent = np.full(n, -1, np.int64)
    ancestor = np.full(n, -1, np.int64)
    for k in range(n):
        node = permutation[k]
        for p in range(pointers[node], pointers[node + 1]):
            i = inverse[neighbors[p]]
            while i < k and i != -1:
                above = ancestor[i]
                ancestor[i] = k
                if above == -1:
                    parent[i] = k
                i = above
    return parent


@kernel
def _postorder(parent: Any) -> Any:
    """Return a postorder of a forest; siblings stay in ascending order."""
    n = len(parent)
    child = np.full(n + 1, -1, np.int64)  # entry n stands for the common parent of the roots
    sibling = np.full(n, -1, np.int64)
    for i in range(n - 1, -1, -1):
        above = parent[i] if parent[i] >= 0 else n
        sibling[i] = child[above]
        child[above] = i
    order = np.empty(n, np.int64)
    filled = 0
    node = n
    while True:
        while child[node] != -1:
            down = child[node]
            child[node] = sibling[down]
            node = down
        if node == n:
            return order
        order[filled] = node
        filled += 1
        node = parent[node] if parent[node] >= 0 else n


@kernel
def _column_counts(pointers: Any, neighbors: Any, permutation: Any, inverse: Any, parent: Any) -> Any:
    """Count the entries of each column of L.

    Row i of L is the subtree that joins i's earlier neighbors to i. Entry (i, j) is charged +1 at each
    leaf j and -1 where two branches meet, so that sums over subtrees count every row that passes.
    """
    n = len(permutation)
    delta = np.empty(n, np.int64)
    lowest = np.empty(n, np.int64)  # first descendant
    previous = np.empty(n, np.int64)  # latest leaf seen in each row subtree
    ancestor = np.empty(n, np.int64)
    for j in range(n):
        delta[j], lowest[j], previous[j], ancestor[j] = 1, j, -1, j
    for j in range(n):
        if parent[j] >= 0:
            delta[parent[j]] = 0  # not a leaf of the tree, so no leaf of its own row subtree
            lowest[parent[j]] = min(lowest[parent[j]], lowest[j])
    for j in range(n):
        if parent[j] >= 0:
            delta[parent[j]] -= 1
        node = permutation[j]
        for p in range(pointers[node], pointers[node + 1]):
            i = inverse[neighbors[p]]
            if i <= j or lowest[j] <= previous[i]:
                continue  # an earlier neighbor of i lies below j: j is no leaf of row i
            delta[j] += 1
            if previous[i] >= 0:
                meet = previous[i]
                while ancestor[meet] != meet:
                    ancestor[meet] = ancestor[ancestor[meet]]
                    meet = ancestor[meet]
                delta[meet] -= 1
            previous[i] = j
        if parent[j] >= 0:
            ancestor[j] = parent[j]
    for j in range(n):
        if parent[j] >= 0:
            delta[parent[j]] += delta[j]
    return delta


def _supernodes(parent: IntArray, counts: IntArray) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Return the merged supernodes: column order, first columns (S + 1,), parents (S,), rows below (S,)."""
    nested = (parent[:-1] == np.arange(1, len(parent))) & (counts[:-1] == counts[1:] + 1)
    head = np.concatenate([[0], np.flatnonzero(~nested) + 1])[
        : len(parent)
    ]  # start of runs of nested columns
    width, height = np.diff(head, append=len(parent)), counts[head]
    label = np.repeat(np.arange(len(head)), width)
    above = parent[head + width - 1]
    above = np.where(above < 0, -1, label[above])
    limits = np.array([limit for limit, _ in _MERGE_LIMITS], dtype=np.int64)
    shares = np.array([share for _, share in _MERGE_LIMITS])
    filled = width * height - width * (width - 1) / 2
    target = _merge(above, width, height, filled, limits, shares, _MERGE_ALWAYS)
    chosen = np.flatnonzero(target == np.arange(len(head)))
    number = np.full(len(head), -1)
    number[chosen] = np.arange(len(chosen))
    label, width, height, above = number[target[label]], width[chosen], height[chosen], above[chosen]
    tree = np.where(above < 0, -1, number[target[above]])
    post = _postorder(tree)
    rank = _inverse(post)
    order = np.argsort(rank[label], kind="stable")
    first = np.concatenate([[0], np.cumsum(width[post])])
    moved = tree[post]
    supernode_parent = np.where(moved < 0, -1, rank[moved])
    return order, first, supernode_parent, (height - width)[post]


@kernel
def _merge(above: Any, width: Any, height: Any, filled: Any, limits: Any, shares: Any, always: float) -> Any:
    """Merge children into parents while few zeros arise; return the supernode that each one is part of then.

    `width`, `height` and `filled`, the entries that are not zero, grow to those of the merged supernodes.
    """
    target = np.empty(len(above), np.int64)
    for s in range(len(above)):  # children before parents; a parent has already absorbed its earlier children
        target[s] = s
        p = above[s]
        if p < 0:
            continue
        columns, rows = width[s] + width[p], width[s] + height[p]
        entries = columns * rows - columns * (columns - 1) / 2
        zeros = 1.0 - (filled[s] + filled[p]) / entries
        merged = zeros <= always
        for k in range(len(limits)):
            merged |= columns <= limits[k] and zeros <= shares[k]
        if merged:
            target[s] = p
            width[p], height[p] = columns, rows
            filled[p] += filled[s]
    for s in range(len(above) - 1, -1, -1):  # follow merges from the roots down
        target[s] = target[target[s]]
    return target


@kernel
def _panel_rows(
    pointers: Any, neighbors: Any, permutation: Any, inverse: Any, owner: Any, parent: Any, row_pointers: Any
) -> Any:
    """Fill the rows below each supernode: row i is appended to all supernodes of its row subtree."""
    num = len(parent)
    fill = row_pointers[:num].copy()
    rows = np.empty(row_pointers[num], np.int32)
    mark = np.full(num, -1, np.int64)
    for i in range(len(permutation)):
        mark[owner[i]] = i
        node = permutation[i]
        for p in range(pointers[node], pointers[node + 1]):
            j = inverse[neighbors[p]]
            if j >= i:
                continue
            s = owner[j]
            while mark[s] != i:
                mark[s] = i
                rows[fill[s]] = i
                fill[s] += 1
                s = parent[s]
    return rows


@kernel
def _relative_positions(first: Any, parent: Any, row_pointers: Any, rows: Any) -> Any:
    """Locate the rows below each supernode in its parent's panel; both lists ascend."""
    relative = np.empty(len(rows), np.int32)
    for s in range(len(parent)):
        p = parent[s]
        if p < 0:
            continue
        width = first[p + 1] - first[p]
        q = row_pointers[p]
        for k in range(row_pointers[s], row_pointers[s + 1]):
            row = rows[k]
            if row < first[p + 1]:
                relative[k] = row - first[p]
                continue
            while rows[q] < row:
                q += 1
            relative[k] = width + q - row_pointers[p]
    return relative


def _tasks(parent: IntArray, sizes: IntArray) -> tuple[IntArray, IntArray]:
    """Cut the supernodes into tasks and what is above them; see `SymbolicFactor`."""
    num, total = len(parent), int(sizes.sum())
    begin, weight = _subtrees(parent, sizes)  # whose kernel warm-up then compiles, by small plans
    if total < _WORTH_TASKS:
        return np.zeros((0, 2), np.int64), np.array([[0, num]])
    is_root = (parent < 0) | (weight[parent] > _LARGEST_TASK * total)
    roots = np.flatnonzero(is_root & (weight <= _LARGEST_TASK * total) & (weight >= _SMALLEST_TASK * total))
    tasks = np.stack([begin[roots], roots + 1], axis=1)
    is_large = weight > _LARGEST_TASK * total
    # The only child of a large one is the supernode before it; such chains are not cut.
    is_next = (np.bincount(parent[parent >= 0], minlength=num) == 1) & np.append(False, is_large[:-1])
    cuts = [
        np.flatnonzero(is_large & ~is_next),
        np.flatnonzero(is_large & ~np.append(is_next[1:], False)) + 1,
    ]
    bounds = distinct(np.concatenate([[0, num], tasks.ravel(), *cuts]))
    runs = np.stack([bounds[:-1], bounds[1:]], axis=1)
    return tasks, runs[~np.isin(bounds[:-1], tasks[:, 0])]


def _needs(parent: IntArray, unit_of: IntArray, num_units: int) -> tuple[tuple[int, ...], ...]:
    """Return for each unit the others with children of its supernodes, ascending."""
    needs = [set[int]() for _ in range(num_units)]
    for s in np.flatnonzero((parent >= 0) & (unit_of[parent] != unit_of)):
        needs[unit_of[parent[s]]].add(int(unit_of[s]))
    return tuple(tuple(sorted(numbers)) for numbers in needs)


@kernel
def _subtrees(parent: Any, sizes: Any) -> Any:
    """Return the first supernode of each subtree and the sum of its sizes."""
    begin, weight = np.arange(len(parent)), sizes.copy()
    for s in range(len(parent)):
        if parent[s] >= 0:
            weight[parent[s]] += weight[s]
            begin[parent[s]] = min(begin[parent[s]], begin[s])
    return begin, weight


def _stack_plan(
    parent: IntArray, below: IntArray, units: IntArray, unit_of: IntArray
) -> tuple[IntArray, int, int]:
    """Place the update matrices inside units; return offsets, and the sizes of stack and arena."""
    offsets, arena = np.zeros(len(parent), np.int64), 0
    for begin, end in units:
        offsets[begin:end], size = _stacked(parent[begin:end] - begin, below[begin:end])
        arena = max(arena, int(size))
    leaves = (parent < 0) | (unit_of[parent] != unit_of)
    top, rank = np.flatnonzero(leaves), np.cumsum(leaves) - 1
    last_of_parent = units[unit_of[parent[top]], 1] - 1  # leaves its unit, which has others below it, alone
    offsets[top], stack = _stacked(np.where(parent[top] < 0, -1, rank[last_of_parent]), below[top])
    return offsets, int(stack), arena


@kernel
def _stacked(parent: Any, below: Any) -> Any:
    """Place each update matrix on one of two stacks that grow towards each other.

    One whose parent is beyond the last supernode, or that has none, is elsewhere.

    A front reads its children's updates and writes its own. With the levels of the tree on alternating
    stacks, both are at the top of their stack and nothing is ever copied. Offsets of the second stack
    are counted from the end.
    """
    num = len(parent)
    level = np.zeros(num, np.int64)
    for s in range(num - 1, -1, -1):
        if 0 <= parent[s] < num:
            level[s] = 1 - level[parent[s]]
    offsets = np.zeros(num, np.int64)
    top = np.zeros(2, np.int64)
    freed = np.full(num, -1, np.int64)  # where the children's stack stood before the first child
    size = 0
    for s in range(num):
        side, area = level[s], below[s] * below[s] if 0 <= parent[s] < num else 0
        offsets[s] = top[side]
        top[side] += area
        size = max(size, top[0] + top[1])
        if freed[s] >= 0:
            top[1 - side] = freed[s]
        if 0 <= parent[s] < num and freed[parent[s]] < 0:
            freed[parent[s]] = offsets[s]
    for s in range(num):
        if level[s] == 1:
            offsets[s] = size - offsets[s] - (below[s] * below[s] if 0 <= parent[s] < num else 0)
    return offsets, size


@kernel
def _edge_slots(earlier: Any, later: Any, owner: Any, first: Any, row_pointers: Any, rows: Any) -> Any:
    """Group the edges by the supernode of their earlier end and find their row and column in its panel."""
    num, m = len(first) - 1, len(earlier)
    entered, index = np.empty(m, np.int64), np.empty(m, np.int32)
    for e in range(m):
        entered[e] = owner[earlier[e]]
    pointers, items = group_by(entered, num)
    for k in range(m):
        index[k] = items[k]
    edge_row = np.empty(m, np.int32)
    edge_column = np.empty(m, np.int32)
    position = np.empty(len(owner), np.int64)
    for s in range(num):
        start, begin, width = first[s], row_pointers[s], first[s + 1] - first[s]
        for k in range(width):
            position[start + k] = k
        for k in range(begin, row_pointers[s + 1]):
            position[rows[k]] = width + k - begin
        for k in range(pointers[s], pointers[s + 1]):
            edge_column[k] = earlier[index[k]] - start
            edge_row[k] = position[later[index[k]]]
    return pointers, index, edge_row, edge_column
