"""Where everything stands: unknowns in nodes, observations by point, and which nodes meet in which points.

The camera side of the normal equations has one block of six unknowns for each node: a frame (center, then
rotation vector) or a lens (focal lengths, then distortion). What is held leaves its slot empty, a frame that
is fixed has no node. An entry is a node that sees a point; entries are sorted by point, then by node, lenses
after frames. Two nodes that meet in a point are a pair (i < j): a block of the reduced system.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sfm_shapefit.adjustment.options import AdjustmentOptions
from sfm_shapefit.adjustment.problem import NUM_VALUES, AdjustmentProblem
from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.jit import kernel

SLOTS = 6
"""Unknowns of a node at most."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Layout:
    """The structure of one adjustment; nothing in it changes from iteration to iteration."""

    node_of_frame: IntArray
    """(n,) -1 if it is fixed."""
    node_of_lens: IntArray
    """(l,) -1 if it is held."""
    active: BoolArray
    """(N, 6) which slots of each node are unknowns."""
    lens_slots: IntArray
    """(l, 8) the slot of each parameter of the OPENCV model in its lens' node; -1 if held."""

    observation: IntArray
    """(m,) the order by points: row of the problem's observations that stands k-th here."""
    first_observation: IntArray
    """(k + 1,) of each point."""
    camera: IntArray
    """(m,) of each observation."""
    pixels: FloatArray
    """(m, 2)"""
    frame_entry: IntArray
    """(m,) entry of the observation's frame, or -1."""
    lens_entry: IntArray
    """(m,) entry of its lens, or -1."""

    frame_of_camera: IntArray
    """(c,)"""
    lens_of_camera: IntArray
    """(c,)"""
    sensor_rotations: FloatArray
    """(c, 3, 3) of sensor_from_rig."""
    sensor_translations: FloatArray
    """(c, 3) of sensor_from_rig."""
    link_of_camera: IntArray
    """(c,) place in `links` of the camera's frame and lens, or -1."""
    links: IntArray
    """(q, 2) frame nodes and lens nodes that one observation ties."""

    first_entry: IntArray
    """(k + 1,) of each point."""
    entry_node: IntArray
    """(E,)"""
    entry_point: IntArray
    """(E,)"""
    first_of_node: IntArray
    """(N + 1,) into `entries_by_node`."""
    entries_by_node: IntArray
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


def lay_out(problem: AdjustmentProblem, options: AdjustmentOptions) -> Layout:
    """Return the structure of an adjustment."""
    frame_of_camera, sensor_rotations, sensor_translations = _sensors(problem)
    node_of_frame, node_of_lens, active, lens_slots = _nodes(problem, options)
    order = np.argsort(problem.points_seen, kind="stable")
    point, camera = problem.points_seen[order], problem.cameras_seeing[order]
    frame_node = node_of_frame[frame_of_camera]
    lens_node = node_of_lens[problem.lens_of_camera]
    keys, where = _entries(point, frame_node[camera], lens_node[camera], len(active))
    entry_point, entry_node = keys // max(len(active), 1), keys % max(len(active), 1)
    first_entry = np.searchsorted(entry_point, np.arange(problem.num_points + 1))
    by_node = np.argsort(entry_node, kind="stable")
    first_of_node = np.searchsorted(entry_node[by_node], np.arange(len(active) + 1))
    first_pair, seconds = _pairs(first_of_node, by_node, entry_point, entry_node, first_entry)
    pairs = np.stack([np.repeat(np.arange(len(active)), np.diff(first_pair)), seconds], axis=1)
    links, link_of_camera = _links(frame_node, lens_node, camera)
    pair_keys = pairs[:, 0] * len(active) + pairs[:, 1]
    return Layout(
        node_of_frame=node_of_frame,
        node_of_lens=node_of_lens,
        active=active,
        lens_slots=lens_slots,
        observation=order,
        first_observation=np.searchsorted(point, np.arange(problem.num_points + 1)),
        camera=camera,
        pixels=np.ascontiguousarray(problem.pixels[order]),
        frame_entry=where[0],
        lens_entry=where[1],
        frame_of_camera=frame_of_camera,
        lens_of_camera=problem.lens_of_camera,
        sensor_rotations=sensor_rotations,
        sensor_translations=sensor_translations,
        link_of_camera=link_of_camera,
        links=links,
        first_entry=first_entry,
        entry_node=entry_node,
        entry_point=entry_point,
        first_of_node=first_of_node,
        entries_by_node=by_node,
        first_pair=first_pair,
        pairs=pairs,
        turns=not options.hold_rotations,
        link_pair=np.searchsorted(pair_keys, links[:, 0] * len(active) + links[:, 1]),
    )


def _sensors(problem: AdjustmentProblem) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the frame of each camera and its sensor_from_rig."""
    if problem.rig is None:
        n = problem.num_frames
        return np.arange(n), np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    rotations = np.ascontiguousarray(problem.rig.rotations, dtype=np.float64)
    translations = np.ascontiguousarray(problem.rig.translations, dtype=np.float64)
    return np.asarray(problem.rig.frame_of_camera, dtype=np.int64), rotations, translations


def _nodes(
    problem: AdjustmentProblem, options: AdjustmentOptions
) -> tuple[IntArray, IntArray, BoolArray, IntArray]:
    """Number the nodes, frames first; return node_of_frame, node_of_lens, active and lens_slots."""
    moves = ~problem.is_fixed()
    node_of_frame = np.where(moves, np.cumsum(moves) - 1, -1)
    free = {"focal_lengths": options.free_focal_lengths, "distortion": options.free_distortion}
    lens_slots = np.array([lens.slots(**free) for lens in problem.lenses]).reshape(-1, NUM_VALUES)
    sizes = lens_slots.max(axis=1, initial=-1) + 1
    adjusted = sizes > 0
    node_of_lens = np.where(adjusted, int(moves.sum()) + np.cumsum(adjusted) - 1, -1)
    size_of_frame = 3 if options.hold_rotations else SLOTS
    size_of_node = np.concatenate([np.full(int(moves.sum()), size_of_frame), sizes[adjusted]])
    active = np.arange(SLOTS) < size_of_node[:, None]
    return node_of_frame, node_of_lens, active, lens_slots


def _entries(
    point: IntArray, frame_node: IntArray, lens_node: IntArray, num_nodes: int
) -> tuple[IntArray, IntArray]:
    """Return sorted entries, as point * N + node, and those of each observation's frame and lens (2, m)."""
    nodes = np.stack([frame_node, lens_node])
    has = nodes >= 0
    keys, inverse = np.unique((point * num_nodes + nodes)[has], return_inverse=True)
    where = np.full(nodes.shape, -1)
    where[has] = inverse
    return keys, where


def _links(frame_node: IntArray, lens_node: IntArray, camera: IntArray) -> tuple[IntArray, IntArray]:
    """Return the frame and lens nodes that an observation ties, and the place of each camera's, or -1."""
    sees = np.zeros(len(frame_node), np.bool_)
    sees[camera] = True
    linked = np.flatnonzero(sees & (frame_node >= 0) & (lens_node >= 0))
    both = np.stack([frame_node[linked], lens_node[linked]], axis=1)
    links, inverse = np.unique(both, axis=0, return_inverse=True)
    link_of_camera = np.full(len(frame_node), -1)
    link_of_camera[linked] = inverse.ravel()
    return links, link_of_camera


def _pairs(
    first_of_node: IntArray,
    by_node: IntArray,
    entry_point: IntArray,
    entry_node: IntArray,
    first_entry: IntArray,
) -> tuple[IntArray, IntArray]:
    """Return the pairs: where those of each node begin, (N + 1,), and their second nodes, ascending."""
    structure = (first_of_node, by_node, entry_point, entry_node, first_entry)
    first = np.zeros(len(first_of_node), np.int64)
    _meet(*structure, first, np.empty(0, np.int64))
    seconds = np.empty(int(first[-1]), np.int64)
    _meet(*structure, first.copy(), seconds)
    num_nodes = len(first) - 1
    firsts = np.repeat(np.arange(num_nodes), np.diff(first))
    return first, np.sort(firsts * num_nodes + seconds) - firsts * num_nodes


@kernel
def _meet(
    first_of_node: Any,
    by_node: Any,
    entry_point: Any,
    entry_node: Any,
    first_entry: Any,
    first: Any,
    out: Any,
) -> None:
    """Count the later nodes that each node meets into first[i + 1], or, if `out` has room, list them."""
    n = len(first_of_node) - 1
    mark = np.full(n, -1, np.int64)
    found = np.empty(n, np.int64)
    total = 0
    for i in range(n):
        count = 0
        for q in range(first_of_node[i], first_of_node[i + 1]):
            e = by_node[q]
            for other in range(e + 1, first_entry[entry_point[e] + 1]):
                j = entry_node[other]
                if mark[j] != i:
                    mark[j] = i
                    found[count] = j
                    count += 1
        if len(out) > 0:
            for q in range(count):
                out[total + q] = found[q]
        total += count
        first[i + 1] = total
