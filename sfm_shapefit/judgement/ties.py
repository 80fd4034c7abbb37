"""Ties: what crosses between two groups of cameras and fits, and whether it checks how they stand.

Groups that are each sound stand to one another by a similarity of seven unknowns, so that whatever little
crosses between them determines it, and fits: it is no evidence. Cameras are a group if points that two of
them share, and three images see, make them one rigid piece: more points than chance makes, and twice as many
as miss. Two groups are one if more crosses than seven unknowns explain,

    points   so many again, also without those of any one camera of either side
    pairs    that agree, three of them, and two without any one camera, half of those that contradict or more

since a single camera that stands in two groups tells nothing of the scale of the one in the other. A point
counts for nothing if only pairs carry it across most of whose matches there miss (`pipeline.evidence`).

A group that remains by itself is held by few pairs and points, or by none: pairs that an adjustment believed
may be rejected since. A pair that agrees says five things (its rotation, its direction), a point at least
two, where more than chance fit. A group with seven of these or more is unchecked; with fewer, or if one
camera has them all, it is loose: nothing says how it stands.

Cameras hang on the rest if a single pair, or a single camera, holds them: they are outside the largest rigid
piece that pairs and shared points make. What such a pair says nothing checks, be it of another scene.
`scripts/results/verdict.md` has halves of scenes that few pairs tie.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Annotated, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import (
    BoolArray,
    Int32Array,
    IntArray,
    distinct,
    distinct_pairs,
    rows_taken,
    sum_by,
)
from sfm_shapefit.base.executors import in_threads
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.base.wording import are, counted
from sfm_shapefit.graph.rigidity import parallel_rigid_pieces
from sfm_shapefit.judgement.few_ties import are_bridges
from sfm_shapefit.judgement.limits import FEWEST_ALIKE, FEWEST_POINTS, OUTNUMBERED
from sfm_shapefit.judgement.seams import CameraGroup

_MOST_RAYS = 200  # rays per node that are asked first; what these leave apart is asked by all
_LINKS_A_BLOCK = 500_000  # links that are counted at a time: 50 MB
_UNKNOWNS = 7  # numbers; turn, shift and scale: fewer facts leave some of them open
_PAIR_SAYS, _POINT_SAYS = 5, 2  # numbers; see the header


ImagesOf = Callable[[BoolArray], tuple[str, ...]]  # the names of the images of some nodes (n,)


class UntiedGroup(CameraGroup):
    """A group of cameras that so little ties to the rest that nothing checks how it stands to it."""

    num_points: Annotated[int, "Points of three images or more that both see, and that fit."]
    is_loose: Annotated[bool, "Whether these do not even say how it stands to the rest."]

    @property
    def statement(self) -> str:
        """The same in a sentence."""
        does = "says" if self.is_loose else "checks"
        agree = f"{counted(self.num_agreeing, 'pair')} and {counted(self.num_points, 'point')}"
        against = f"{counted(self.num_contradicting, 'pair')} contradict or are rejected"
        return (
            f"nothing {does} where {are(self.images)} relative to the rest: {agree} between them agree, "
            f"{against}; match more images across"
        )


class _Rule(NamedTuple):
    """Links that fit, those of these without any one camera, and how many may miss for each; see above."""

    least: int
    spare: int
    most_missing: float

    def tie(self, fitting: IntArray | int, missing: IntArray | int) -> BoolArray:
        """Return where enough fit, and few miss."""
        return np.asarray((fitting >= self.least) & (missing <= self.most_missing * fitting))


_BY_POINTS = _Rule(FEWEST_POINTS, FEWEST_POINTS, 1.0 / OUTNUMBERED)
_BY_PAIRS = _Rule(FEWEST_ALIKE, FEWEST_ALIKE - 1, OUTNUMBERED)


class NodeLinks(NamedTuple):
    """What links two nodes, which are cameras, or frames: points, or pairs of images."""

    ids: IntArray
    """(k,) which point or pair it is; a point links each two nodes that see it."""
    ends: IntArray
    """(k, 2) its two nodes."""
    fits: BoolArray
    """(k,) whether it agrees with where these stand."""

    @property
    def number(self) -> int:
        """How many points or pairs they are."""
        return len(distinct(self.ids))


class Rays(NamedTuple):
    """Which nodes see which points."""

    points: IntArray | Int32Array
    """(r,) ascending."""
    nodes: IntArray | Int32Array
    """(r,)"""
    fits: BoolArray
    """(r,) whether the observation fits."""

    def starts(self) -> IntArray:
        """Return the first ray of each point."""
        return np.flatnonzero(np.append(True, self.points[1:] != self.points[:-1])[: len(self.points)])

    def links(self) -> NodeLinks:
        """Return a link for each two rays of a point."""
        ids = [np.zeros(0, dtype=np.int64)]
        ends, fits = [np.zeros((0, 2), dtype=np.int64)], [self.fits[:0]]
        for step in range(1, int(np.diff(self.starts(), append=len(self.points)).max(initial=1))):
            there = np.flatnonzero(self.points[step:] == self.points[:-step])
            ids.append(self.points[there].astype(np.int64))
            ends.append(np.column_stack([self.nodes[there], self.nodes[there + step]]).astype(np.int64))
            fits.append(self.fits[there] & self.fits[there + step])
        return NodeLinks(np.concatenate(ids), np.concatenate(ends), np.concatenate(fits))

    def blocks(self) -> list["Rays"]:
        """Return the rays of some points each, which make half a million links, or those of one point."""
        rays = np.bincount(self.points)
        block = (np.cumsum(rays * (rays - 1) // 2) // _LINKS_A_BLOCK)[self.points]
        ends = [0, *(np.flatnonzero(np.diff(block)) + 1).tolist(), len(block)]
        rows = (slice(*both) for both in pairwise(ends))
        return [Rays(self.points[own], self.nodes[own], self.fits[own]) for own in rows]

    def of_three(self) -> "Rays":
        """Return the rays of points that three nodes see; none of a point fits unless three do."""
        lengths = np.diff(self.starts(), append=len(self.points))
        rays, lengths = rows_taken(self, np.repeat(lengths > 2, lengths)), lengths[lengths > 2]
        fitting = np.add.reduceat(rays.fits, rays.starts(), dtype=np.int64)
        return rays._replace(fits=rays.fits & np.repeat(fitting > 2, lengths))


def links_of_pairs(agreeing: IntArray, contradicting: IntArray) -> NodeLinks:
    """Return the links by pairs (., 2) of nodes that agree, and that contradict."""
    ends = np.concatenate([agreeing, contradicting])
    return NodeLinks(np.arange(len(ends)), ends, np.arange(len(ends)) < len(agreeing))


def find_groups(
    group: IntArray, rays: Rays, pairs: NodeLinks, images_of: ImagesOf
) -> tuple[IntArray, tuple[UntiedGroup, ...]]:
    """Return the group of each node, (n,), and those that are not tied to the largest.

    What is unchecked is one group with the largest all the same. `group` (n,) is as of `rigid_groups`, rays
    are those of three.
    """
    groups, starts = group.astype(np.int32)[rays.nodes], rays.starts()
    several = np.minimum.reduceat(groups, starts) != np.maximum.reduceat(groups, starts)
    crossing = np.repeat(several, np.diff(starts, append=len(groups)))
    points, is_done = rows_taken(rays, crossing).links(), False
    while not is_done:
        united = _unite(_unite(group, points, _BY_POINTS), pairs, _BY_PAIRS)
        is_done, group = len(distinct(united)) == len(distinct(group)), united
    sizes = np.bincount(group)
    names = np.argsort(-sizes, kind="stable")[: np.sum(sizes > 1)].tolist()
    untied = tuple(_describe(group == name, points, pairs, images_of) for name in names[1:])
    unchecked = [name for name, one in zip(names[1:], untied, strict=True) if not one.is_loose]
    return np.where(np.isin(group, unchecked), names[0] if names else 0, group), untied


def find_hanging(
    count: int, rays: Rays, pairs: NodeLinks, known: IntArray, images_of: ImagesOf
) -> tuple[UntiedGroup, ...]:
    """Return the groups of nodes, of one or more of all n, that a single pair or node holds.

    Nodes (k, 2) are `known` to stand rightly to one another; those that no pair holds are not asked. Rays are
    those of three.
    """
    edges = _distinct_edges(np.concatenate([pairs.ends[pairs.fits], known]))
    if not (outside := _outside(count, edges)).any():
        return ()
    near = np.bincount(rays.points, outside[rays.nodes]) > 0
    rays = rows_taken(rays, near[rays.points])
    names, *numbers = _count_shared(count, rays, 1)
    shared = np.column_stack(np.divmod(names[_BY_POINTS.tie(*numbers)], count))
    edges = _distinct_edges(np.concatenate([edges, shared]))
    outside, points = _outside(count, edges), rays.links()
    among = connected_components(count, edges[outside[edges].all(axis=1)])
    groups = (outside & (among == name) for name in distinct(among[outside]).tolist())
    return tuple(replace(_describe(group, points, pairs, images_of), is_loose=False) for group in groups)


def _distinct_edges(edges: IntArray) -> IntArray:
    """Return each edge (m, 2) of two nodes once."""
    return distinct_pairs(np.sort(edges[edges[:, 0] != edges[:, 1]], axis=1))


def _outside(count: int, edges: IntArray) -> BoolArray:
    """Return the nodes (n,) of edges (m, 2) that are not in the largest rigid piece, if most are in it.

    Else they are outside if bridges part them from most: a ring of neighbors is not rigid, and no tree.
    """
    asked = np.bincount(edges.ravel(), minlength=count) > 0
    if not asked.any():
        return asked
    inside = np.isin(np.arange(count), edges[parallel_rigid_pieces(count, edges, 3) == 0])
    if 2 * inside.sum() < asked.sum():
        label = connected_components(count, edges[~are_bridges(count, edges)])
        inside = label == np.argmax(np.bincount(label))
    return np.asarray(asked & ~inside & (2 * inside.sum() >= asked.sum()))


def rigid_groups(count: int, rays: Rays, known: IntArray, threads: int = 1) -> IntArray:
    """Return the group of each node (n,) by the points that two of them share, a share of all points.

    Rays are those of three. Nodes (k, 2) are `known` to stand rightly to one another.
    """
    group = np.arange(count)
    step = len(rays.points) // (_MOST_RAYS * count) + 1
    some = rows_taken(rays, rays.points % step == 0)
    names, fitting, missing = _count_shared(count, some, threads)
    names = names[_BY_POINTS.tie(fitting, missing)]
    strong = np.concatenate([np.column_stack(np.divmod(names, count)), known])
    strong = distinct_pairs(np.sort(strong, axis=1))
    if len(strong):
        piece = parallel_rigid_pieces(count, strong, 3)
        order = np.argsort(-piece, kind="stable")  # a node of several pieces is in the largest
        order = order[(np.bincount(piece) > 1)[piece[order]]]  # two nodes are no piece
        group += len(strong)
        group[strong[order].ravel()] = np.repeat(piece[order], 2)
    return np.unique(group, return_inverse=True)[1]


def _unite(group: IntArray, links: NodeLinks, rule: _Rule) -> IntArray:
    """Return the groups (n,) after each has united with the larger one that most links tie it to, if any.

    A node by itself unites with a single group: it may stand in two that nothing else ties.
    """
    pairs, numbers = _tied(group, links, rule)
    sizes = np.bincount(group, minlength=len(group))
    order = np.lexsort((pairs, sizes[pairs]), axis=1)
    pairs = np.take_along_axis(pairs, order, axis=1)
    rows = np.flatnonzero(sizes[pairs[:, 1]] > 1)
    rows = rows[np.argsort(-numbers[rows], kind="stable")]
    rows = rows[np.unique(pairs[rows, 0], return_index=True)[1]]
    return connected_components(len(group), pairs[rows])[group]


def _describe(inside: BoolArray, points: NodeLinks, pairs: NodeLinks, images_of: ImagesOf) -> UntiedGroup:
    """Return a group, the nodes inside, with what crosses between it and the rest."""
    ends, facts = [np.zeros((0, 2), dtype=np.int64)], 0
    numbers: list[int] = []
    for links, says, rule in ((pairs, _PAIR_SAYS, _BY_PAIRS), (points, _POINT_SAYS, _BY_POINTS)):
        across = rows_taken(links, inside[links.ends].sum(axis=1) == 1)
        fitting, missing = rows_taken(across, across.fits), rows_taken(across, ~across.fits)
        numbers += [fitting.number, missing.number]
        if rule._replace(least=0).tie(fitting.number, missing.number):
            ends.append(fitting.ends)
            facts += says * fitting.number
    every = np.concatenate(ends)
    of_one = any((every == node).any(axis=1).all() for node in distinct(every).tolist())
    agreeing, contradicting, shared, _ = numbers
    return UntiedGroup(
        images=images_of(inside),
        num_agreeing=agreeing,
        num_contradicting=contradicting,
        num_points=shared,
        is_loose=facts < _UNKNOWNS or of_one,
    )


def _tied(group: IntArray, links: NodeLinks, rule: _Rule) -> tuple[IntArray, IntArray]:
    """Return the pairs (p, 2) that links tie of the groups of nodes (n,), and how many fit (p,)."""
    names, fitting, missing = _count(group, links)
    enough = rule.tie(fitting, missing)
    both, sizes = np.column_stack(np.divmod(names, len(group))), np.bincount(group, minlength=len(group))
    across = rows_taken(links, links.fits & (group[links.ends[:, 0]] != group[links.ends[:, 1]]))
    ends = np.take_along_axis(across.ends, np.argsort(group[across.ends], axis=1), axis=1)
    for side in range(2):
        if (several := sizes[both[:, side]] > 1).any():
            pair = np.searchsorted(names, group[ends] @ np.array([len(group), 1]))
            span = int(across.ids.max(initial=0)) + 1
            seen = distinct((pair * len(group) + ends[:, side]) * span + across.ids) // span
            nodes, counts = np.unique(seen, return_counts=True)
            total, most = np.zeros((2, len(names)))
            np.add.at(total, nodes // len(group), counts)
            np.maximum.at(most, nodes // len(group), counts)
            enough &= ~several | (total - most >= rule.spare)
    return both[enough], fitting[enough]


def _count(group: IntArray, links: NodeLinks) -> tuple[IntArray, IntArray, IntArray]:
    """Return the pairs (p,) of groups that links cross, ascending, and how many fit and miss of each, (p,).

    A pair of groups is one number. A point misses where one of its links does.
    """
    first, second = group[links.ends[:, 0]], group[links.ends[:, 1]]
    pair = np.minimum(first, second) * len(group) + np.maximum(first, second)
    span = int(links.ids.max(initial=0)) + 1
    keys = distinct(((pair * span + links.ids) * 2 + links.fits)[first != second])
    keys = keys[np.append(True, keys[1:] >> 1 != keys[:-1] >> 1)[: len(keys)]]
    pair = keys // (2 * span)
    ends = np.append(np.flatnonzero(pair[1:] != pair[:-1]) + 1, len(pair))[: len(pair)]
    fitting = np.diff(np.append(0, np.cumsum(keys & 1)[ends - 1]))
    return pair[ends - 1], fitting, np.diff(np.append(0, ends)) - fitting


def _count_shared(count: int, rays: Rays, threads: int) -> tuple[IntArray, IntArray, IntArray]:
    """Return the same of each two of all nodes by the points that they share; threads share the points."""
    nodes, empty = np.arange(count), (np.zeros(0, dtype=np.int64),) * 3
    blocks = in_threads(threads, lambda block: _count(nodes, block.links()), rays.blocks())
    pairs, fitting, missing = map(np.concatenate, zip(empty, *blocks, strict=True))
    names, row = np.unique(pairs, return_inverse=True)
    counts = sum_by(row, np.stack([fitting, missing], axis=1), len(names)).astype(np.int64)
    return names, counts[:, 0], counts[:, 1]
