"""Where everything stands: unknowns in nodes, observations by point, and which nodes meet in which points.

The camera side of the normal equations has one block of six unknowns for each node: a frame (center, then
rotation vector), a lens (focal lengths, then distortion), or a sensor that is free in its rig (center, then
rotation vector, in axes of the rig). What is held leaves its slot empty, a frame that is fixed has no node.
Lenses of few unknowns that look at the same points share a node: of a collection of 457 images with a lens
each, a step takes a third of the time that it takes with 454 nodes whose blocks are for the most part empty.
An entry is a node that sees a point; entries are sorted by point, then by node, frames before lenses before
sensors. Two nodes that meet in a point are a pair (i < j): a block of the reduced system.

Where nothing but free sensors tells the scale, the longest of their baselines keeps its length: its center
moves in the plane across it, `sensor_bases` has no third column, and the slot is empty.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IndexArray, IntArray, distinct, frozen
from sfm_shapefit.base.geometry import normalized, tangent_bases
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.laplacian.operators import Workers, group_by
from sfm_shapefit.scene.lens import NUM_VALUES, PARTS, Lens

SLOTS = 6  # unknowns of a node at most; a frame has six, a lens no more
_WORTH_A_THREAD = 20_000  # observations or entries; sorting fewer takes no longer than waking a thread
_LEAST_SHARED = 0.1  # share of a lens's points; those that have less in common would only fill a node


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Layout:
    """The structure of one adjustment; nothing in it changes from iteration to iteration."""

    node_of_frame: IntArray
    """(n,) -1 if it is fixed."""
    node_of_lens: IntArray
    """(l,) -1 if it is held; lenses may share one."""
    node_of_sensor: IntArray
    """(s,) node of each free sensor."""
    sensor_bases: FloatArray
    """(s, 3, 3) whose columns are the directions, in axes of the rig, in which each sensor's center moves."""
    scale_sensor: int
    """The sensor whose distance from the origin of its rig keeps its length; -1 if something else does."""
    active: BoolArray
    """(N, 6) which slots of each node are unknowns."""
    lens_slots: IntArray
    """(l, 8) the slot of each value of a lens in its node; -1 if held."""
    held_of_lens: FloatArray
    """(l, 9) the other numbers of each lens, which never change."""

    first_observation: IntArray
    """(k + 1,) first observation of each point."""
    camera: IndexArray
    """(m,) camera of each observation."""
    pixels: FloatArray
    """(m, 2)"""
    frame_entry: IndexArray
    """(m,) entry of the observation's frame, or -1."""
    lens_entry: IndexArray
    """(m,) entry of its lens, or -1."""
    sensor_entry: IndexArray
    """(m,) entry of its sensor, or -1."""

    frame_of_camera: IntArray
    """(c,)"""
    lens_of_camera: IntArray
    """(c,)"""
    sensor_of_camera: IntArray
    """(c,) free sensor, or -1."""
    links_of_camera: IntArray
    """(3, c) places in `links` of the camera's frame and lens, frame and sensor, lens and sensor; or -1."""
    links: IntArray
    """(q, 2) nodes that one observation ties."""

    first_entry: IntArray
    """(k + 1,) first entry of each point."""
    entry_node: IndexArray
    """(E,)"""
    entry_point: IndexArray
    """(E,)"""
    first_of_node: IntArray
    """(N + 1,) into `entries_by_node`."""
    entries_by_node: IndexArray
    """(E,)"""
    first_pair: IntArray
    """(N + 1,) the pairs whose first node is i."""
    pairs: IntArray
    """(P, 2) nodes that meet, i < j, sorted."""
    link_pair: IntArray
    """(q,) the pair of each link."""

    turns: bool
    """Whether rotations are unknowns."""

    @property
    def num_nodes(self) -> int:
        """Number of nodes, N."""
        return len(self.active)

    @property
    def num_points(self) -> int:
        """Number of points, k."""
        return len(self.first_observation) - 1

    @property
    def num_unknowns(self) -> int:
        """Unknowns of the reduced system."""
        return int(self.active.sum())


class Nodes(NamedTuple):
    """What is unknown of an adjustment, in nodes; fields as of `Layout`."""

    node_of_frame: IntArray
    node_of_lens: IntArray
    node_of_sensor: IntArray
    active: BoolArray
    lens_slots: IntArray
    sensor_bases: FloatArray
    scale_sensor: int


def number_nodes(problem: AdjustmentProblem, options: AdjustmentOptions) -> Nodes:
    """Return the nodes of an adjustment: frames, then lenses, then sensors."""
    scale_sensor = find_scale_sensor(problem)
    return Nodes(*_nodes(problem, options, scale_sensor), _sensor_bases(problem, scale_sensor), scale_sensor)


def lay_out(problem: AdjustmentProblem, options: AdjustmentOptions, nodes: Nodes | None = None) -> Layout:
    """Return the structure of an adjustment; of a part of one, whose nodes are those of the whole."""
    frame_of_camera, sensor_of_camera = problem.rig.frame_of_camera, problem.rig.free_sensor_of_camera
    numbers = number_nodes(problem, options) if nodes is None else nodes
    node_of_frame, node_of_lens, node_of_sensor, active = numbers[:4]
    point, camera, pixels = problem.points_seen, problem.cameras_seeing, problem.pixels
    if (point[1:] < point[:-1]).any():  # else the arrays are shared, since all of them are large
        order = np.argsort(point, kind="stable")
        point, camera, pixels = point[order], camera[order], np.ascontiguousarray(pixels[order])
    first_observation = np.searchsorted(point, np.arange(problem.num_points + 1))
    frame_node = node_of_frame[frame_of_camera]
    lens_node = node_of_lens[problem.lens_of_camera]
    sensor_node = np.append(node_of_sensor, -1)[sensor_of_camera]
    seeing = np.stack([frame_node, lens_node, sensor_node])
    workers = Workers(options.threads)
    where = np.full((3, len(camera)), -1, dtype=np.int32)  # as it stays where there is no entry
    enter = partial(_enter, first_observation, camera, seeing, where)
    first_entry, entry_node = _list(enter, first_observation, workers)
    entry_point = np.repeat(np.arange(problem.num_points, dtype=np.int32), np.diff(first_entry))
    first_of_node, by_node = group_by(frozen(entry_node), len(active))
    meet = partial(_meet, first_of_node, by_node, entry_point, entry_node, first_entry)
    first_pair, seconds = _list(meet, first_of_node, workers)
    workers.close()
    pairs = np.stack([np.repeat(np.arange(len(active)), np.diff(first_pair)), seconds], axis=1)
    links, links_of_camera = _links(seeing, camera)
    pair_keys = pairs[:, 0] * len(active) + pairs[:, 1]
    return Layout(
        **numbers._asdict(),
        held_of_lens=held_of(problem.lenses),
        first_observation=first_observation,
        camera=camera,
        pixels=pixels,
        frame_entry=where[0],
        lens_entry=where[1],
        sensor_entry=where[2],
        frame_of_camera=frame_of_camera,
        lens_of_camera=problem.lens_of_camera,
        sensor_of_camera=sensor_of_camera,
        links_of_camera=links_of_camera,
        links=links,
        first_entry=first_entry,
        entry_node=entry_node,
        entry_point=entry_point,
        first_of_node=first_of_node,
        entries_by_node=by_node.astype(np.int32),
        first_pair=first_pair,
        pairs=pairs,
        turns=not options.hold_rotations,
        link_pair=np.searchsorted(pair_keys, links[:, 0] * len(active) + links[:, 1]),
    )


def held_of(lenses: Sequence[Lens]) -> FloatArray:
    """Return the numbers of each lens that never change, (l, 9)."""
    return np.array([lens.row()[NUM_VALUES:] for lens in lenses]).reshape(-1, 9)


def find_scale_sensor(problem: AdjustmentProblem) -> int:
    """Return the free sensor farthest from the origin of its rig if nothing else sets the scale, or -1."""
    free, sizes = problem.rig.free_sensor_of_camera, np.linalg.norm(problem.rig.translations, axis=1)
    priors = 0 if problem.center_prior is None else len(problem.center_prior.indices)
    known = sizes[free < 0].any() or max(int(problem.fixed.sum()), priors) > 1
    seeing = np.zeros(len(free), np.bool_)
    seeing[problem.cameras_seeing] = True  # a sensor that sees nothing says nothing of any scale
    sizes = np.where(seeing & (free >= 0), sizes, 0.0)
    return -1 if known or not sizes.any() else int(free[np.argmax(sizes)])


def _sensor_bases(problem: AdjustmentProblem, scale_sensor: int) -> FloatArray:
    """Return the directions in which the center of each free sensor moves, (s, 3, 3)."""
    free = problem.rig.free_sensor_of_camera
    bases = np.tile(np.eye(3), (int(free.max(initial=-1)) + 1, 1, 1))
    if scale_sensor >= 0:
        center = problem.rig.sensor_centers()[np.argmax(free == scale_sensor)]
        bases[scale_sensor, :, :2] = tangent_bases(normalized(center)[None])[0]
        bases[scale_sensor, :, 2] = 0.0
    return bases


def _nodes(
    problem: AdjustmentProblem, options: AdjustmentOptions, scale_sensor: int
) -> tuple[IntArray, IntArray, IntArray, BoolArray, IntArray]:
    """Number the nodes; return node_of_frame, node_of_lens, node_of_sensor, active and lens_slots."""
    moves = ~problem.fixed
    node_of_frame = np.where(moves, np.cumsum(moves) - 1, -1)
    free = np.array([getattr(options, f"free_{part}") for part in PARTS])
    lens_slots = np.array([lens.slots(free) for lens in problem.lenses]).reshape(-1, NUM_VALUES)
    sizes = lens_slots.max(axis=1, initial=-1) + 1
    packs, first_slots = _pack(problem, sizes)
    lens_slots = np.where(lens_slots >= 0, lens_slots + first_slots[:, None], -1)
    node_of_lens = np.where(packs >= 0, int(moves.sum()) + packs, -1)
    size_of_pack = np.bincount(packs[packs >= 0], sizes[packs >= 0]).astype(np.int64)
    num_sensors = int(problem.rig.free_sensor_of_camera.max(initial=-1)) + 1
    node_of_sensor = int(moves.sum()) + len(size_of_pack) + np.arange(num_sensors)
    size_of_frame = 3 if options.hold_rotations else SLOTS
    of_frames, of_sensors = np.full(int(moves.sum()), size_of_frame), np.full(num_sensors, SLOTS)
    size_of_node = np.concatenate([of_frames, size_of_pack, of_sensors])
    active = np.arange(SLOTS) < size_of_node[:, None]
    if scale_sensor >= 0:
        active[node_of_sensor[scale_sensor], 2] = False
    if not problem.rig.translations.any():  # sensors that share one center only turn
        active[node_of_sensor, :3] = False
    return node_of_frame, node_of_lens, node_of_sensor, active, lens_slots


def _pack(problem: AdjustmentProblem, sizes: IntArray) -> tuple[IntArray, IntArray]:
    """Return the pack of each lens (l,), -1 if it is held, and the first of its slots there.

    Each lens takes in those that share most points with it, as long as there is room and these are a tenth of
    its own: what is apart would else meet in a block. `sizes` (l,) are the lenses' numbers of unknowns.
    """
    packs, first_slots = np.full(len(sizes), -1), np.zeros(len(sizes), np.int64)
    small = np.flatnonzero((sizes > 0) & (2 * sizes <= SLOTS))
    if len(small) < 2:
        packs[sizes > 0] = np.arange(np.sum(sizes > 0))
        return packs, first_slots
    from scipy.sparse import coo_array  # here, since it takes long to import

    row_of = np.full(len(sizes), -1)
    row_of[small] = np.arange(len(small))
    rows = row_of[problem.lens_of_camera[problem.cameras_seeing]]
    seen = distinct(rows[rows >= 0] * problem.num_points + problem.points_seen[rows >= 0].astype(np.int64))
    of_rows = (np.ones(len(seen), np.int32), np.divmod(seen, max(problem.num_points, 1)))
    sees = coo_array(of_rows, shape=(len(small), problem.num_points)).tocsr()
    shared, num_packs = sees @ sees.T, 0
    for lens in np.flatnonzero(sizes > 0).tolist():
        if packs[lens] >= 0:
            continue
        packs[lens], room = num_packs, SLOTS - sizes[lens]
        if row_of[lens] >= 0:
            own = slice(*shared.indptr[row_of[lens] : row_of[lens] + 2].tolist())
            others, counts = small[shared.indices[own]], shared.data[own]
            for k in np.lexsort((others, -counts)).tolist():
                other = others[k]
                if packs[other] < 0 and sizes[other] <= room and counts[k] >= _LEAST_SHARED * counts.max():
                    packs[other], first_slots[other] = num_packs, SLOTS - room
                    room -= sizes[other]
        num_packs += 1
    return packs, first_slots


def _links(nodes: IntArray, camera: IndexArray) -> tuple[IntArray, IntArray]:
    """Return the nodes that an observation ties, and the places of each camera's three ties (3, c), or -1.

    The nodes (3, c) are those of each camera's frame, lens and sensor, `camera` that of each observation.
    """
    sees = np.zeros(nodes.shape[1], np.bool_)
    sees[camera] = True
    both = np.stack([nodes[[0, 0, 1]], nodes[[1, 2, 2]]], axis=2)
    linked = sees & (both >= 0).all(axis=2)
    links, inverse = np.unique(both[linked], axis=0, return_inverse=True)
    links_of_camera = np.full(linked.shape, -1)
    links_of_camera[linked] = inverse.ravel()
    return links, links_of_camera


def _list(write: Callable[..., None], starts: IntArray, workers: Workers) -> tuple[IntArray, IndexArray]:
    """Return what a kernel lists for each row, as where the lists begin (n + 1,) and all items.

    Called with `first` and `out`, it counts the items of row i into first[i + 1], or writes them if `out` has
    room. Rows are shared out by `starts`, see `Workers.share`.
    """
    first, out = np.zeros(len(starts), np.int64), np.empty(0, np.int32)
    workers.share(starts, partial(write, first, out), _WORTH_A_THREAD)
    np.cumsum(first, out=first)
    out = np.empty(int(first[-1]), np.int32)
    workers.share(starts, partial(write, first, out), _WORTH_A_THREAD)
    return first, out


@kernel
def _enter(
    first_observation: Any, camera: Any, nodes: Any, where: Any, first: Any, out: Any, begin: int, end: int
) -> None:
    """List the nodes that see each of some points, ascending; if there is room, write entries where seen."""
    longest = 0
    for p in range(begin, end):
        longest = max(longest, first_observation[p + 1] - first_observation[p])
    found = np.empty(3 * longest, np.int64)
    for p in range(begin, end):
        count = 0
        for k in range(first_observation[p], first_observation[p + 1]):
            for kind in range(3):
                count = _insert(nodes[kind, camera[k]], found, count)
        if len(out) == 0:
            first[p + 1] = count
            continue
        for q in range(count):
            out[first[p] + q] = found[q]
        for k in range(first_observation[p], first_observation[p + 1]):
            for kind in range(3):
                at = 0
                while at < count and found[at] != nodes[kind, camera[k]]:
                    at += 1
                where[kind, k] = first[p] + at if at < count else -1


@inner_kernel
def _insert(node: int, found: Any, count: int) -> int:
    """Insert a node that is not -1 into an ascending list of so many, if it is new; return how many then."""
    at = count
    while at > 0 and found[at - 1] > node:
        at -= 1
    if node < 0 or (at > 0 and found[at - 1] == node):
        return count
    for q in range(count, at, -1):
        found[q] = found[q - 1]
    found[at] = node
    return count + 1


@kernel
def _meet(
    first_of_node: Any, by_node: Any, entry_point: Any, entry_node: Any, first_entry: Any,
    first: Any, out: Any, begin: int, end: int,
) -> None:  # fmt: skip
    """List the later nodes that each of some nodes meets, ascending."""
    mark = np.full(len(first) - 1, -1, np.int64)
    for i in range(begin, end):
        count, last = 0, i
        for q in range(first_of_node[i], first_of_node[i + 1]):
            e = by_node[q]
            for other in range(e + 1, first_entry[entry_point[e] + 1]):
                j = entry_node[other]
                count += mark[j] != i
                mark[j] = i
                last = max(last, j)
        if len(out) == 0:
            first[i + 1] = count
            continue
        at = first[i]
        for j in range(i + 1, last + 1):
            if mark[j] == i:
                out[at] = j
                at += 1
