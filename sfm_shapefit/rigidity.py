"""Parallel rigidity: which pairs move together, which cameras the directions determine.

A view graph is parallel rigid in dimension d if its directions fix the camera positions up to one
translation and one scale. For positions in general position this depends on the graph alone
(Whiteley 1996, "Some matroids from discrete applied geometry", section 8; Ozyesil and Singer 2015,
arXiv 1412.0165): let every pair stand for d - 1 copies of an edge (a direction gives d - 1
equations). A set of copies is independent if every k >= 2 cameras span at most d k - (d + 1) of
them, and n cameras are rigid if d n - (d + 1) independent copies join them. So the verdict is exact
and blind to noise; whether a rigid graph is well conditioned is another question.

Maximal rigid sets ("pieces") partition the *pairs*; two pieces share at most one camera, a hinge.
They are found by combining rigid sets ("bodies", at first the single pairs):

1. The three pairs of a triangle unite: 3 (d - 1) >= 3 d - (d + 1), for every d >= 2.
2. Two bodies that share two cameras unite, and so do three bodies that meet two by two in three
   different cameras (the triangle again). A body grows by both rules in time linear in what it touches.
3. What is left goes to the (d, d + 1) pebble game (Lee and Streinu 2008, "Pebble game algorithms
   and sparse graphs"), where each body is replaced by a frame on the cameras it shares with others.

Step 3 decides everything that is open, so steps 1 and 2 need not be exhaustive, only right. The game
is played on the first few shared cameras, then on twice as many, and so on until all take part: a
rigid set of a part is rigid in the whole, and contracting it early keeps the last games small.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfm_shapefit.arrays import BoolArray, IntArray, frozen
from sfm_shapefit.errors import InputError
from sfm_shapefit.jit import kernel
from sfm_shapefit.viewgraph import ViewGraph

_FIRST_GAME_CAMERAS = 500  # a pebble game of this size takes milliseconds
_GROWTH_ROUNDS = 4  # a later round rarely unites anything; the pebble game is exact anyway
_GROWTH_WORK = 30  # cameras looked at while growing, as a multiple of all (body, camera) incidences

_GAME_WORK = 20  # cameras marked before a game is contracted and restarted, as a multiple of its cameras


@dataclass(frozen=True, slots=True, eq=False)
class RigidPiece:
    """A maximal set of pairs whose cameras are determined up to one translation and one scale."""

    cameras: IntArray
    """Its cameras, ascending, at least 2."""
    edges: IntArray
    """Indices of its pairs in the graph's `edges`, ascending."""
    hinges: IntArray
    """Those of its cameras that also belong to another piece of at least 3 cameras, ascending."""


def parallel_rigid_pieces(num_cameras: int, edges: IntArray, dimension: int) -> IntArray:
    """Return the rigid piece of each pair, for positions in general position.

    The contraction is exact: a motion of the whole is one translation and scale per body, equal where
    bodies share a camera. A frame on the b shared cameras w_0, w_1, ... of a body (d - 1 copies of
    each w_0 w_k, one of each w_1 w_k, k > 1) admits the same motions there: it has d b - (d + 1)
    copies, and it is independent, since each w_k adds d copies, at most d - 1 of them to one camera.

    Args:
        num_cameras: n.
        edges: (m, 2) camera indices in [0, n), no self-loops.
        dimension: d >= 2.

    Returns:
        (m,) labels. Piece 0 has the most cameras; then come more edges, then the smaller first
        camera, then the smaller second one, so labels do not depend on the order of `edges`. A pair
        that belongs to nothing larger is a piece of its own.

    Raises:
        InputError: if an edge is a self-loop or out of range, or `dimension` is below 2.
    """
    edges = _checked_edges(num_cameras, edges, dimension)
    body = _compact(_triangle_bodies(num_cameras, edges))
    body = _grown(num_cameras, edges, body)
    part = _FIRST_GAME_CAMERAS
    while True:
        game = _contract(num_cameras, edges, body, part, dimension)
        united, is_settled = _play(game, dimension)
        body = united[body]
        if is_settled and game.is_whole:
            return _ranked(num_cameras, edges, body)
        if body.max() + 1 < game.num_bodies:
            body = _grown(num_cameras, edges, body)
        if is_settled:
            part *= 2


def is_parallel_rigid(num_cameras: int, edges: IntArray, dimension: int) -> bool:
    """Return whether the pairs fix all n cameras up to one translation and one scale, generically.

    A single camera without pairs is rigid; arguments and errors as in `parallel_rigid_pieces`.
    """
    checked = _checked_edges(num_cameras, edges, dimension)
    if len(checked) and _grows_from_first_pair(num_cameras, checked):
        return True
    label = parallel_rigid_pieces(num_cameras, checked, dimension)
    if len(label) == 0:
        return num_cameras == 1
    touched = np.unique(np.asarray(edges))
    return bool(label.max() == 0) and len(touched) == num_cameras


@kernel()
def _grows_from_first_pair(num_cameras: int, edges: IntArray) -> bool:
    """Return whether the first pair grows to all cameras by cameras that are joined to two of its own.

    Sufficient for rigidity, and linear in the pairs: each such camera has 2 (d - 1) >= d new copies of edges.
    """
    start, neighbour = _adjacency(num_cameras, edges)
    links = np.zeros(num_cameras, dtype=np.int64)
    last = np.full(num_cameras, -1)  # the member that linked last: a pair given twice is one link
    members = np.empty(num_cameras, dtype=np.int64)
    members[0], members[1] = edges[0, 0], edges[0, 1]
    links[members[0]] = links[members[1]] = 2
    size, done = 2, 0
    while done < size:
        camera = members[done]
        done += 1
        for p in range(start[camera], start[camera + 1]):
            other = neighbour[p]
            links[other] += last[other] != camera
            if links[other] == 2 and last[other] != camera:
                members[size] = other
                size += 1
            last[other] = camera
    return bool(size == num_cameras)


@kernel()
def _adjacency(num_cameras: int, edges: IntArray) -> tuple[IntArray, IntArray]:
    """Return the neighbours of each camera, one camera after the other, and where each begins, (n + 1,)."""
    start = np.zeros(num_cameras + 2, dtype=np.int64)
    for e in range(len(edges)):
        start[edges[e, 0] + 2] += 1
        start[edges[e, 1] + 2] += 1
    for camera in range(num_cameras):
        start[camera + 2] += start[camera + 1]
    neighbour = np.empty(2 * len(edges), dtype=np.int64)
    for e in range(len(edges)):
        for side in range(2):
            camera = edges[e, side]
            neighbour[start[camera + 1]] = edges[e, 1 - side]
            start[camera + 1] += 1
    return start[:-1], neighbour


def rigid_pieces(graph: ViewGraph) -> list[RigidPiece]:
    """Return the parallel-rigid pieces of a view graph, largest first; single pairs are pieces too."""
    label = parallel_rigid_pieces(graph.num_cameras, graph.edges, graph.dimension)
    if len(label) == 0:
        return []
    num_pieces = int(label.max()) + 1
    start, cameras, _, _ = _incidence(graph.num_cameras, graph.edges, label, num_pieces)
    owner = np.repeat(np.arange(num_pieces), np.diff(start))
    cameras = cameras[np.lexsort((cameras, owner))]

    is_large = np.diff(start)[owner] >= 3
    large_at = np.bincount(cameras[is_large], minlength=graph.num_cameras)
    is_hinge = large_at[cameras] - is_large > 0

    edge_order = np.argsort(label, kind="stable").astype(np.int64)
    edge_start = np.searchsorted(label[edge_order], np.arange(num_pieces + 1))
    return [
        RigidPiece(
            cameras=frozen(cameras[start[k] : start[k + 1]]),
            edges=frozen(edge_order[edge_start[k] : edge_start[k + 1]]),
            hinges=frozen(cameras[start[k] : start[k + 1]][is_hinge[start[k] : start[k + 1]]]),
        )
        for k in range(num_pieces)
    ]


def left_out_reasons(graph: ViewGraph, pieces: list[RigidPiece]) -> dict[int, str]:
    """Say for each camera outside the largest piece why its position is not determined with it.

    Args:
        graph: the view graph.
        pieces: its pieces, as `rigid_pieces` returns them.

    Returns:
        Camera index, ascending, to one of: "no pair"; "another component"; "pendant: joined by a
        single pair to NAME"; "another rigid piece, hinged at NAME, ..."; "not rigidly tied to the
        largest piece". Hinges shared with the largest piece are named if there are any, else all
        hinges of the camera's piece. Without names in the graph, NAME is "camera K".
    """
    placed = np.zeros(graph.num_cameras, dtype=np.bool_)
    if pieces:
        placed[pieces[0].cameras] = True
    degree = graph.degrees()
    component = graph.components()
    main = component[pieces[0].cameras[0]] if pieces else -1
    neighbour = _a_neighbour(graph)
    home = _large_piece_of(graph.num_cameras, pieces)

    reasons: dict[int, str] = {}
    for camera in np.flatnonzero(~placed).tolist():
        if degree[camera] == 0:
            reasons[camera] = "no pair"
        elif component[camera] != main:
            reasons[camera] = "another component"
        elif degree[camera] == 1:
            reasons[camera] = f"pendant: joined by a single pair to {_name(graph, int(neighbour[camera]))}"
        else:
            hinges = _hinges_of(camera, int(home[camera]), pieces, placed)
            names = ", ".join(_name(graph, hinge) for hinge in hinges)
            reasons[camera] = (
                f"another rigid piece, hinged at {names}"
                if names
                else "not rigidly tied to the largest piece"
            )
    return reasons


def _a_neighbour(graph: ViewGraph) -> IntArray:
    """Return one neighbour of each camera (n,), -1 without any: the neighbour where there is one only."""
    neighbour = np.full(graph.num_cameras, -1, dtype=np.int64)
    neighbour[graph.edges[:, 0]] = graph.edges[:, 1]
    neighbour[graph.edges[:, 1]] = graph.edges[:, 0]
    return neighbour


def _large_piece_of(num_cameras: int, pieces: list[RigidPiece]) -> IntArray:
    """Return the first piece of at least 3 cameras that holds each camera (n,), or -1."""
    home = np.full(num_cameras, -1, dtype=np.int64)
    for k in reversed(range(len(pieces))):
        if len(pieces[k].cameras) >= 3:
            home[pieces[k].cameras] = k
    return home


def _hinges_of(camera: int, home: int, pieces: list[RigidPiece], placed: BoolArray) -> list[int]:
    """Return the hinges to name for a camera of piece `home`: the placed ones if any, never itself."""
    if home < 0:
        return []
    hinges = pieces[home].hinges
    to_largest = hinges[placed[hinges]]
    return [int(h) for h in (to_largest if len(to_largest) else hinges) if h != camera]


def _name(graph: ViewGraph, camera: int) -> str:
    """Return the name of a camera for a report."""
    return f"camera {camera}" if graph.names is None else graph.names[camera]


def _checked_edges(num_cameras: int, edges: IntArray, dimension: int) -> IntArray:
    """Return `edges` as a contiguous (m, 2) int64 array, or raise InputError."""
    if dimension < 2:
        raise InputError(f"parallel rigidity needs dimension >= 2, got {dimension}")
    checked = np.ascontiguousarray(edges, dtype=np.int64).reshape(-1, 2)
    index = _first_bad_edge(num_cameras, checked)
    if index < len(checked):
        raise InputError(
            f"edge {index} ({checked[index, 0]}, {checked[index, 1]}) must join two different cameras "
            f"of 0..{num_cameras - 1}"
        )
    return checked


@kernel()
def _first_bad_edge(num_cameras: int, edges: IntArray) -> int:
    """Return the first pair that leaves the cameras or joins one with itself; the number of pairs if none."""
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        if i == j or min(i, j) < 0 or max(i, j) >= num_cameras:
            return e
    return len(edges)


def _compact(label: IntArray) -> IntArray:
    """Renumber non-negative labels to 0..k-1, keeping their order."""
    used = np.zeros(int(label.max(initial=-1)) + 1, dtype=np.int64)
    used[label] = 1
    return np.asarray((np.cumsum(used) - 1)[label], dtype=np.int64)


def _ranked(num_cameras: int, edges: IntArray, body: IntArray) -> IntArray:
    """Renumber final pieces: more cameras, more edges, smaller first, smaller second camera first."""
    if len(body) == 0:
        return body
    num_bodies = int(body.max()) + 1
    start, cameras, _, _ = _incidence(num_cameras, edges, body, num_bodies)
    num_edges = np.bincount(body, minlength=num_bodies)
    smallest = np.minimum.reduceat(cameras, start[:-1])
    owner = np.repeat(np.arange(num_bodies), np.diff(start))
    others = np.where(cameras == smallest[owner], num_cameras, cameras)
    second = np.minimum.reduceat(others, start[:-1])  # two pieces never share both
    order = np.lexsort((second, smallest, -num_edges, -np.diff(start)))
    rank = np.empty(num_bodies, dtype=np.int64)
    rank[order] = np.arange(num_bodies)
    return np.asarray(rank[body], dtype=np.int64)


# --- steps 1 and 2: triangles, growth -----------------------------------------------------------


@kernel()
def _find(parent: IntArray, item: int) -> int:
    """Return the root of an item, halving its path."""
    while parent[item] != item:
        parent[item] = parent[parent[item]]
        item = parent[item]
    return item


@kernel()
def _unite(parent: IntArray, a: int, b: int) -> None:
    """Unite the sets of two items under the smaller root."""
    a = _find(parent, a)
    b = _find(parent, b)
    if a < b:
        parent[b] = a
    else:
        parent[a] = b


@kernel()
def _triangle_bodies(num_cameras: int, edges: IntArray) -> IntArray:
    """Return a root edge for each edge (m,): edges joined by a chain of triangles have the same.

    Each pair is directed to its end of higher degree, which leaves at most sqrt(2 m) pairs at any
    camera, and each triangle is met once, at its lowest end.
    """
    m = len(edges)
    degree = np.zeros(num_cameras, np.int64)
    for e in range(m):
        degree[edges[e, 0]] += 1
        degree[edges[e, 1]] += 1
    tail = np.empty(m, np.int64)
    start = np.zeros(num_cameras + 1, np.int64)
    for e in range(m):
        i, j = edges[e, 0], edges[e, 1]
        tail[e] = i if (degree[i], i) < (degree[j], j) else j
        start[tail[e] + 1] += 1
    start = np.cumsum(start)
    fill = start[:-1].copy()
    edge_of = np.empty(m, np.int64)
    head_of = np.empty(m, np.int64)
    for e in range(m):
        slot = fill[tail[e]]
        fill[tail[e]] += 1
        edge_of[slot] = e
        head_of[slot] = edges[e, 0] + edges[e, 1] - tail[e]

    parent = np.arange(m)
    seen_from = np.full(num_cameras, -1, np.int64)
    seen_edge = np.empty(num_cameras, np.int64)
    for a in range(num_cameras):
        for s in range(start[a], start[a + 1]):
            seen_from[head_of[s]] = a
            seen_edge[head_of[s]] = edge_of[s]
        for s in range(start[a], start[a + 1]):
            b = head_of[s]
            for r in range(start[b], start[b + 1]):
                c = head_of[r]
                if seen_from[c] == a:
                    _unite(parent, edge_of[s], edge_of[r])
                    _unite(parent, edge_of[s], seen_edge[c])
    for e in range(m):
        parent[e] = _find(parent, e)
    return parent


@kernel()
def _incidence(
    num_cameras: int, edges: IntArray, body: IntArray, num_bodies: int
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Return which cameras each body has, and which bodies each camera, as two (start, items) lists."""
    m = len(edges)
    edge_start = np.zeros(num_bodies + 1, np.int64)
    for e in range(m):
        edge_start[body[e] + 1] += 1
    edge_start = np.cumsum(edge_start)
    fill = edge_start[:-1].copy()
    edge_of = np.empty(m, np.int64)
    for e in range(m):
        edge_of[fill[body[e]]] = e
        fill[body[e]] += 1

    start = np.zeros(num_bodies + 1, np.int64)
    cameras = np.empty(2 * m, np.int64)
    back_start = np.zeros(num_cameras + 1, np.int64)
    last = np.full(num_cameras, -1, np.int64)
    count = 0
    for b in range(num_bodies):
        for s in range(edge_start[b], edge_start[b + 1]):
            for side in range(2):
                camera = edges[edge_of[s], side]
                if last[camera] != b:
                    last[camera] = b
                    cameras[count] = camera
                    back_start[camera + 1] += 1
                    count += 1
        start[b + 1] = count
    back_start = np.cumsum(back_start)
    fill = back_start[:-1].copy()
    bodies = np.empty(count, np.int64)
    for b in range(num_bodies):
        for s in range(start[b], start[b + 1]):
            bodies[fill[cameras[s]]] = b
            fill[cameras[s]] += 1
    return start, cameras[:count].copy(), back_start, bodies


def _grown(num_cameras: int, edges: IntArray, body: IntArray) -> IntArray:
    """Return body labels after growing every body of at least 3 cameras, largest first (step 2)."""
    for _ in range(_GROWTH_ROUNDS):
        num_bodies = int(body.max(initial=-1)) + 1
        start, cameras, back_start, bodies = _incidence(num_cameras, edges, body, num_bodies)
        growth = _Growth(
            start=start,
            cameras=cameras,
            back_start=back_start,
            bodies=bodies,
            parent=np.arange(num_bodies),
            taken=np.full(num_bodies, -1),
            met=np.full(num_bodies, -1),
            inside=np.full(num_cameras, -1),
            reached=np.full(num_cameras, -1),
            reached_by=np.full(num_cameras, -1),
            reached_at=np.full(num_cameras, -1),
            queue=np.full(num_cameras, -1),
        )
        size = np.diff(start)
        seeds = np.argsort(-size, kind="stable")[: int((size >= 3).sum())].astype(np.int64)
        _grow(growth, seeds, _GROWTH_WORK * len(cameras))
        if (growth.parent == np.arange(num_bodies)).all():
            break
        body = _compact(growth.parent[body])
    return body


class _Growth(NamedTuple):
    """State of growing bodies; a mark is valid where it equals the seed that grows."""

    start: IntArray
    cameras: IntArray
    back_start: IntArray
    bodies: IntArray
    """Cameras of each body, bodies at each camera."""
    parent: IntArray
    """(number of bodies,) which bodies were united."""
    taken: IntArray
    met: IntArray
    """(number of bodies,) marks: part of the seed; shares a camera with it."""
    inside: IntArray
    reached: IntArray
    """(n,) marks: camera of the seed; camera of a body that shares one with the seed, ..."""
    reached_by: IntArray
    reached_at: IntArray
    """(n,) ... the first such body, and the camera that it shares."""
    queue: IntArray
    """The seed's cameras, in the order of joining."""


@kernel()
def _grow(growth: _Growth, seeds: IntArray, max_work: int) -> None:
    """Let each seed absorb what step 2 allows; leave a root body for each body in `parent`."""
    for seed in seeds:
        if growth.parent[seed] == seed and growth.taken[seed] < 0 and max_work >= 0:
            max_work -= _grow_seed(growth, seed)
    for b in range(len(growth.parent)):
        growth.parent[b] = _find(growth.parent, b)


@kernel()
def _grow_seed(growth: _Growth, seed: int) -> int:
    """Absorb each body that meets the seed's cameras a second time; return the work done.

    A body larger than what has been grown so far is not searched for cameras that it shares with
    others, which bounds the work of small seeds beside large bodies.
    """
    work = 0
    tail = _absorb(growth, seed, seed, 0)
    head = 0
    while head < tail:
        camera = growth.queue[head]
        head += 1
        for s in range(growth.back_start[camera], growth.back_start[camera + 1]):
            b = growth.bodies[s]
            work += 1
            if growth.taken[b] == seed:
                continue
            size = growth.start[b + 1] - growth.start[b]
            if growth.met[b] == seed:
                tail = _absorb(growth, seed, b, tail)
            elif size <= tail:
                work += size
                tail = _reach_out(growth, seed, b, camera, tail)
            growth.met[b] = seed
    return work


@kernel()
def _reach_out(growth: _Growth, seed: int, b: int, camera: int, tail: int) -> int:
    """Mark the cameras of a body that meets the seed at `camera`; absorb it if that closes a triangle.

    The triangle is the seed, this body, and one that meets the seed elsewhere and this body outside.
    Two bodies that meet the seed at the same camera, and each other outside, share two cameras.
    """
    for s in range(growth.start[b], growth.start[b + 1]):
        other = growth.cameras[s]
        if growth.inside[other] == seed:
            continue
        if growth.reached[other] != seed:
            growth.reached[other] = seed
            growth.reached_by[other] = b
            growth.reached_at[other] = camera
        elif growth.reached_at[other] == camera:
            _unite(growth.parent, growth.reached_by[other], b)
        else:
            tail = _absorb(growth, seed, growth.reached_by[other], tail)
            return _absorb(growth, seed, b, tail)
    return tail


@kernel()
def _absorb(growth: _Growth, seed: int, eaten: int, tail: int) -> int:
    """Unite a body with the seed and queue the cameras that it brings; return the queue's new tail."""
    if growth.taken[eaten] == seed:
        return tail
    growth.taken[eaten] = seed
    _unite(growth.parent, seed, eaten)
    for s in range(growth.start[eaten], growth.start[eaten + 1]):
        if growth.inside[growth.cameras[s]] != seed:
            growth.inside[growth.cameras[s]] = seed
            growth.queue[tail] = growth.cameras[s]
            tail += 1
    return tail


# --- step 3: the pebble game on the frames of the bodies ----------------------------------------


class _Game(NamedTuple):
    """Bodies as frames: a multigraph on the cameras they share, or on the first few of these."""

    num_cameras: int
    ends: IntArray
    """(k, 2) renumbered cameras of each link of a frame."""
    copies: IntArray
    """(k,) how many copies of an edge the link stands for."""
    owner: IntArray
    """(k,) the body that the link belongs to."""
    num_bodies: int
    is_whole: bool
    """Whether all shared cameras take part."""


def _contract(num_cameras: int, edges: IntArray, body: IntArray, part: int, dimension: int) -> _Game:
    """Return the frames of all bodies on the first `part` cameras that are shared by bodies."""
    num_bodies = int(body.max(initial=-1)) + 1
    start, cameras, back_start, _ = _incidence(num_cameras, edges, body, num_bodies)
    is_shared = np.diff(back_start) >= 2
    number = np.where(is_shared, np.cumsum(is_shared) - 1, part)
    owner = np.repeat(np.arange(num_bodies), np.diff(start))
    kept = number[cameras] < part
    owner, member = owner[kept], number[cameras[kept]]
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
    by_last_camera = np.argsort(ends.max(axis=1, initial=0), kind="stable")
    return _Game(
        num_cameras=min(part, int(is_shared.sum())),
        ends=ends[by_last_camera].astype(np.int64),
        copies=copies[by_last_camera].astype(np.int64),
        owner=owner[by_last_camera].astype(np.int64),
        num_bodies=num_bodies,
        is_whole=bool(is_shared.sum() <= part),
    )


def _play(game: _Game, dimension: int) -> tuple[IntArray, bool]:
    """Play a game and unite bodies by what it shows.

    Returns:
        The rigid set that each body lies in, (number of bodies,), compact; and whether these sets are
        all that there are. If not, two bodies at least were united, and the game has to be played again.
    """
    start, link_of = _links_at(game.num_cameras, game.ends)
    board = _Board(
        target=np.full((game.num_cameras, dimension), -1, dtype=np.int64),
        free=np.full(game.num_cameras, dimension, dtype=np.int64),
        start=start,
        link_of=link_of,
        ends=game.ends,
        seen=np.zeros(game.num_cameras, dtype=np.int64),
        came_from=np.zeros(game.num_cameras, dtype=np.int64),
        came_by=np.zeros(game.num_cameras, dtype=np.int64),
        queue=np.zeros(game.num_cameras, dtype=np.int64),
        inside=np.zeros(game.num_cameras, dtype=np.int64),
        escapes=np.zeros(game.num_cameras, dtype=np.int64),
        members=np.zeros(game.num_cameras, dtype=np.int64),
        clock=np.zeros(2, dtype=np.int64),
    )
    mark = _place_links(board, game.copies, _GAME_WORK * game.num_cameras)
    if board.free.sum() == dimension + 1:  # the whole is one rigid set
        united = np.arange(game.num_bodies)
        united[game.owner] = game.owner.min()
        return _compact(united), True
    if (mark >= 0).any():
        return _compact(_bodies_by_marks(board, game.owner, game.num_bodies, mark)), False
    return _compact(_bodies_by_search(board, game.owner, game.num_bodies)), True


def _links_at(num_cameras: int, ends: IntArray) -> tuple[IntArray, IntArray]:
    """Return the links at each camera as a (start, links) list."""
    order = np.argsort(ends.ravel(), kind="stable")
    start = np.zeros(num_cameras + 1, dtype=np.int64)
    start[1:] = np.cumsum(np.bincount(ends.ravel(), minlength=num_cameras))
    return start, (order // 2).astype(np.int64)


class _Board(NamedTuple):
    """State of a pebble game: d pebbles per camera, each free or covering a copy that leaves it."""

    target: IntArray
    """(n, d) camera that the copy under each pebble leads to, -1 for a free pebble."""
    free: IntArray
    """(n,) number of free pebbles."""
    start: IntArray
    link_of: IntArray
    ends: IntArray
    """Links at each camera, and their two ends, placed or not."""
    seen: IntArray
    came_from: IntArray
    came_by: IntArray
    queue: IntArray
    """Marks of the running search, valid where `seen` equals clock[0]."""
    inside: IntArray
    escapes: IntArray
    members: IntArray
    """Marks of the running rigid set, valid where they equal clock[1]; its cameras."""
    clock: IntArray


@kernel()
def _fetch_pebble(board: _Board, u: int, v: int) -> bool:
    """Move one free pebble to camera u along a path of copies, sparing camera v; False if none is left."""
    board.clock[0] += 1
    now = board.clock[0]
    board.seen[u] = now
    board.seen[v] = now
    board.queue[0] = u
    head, tail = 0, 1
    while head < tail:
        x = board.queue[head]
        head += 1
        for s in range(board.target.shape[1]):
            w = board.target[x, s]
            if w < 0 or board.seen[w] == now:
                continue
            board.seen[w] = now
            board.came_from[w] = x
            board.came_by[w] = s
            if board.free[w] > 0:
                _reverse_path(board, u, w)
                return True
            board.queue[tail] = w
            tail += 1
    return False


@kernel()
def _reverse_path(board: _Board, u: int, w: int) -> None:
    """Turn the copies on the path found from u to w, so that a pebble of w becomes free at u."""
    slot = _free_slot(board, w)
    board.free[w] -= 1
    while w != u:
        x = board.came_from[w]
        board.target[w, slot] = x
        slot = board.came_by[w]
        w = x
    board.target[u, slot] = -1
    board.free[u] += 1


@kernel()
def _free_slot(board: _Board, u: int) -> int:
    """Return the first free pebble of a camera that has one."""
    slot = 0
    while board.target[u, slot] >= 0:
        slot += 1
    return slot


@kernel()
def _gather(board: _Board, u: int, v: int, wanted: int) -> int:
    """Bring free pebbles to u and v until they hold `wanted` in all, or no more can come; return how many."""
    dimension = board.target.shape[1]
    while board.free[u] + board.free[v] < wanted and (
        (board.free[u] < dimension and _fetch_pebble(board, u, v))
        or (board.free[v] < dimension and _fetch_pebble(board, v, u))
    ):
        pass
    return int(board.free[u] + board.free[v])


@kernel()
def _place_links(board: _Board, copies: IntArray, max_work: int) -> IntArray:
    """Play the game: place as many copies of each link as are independent of those before.

    Gathering g pebbles on the ends of a link shows that g - (d + 1) more copies are independent. If
    that is fewer than asked, both ends lie in a rigid set; its cameras are marked, so that links inside
    it are passed over at once. The game ends early when the whole is rigid, or when `max_work` cameras
    have been marked: contracting what was found is then cheaper than going on.

    Returns:
        (n,) the link by which a camera was found to lie in a rigid set, -1 for none.
    """
    n, dimension = board.target.shape
    room = dimension * n - (dimension + 1)
    mark = np.full(n, -1, np.int64)
    size_at = np.zeros(len(copies), np.int64)
    for k in range(len(copies)):
        u, v = board.ends[k, 0], board.ends[k, 1]
        if mark[u] >= 0 and mark[u] == mark[v]:
            continue
        gathered = _gather(board, u, v, dimension + 1 + copies[k])
        placed = min(copies[k], gathered - (dimension + 1))
        for _ in range(placed):
            a, b = (u, v) if board.free[u] > 0 else (v, u)
            board.target[a, _free_slot(board, a)] = b
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
    return mark


@kernel()
def _rigid_set(board: _Board, u: int, v: int) -> int:
    """Collect the largest rigid set around u and v, which hold all the d + 1 pebbles that they can.

    It consists of the cameras that no path of copies leads from to a free pebble elsewhere. Returns
    its size; its cameras stand in `members`, and `inside` marks them.
    """
    board.clock[1] += 1
    now = board.clock[1]
    board.members[0] = u
    board.members[1] = v
    board.inside[u] = now
    board.inside[v] = now
    head, size = 0, 2
    while head < size:
        x = board.members[head]
        head += 1
        for s in range(board.start[x], board.start[x + 1]):
            k = board.link_of[s]
            w = board.ends[k, 0] + board.ends[k, 1] - x
            if board.inside[w] != now and board.escapes[w] != now:
                size = _join_unless_escaping(board, w, size)
    return size


@kernel()
def _join_unless_escaping(board: _Board, w: int, size: int) -> int:
    """Follow all copies from w: if none escapes to a free pebble, all cameras met join the rigid set."""
    rigid = board.clock[1]
    board.clock[0] += 1
    now = board.clock[0]
    board.seen[w] = now
    board.came_from[w] = -1
    board.queue[0] = w
    head, tail = 0, 1
    while head < tail:
        x = board.queue[head]
        head += 1
        if board.free[x] > 0 or board.escapes[x] == rigid:
            while x >= 0:
                board.escapes[x] = rigid
                x = board.came_from[x]
            return size
        for s in range(board.target.shape[1]):
            y = board.target[x, s]
            if y >= 0 and board.seen[y] != now and board.inside[y] != rigid:
                board.seen[y] = now
                board.came_from[y] = x
                board.queue[tail] = y
                tail += 1
    for q in range(tail):
        board.inside[board.queue[q]] = rigid
        board.members[size] = board.queue[q]
        size += 1
    return size


@kernel()
def _bodies_by_marks(board: _Board, owner: IntArray, num_bodies: int, mark: IntArray) -> IntArray:
    """Return a root body for each body: bodies with two cameras of the same mark have the same."""
    parent = np.arange(num_bodies)
    for k in range(len(owner)):
        u, v = board.ends[k, 0], board.ends[k, 1]
        if mark[u] >= 0 and mark[u] == mark[v]:
            _unite(parent, owner[k], owner[mark[u]])
    for b in range(num_bodies):
        parent[b] = _find(parent, b)
    return parent


@kernel()
def _bodies_by_search(board: _Board, owner: IntArray, num_bodies: int) -> IntArray:
    """Return a root body for each body after a full game: bodies in the same rigid set have the same."""
    parent = np.arange(num_bodies)
    done = np.zeros(num_bodies, np.bool_)
    for k in range(len(owner)):
        if done[owner[k]]:
            continue
        u, v = board.ends[k, 0], board.ends[k, 1]
        _gather(board, u, v, 2 * board.target.shape[1])
        for q in range(_rigid_set(board, u, v)):
            x = board.members[q]
            for s in range(board.start[x], board.start[x + 1]):
                link = board.link_of[s]
                w = board.ends[link, 0] + board.ends[link, 1] - x
                if board.inside[w] == board.clock[1]:
                    done[owner[link]] = True
                    _unite(parent, owner[k], owner[link])
    for b in range(num_bodies):
        parent[b] = _find(parent, b)
    return parent
