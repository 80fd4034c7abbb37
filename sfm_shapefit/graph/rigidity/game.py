"""Step 3: the pebble game on the frames of the sets.

Every node has d pebbles, each free or covering a copy of a link that leaves the node. A copy is
independent of those placed before if d + 2 pebbles can be brought to its two ends; pebbles travel by
reversing paths of covered copies.
"""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, IntArray
from sfm_shapefit.base.forests import compact, connected_components, merge_sets, roots
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.graph.rigidity.growth import incidence

_GAME_WORK = 20  # nodes marked, per node; then contracting and restarting is cheaper than going on


class Game(NamedTuple):
    """Sets as frames: a multigraph on the nodes they share, or on the first few of these."""

    num_nodes: int
    ends: IntArray
    """(k, 2) renumbered nodes of each link of a frame."""
    copies: IntArray
    """(k,) how many copies of an edge the link stands for."""
    owner: IntArray
    """(k,) the set that the link belongs to."""
    num_sets: int
    is_whole: bool
    """Whether all shared nodes take part."""


def contract(num_nodes: int, edges: IntArray, set_of: IntArray, part: int, dimension: int) -> Game:
    """Return the frames of all sets on the first `part` nodes that are shared by sets."""
    num_sets = int(set_of.max(initial=-1)) + 1
    start, nodes, back_start, _ = incidence(num_nodes, edges, set_of, num_sets)
    is_shared = np.diff(back_start) >= 2
    number = np.where(is_shared, np.cumsum(is_shared) - 1, part)
    owner = np.repeat(np.arange(num_sets), np.diff(start))
    kept = number[nodes] < part
    owner, member = owner[kept], number[nodes[kept]]
    order = np.lexsort((member, owner))
    owner, member = owner[order], member[order]

    first = np.searchsorted(owner, owner)  # where the frame of each entry begins
    place = np.arange(len(owner)) - first
    from_first, from_second = np.flatnonzero(place >= 1), np.flatnonzero(place >= 2)
    ends = np.concatenate(
        [
            np.column_stack([member[first[from_first]], member[from_first]]),
            np.column_stack([member[first[from_second] + 1], member[from_second]]),
        ]
    )
    copies = np.repeat([dimension - 1, 1], [len(from_first), len(from_second)])
    owner = np.concatenate([owner[from_first], owner[from_second]])
    by_last_node = np.argsort(ends.max(axis=1, initial=0), kind="stable")
    return Game(
        num_nodes=min(part, int(is_shared.sum())),
        ends=ends[by_last_node].astype(np.int64),
        copies=copies[by_last_node].astype(np.int64),
        owner=owner[by_last_node].astype(np.int64),
        num_sets=num_sets,
        is_whole=bool(is_shared.sum() <= part),
    )


def play(game: Game, dimension: int) -> tuple[IntArray, bool]:
    """Play a game and unite sets by what it shows: those that lie in the same rigid set.

    Returns the rigid set that each set lies in, (number of sets,), compact, and whether these are final. If
    not, two sets at least were united, and the game has to be played again.
    """
    if len(game.ends) == 0:
        return np.arange(game.num_sets), True
    n = game.num_nodes
    links = np.bincount(game.ends.ravel(), minlength=n)
    board = _Board(
        np.full((n, dimension), -1, dtype=np.int64),
        np.full(n, dimension, dtype=np.int64),
        np.concatenate([[0], np.cumsum(links)]),
        np.argsort(game.ends.ravel(), kind="stable") // 2,
        game.ends,
        np.zeros(2, dtype=np.int64),
        *np.zeros((7, n), dtype=np.int64),
    )
    mark = np.full(n, -1)
    _place_links(board, game.copies, _GAME_WORK * n, mark)
    if board.free.sum() == dimension + 1:  # the whole is one rigid set
        united = np.arange(game.num_sets)
        united[game.owner] = game.owner.min()
        return compact(united), True
    if (mark >= 0).any():
        first, second = mark[game.ends.T]
        inside = (first >= 0) & (first == second)
        both = np.column_stack([game.owner[inside], game.owner[first[inside]]])
        return connected_components(game.num_sets, both), False
    united = np.arange(game.num_sets)
    _search_sets(board, game.owner, np.zeros(game.num_sets, np.bool_), united)
    return compact(roots(united)), True


class _Board(NamedTuple):
    """State of a pebble game: d pebbles per node, each free or covering a copy that leaves it."""

    target: IntArray
    """(n, d) node that the copy under each pebble leads to, -1 for a free pebble."""
    free: IntArray
    """(n,) number of free pebbles."""
    start: IntArray
    link_of: IntArray
    ends: IntArray
    """Links at each node, and their two ends, placed or not."""
    clock: IntArray
    """(2,) the running search, and the running rigid set."""
    seen: IntArray
    came_from: IntArray
    came_by: IntArray
    queue: IntArray
    """Marks of the running search, valid where `seen` equals clock[0]."""
    inside: IntArray
    escapes: IntArray
    members: IntArray
    """Marks of the running rigid set, valid where they equal clock[1]; its nodes."""


@inner_kernel
def _gather(board: _Board, u: int, v: int, wanted: int) -> int:
    """Bring free pebbles to u and v until they hold `wanted` in all, or no more can come; return how many.

    A pebble comes to one of them along a path of copies that spares the other one, and turns these copies. An
    end that no path leads to stays so: a path to the other end meets none of the nodes reached from it.
    """
    dimension = board.target.shape[1]
    u_open, v_open = True, True
    while board.free[u] + board.free[v] < wanted:
        u_open, v_open = u_open and board.free[u] < dimension, v_open and board.free[v] < dimension
        if not u_open and not v_open:
            break
        end = u if u_open else v
        board.clock[0] += 1
        now = board.clock[0]
        board.seen[u], board.seen[v], board.queue[0] = now, now, end
        head, tail, source = 0, 1, -1
        while head < tail and source < 0:
            x = board.queue[head]
            head += 1
            for s in range(dimension):
                w = board.target[x, s]
                if w >= 0 and board.seen[w] != now:
                    board.seen[w], board.came_from[w], board.came_by[w] = now, x, s
                    if board.free[w] > 0:
                        source = w
                        break
                    board.queue[tail] = w
                    tail += 1
        if source < 0:
            u_open, v_open = u_open and end != u, v_open and end != v
            continue
        board.free[source] -= 1
        board.free[end] += 1
        slot = 0
        while board.target[source, slot] >= 0:
            slot += 1
        while source != end:
            board.target[source, slot] = board.came_from[source]
            slot = board.came_by[source]
            source = board.came_from[source]
        board.target[end, slot] = -1
    return int(board.free[u] + board.free[v])


@kernel
def _place_links(board: _Board, copies: IntArray, max_work: int, mark: IntArray) -> None:
    """Play the game: place as many copies of each link as are independent of those before.

    Gathering g pebbles on the ends of a link shows that g - (d + 1) more copies are independent. If
    that is fewer than asked, both ends lie in a rigid set; its nodes are marked, so that links inside
    it are passed over at once. The game ends early when the whole is rigid, or when `max_work` nodes
    have been marked: contracting what was found is then cheaper than going on.

    Fills `mark` (n,), which holds -1, with the link by which a node was found to lie in a rigid set.
    """
    n, dimension = board.target.shape
    room = dimension * n - (dimension + 1)
    size_at = np.zeros(len(copies), np.int64)
    for k in range(len(copies)):
        u, v = board.ends[k, 0], board.ends[k, 1]
        if mark[u] >= 0 and mark[u] == mark[v]:
            continue
        gathered = _gather(board, u, v, dimension + 1 + copies[k])
        placed = min(copies[k], gathered - (dimension + 1))
        for _ in range(placed):
            a, b = (u, v) if board.free[u] > 0 else (v, u)
            slot = 0
            while board.target[a, slot] >= 0:
                slot += 1
            board.target[a, slot] = b
            board.free[a] -= 1
        room -= placed
        if placed < copies[k]:
            size_at[k] = _rigid_set(board, u, v)
            max_work -= size_at[k]
            for q in range(size_at[k]):
                w = board.members[q]
                if mark[w] < 0 or size_at[mark[w]] <= size_at[k]:
                    mark[w] = k
        if room == 0 or max_work < 0:
            break


@inner_kernel
def _rigid_set(board: _Board, u: int, v: int) -> int:
    """Collect the largest rigid set around u and v, which hold all the d + 1 pebbles that they can.

    It consists of the nodes that no path of copies leads from to a free pebble elsewhere. From each neighbor
    of the set all copies are followed: if none escapes to a free pebble, all nodes met join. Returns the
    size; the set's nodes stand in `members`, those just met behind them, and `inside` marks them.
    """
    board.clock[1] += 1
    now = board.clock[1]
    board.members[0], board.members[1] = u, v
    board.inside[u], board.inside[v] = now, now
    head, size = 0, 2
    while head < size:
        node = board.members[head]
        head += 1
        for s in range(board.start[node], board.start[node + 1]):
            k = board.link_of[s]
            w = board.ends[k, 0] + board.ends[k, 1] - node
            if board.inside[w] == now or board.escapes[w] == now:
                continue
            board.clock[0] += 1
            search = board.clock[0]
            board.seen[w], board.came_from[w], board.members[size] = search, -1, w
            place, tail, escaped = size, size + 1, -1
            while place < tail:
                x = board.members[place]
                place += 1
                if board.free[x] > 0 or board.escapes[x] == now:
                    escaped = x
                    break
                for slot in range(board.target.shape[1]):
                    y = board.target[x, slot]
                    if y >= 0 and board.seen[y] != search and board.inside[y] != now:
                        board.seen[y], board.came_from[y], board.members[tail] = search, x, y
                        tail += 1
            if escaped < 0:
                for q in range(size, tail):
                    board.inside[board.members[q]] = now
                size = tail
            while escaped >= 0:
                board.escapes[escaped] = now
                escaped = board.came_from[escaped]
    return size


@kernel
def _search_sets(board: _Board, owner: IntArray, done: BoolArray, parent: IntArray) -> None:
    """Unite the sets that lie in the same rigid set, after a full game; `done` holds False."""
    for k in range(len(owner)):
        if done[owner[k]]:
            continue
        _gather(board, board.ends[k, 0], board.ends[k, 1], 2 * board.target.shape[1])
        for q in range(_rigid_set(board, board.ends[k, 0], board.ends[k, 1])):
            x = board.members[q]
            for s in range(board.start[x], board.start[x + 1]):
                link = board.link_of[s]
                w = board.ends[link, 0] + board.ends[link, 1] - x
                if board.inside[w] == board.clock[1]:
                    done[owner[link]] = True
                    merge_sets(parent, owner[k], owner[link])
