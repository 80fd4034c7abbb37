"""Pairs of images whose matches tell most of a model, where there is time for few: a dozen an image.

    neighbors   the nearest in pose, which tie every camera to the rest
    shared      those that see most points of the model together
    unshared    near in pose, but without common points: near duplicates must see the same
    alike       pictures that look alike, wherever their cameras stand: a fold has put them apart
    seams       nearest across the weakest links of the model: the longest edges of the shortest tree between
                the cameras, by common points, else by poses; the most alike across these are "alike"
    others      all the rest, of up to 25 pictures: where sides are alike, likeness finds what contradicts
                and leaves out what agrees

Poses are compared by positions over the usual distance of neighbors, and by viewing directions over their
usual angle. Pictures are compared by their descriptors, added up as differences from the nearest of some that
are drawn (VLAD: Jegou et al., "Aggregating local descriptors into a compact image representation", CVPR
2010). All sums are of integers, so that the choice does not depend on the order of additions.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, distinct_pairs
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.scene.images import Images

NUM_DESCRIBED = 400
"""Descriptors of a picture that describe it; a tenth of those it has, so that comparing costs little."""
NEAR_A_STEP = 3
"""Images near in position for each image next in a sequence: thirty reach the next strip of a flight whose
images along one overlap by 90 % and across by 60 %."""
_NEIGHBORS, _SHARED, _UNSHARED, _ALIKE = 6, 3, 3, 4  # pairs of an image by reason; 16 fit into 5 min of 100
_FEW_IMAGES = 25  # images all of whose pairs are asked: a dozen each
_NEAR, _LOOKED_AT = 12, 20  # images near in pose, and alike ones, that are looked at; more are never chosen
_ACROSS = 5  # pairs across a seam, of each kind; three must agree on a turn
_IMAGES_A_SEAM = 10  # images for each seam that is asked; a tenth of all in a part of its own is too many
_NEAREST = 3  # neighbors of an image that say whether a model is sound where sides are alike; more see those
_FEWEST_SHARED = 15  # points; images with fewer share none, as COLMAP's least matches of a pair have it
_WORDS = 32  # descriptors that pictures are compared by; more tell hardly more of a hundred pictures
_STEPS, _MOST_STEPS = 512.0, 31.0  # a signature's numbers in steps of 1 / 512; products of those sum exactly
_ROWS = 1000  # images that are compared with all at once; of 10,000 that takes 40 MB
_SEED = 0  # seed of the words; any will do, if it is always the same


class ChosenPairs(NamedTuple):
    """Pairs to be asked, the most telling first."""

    pairs: IntArray
    """(k, 2) rows of images, i < j."""
    reasons: tuple[str, ...]
    """(k) why each pair is asked, the first reason of the list above."""
    is_near: BoolArray
    """(k,) whether it is one of the three nearest in pose of an image, or nearest across a seam."""


class Shared(NamedTuple):
    """How many points pairs of images see together."""

    pairs: IntArray
    """(m, 2) rows of images, i < j."""
    counts: IntArray
    """(m,)"""


def choose_pairs(images: Images, shared: Shared, descriptors: Sequence[IntArray]) -> ChosenPairs:
    """Choose pairs of posed images, of those that have descriptors.

    Args:
        images: all of them posed.
        shared: common points of the model; none if it has none.
        descriptors: (k, 128) of each image, 0 to 255; none of an image that is not to be asked.
    """
    asked = np.flatnonzero([len(some) > 0 for some in descriptors])
    place = np.full(images.num_images, -1)
    place[asked] = np.arange(len(asked))
    inside = (place[shared.pairs] >= 0).all(axis=1) & (shared.counts >= _FEWEST_SHARED)
    known = Shared(place[shared.pairs[inside]], shared.counts[inside])
    near = _nearest(images.centers[asked], images.rotations[asked, 2])
    alike = _most_alike(_signatures([descriptors[k] for k in asked.tolist()]))
    lists = list(_lists(near, known, alike))
    pairs = np.sort(np.concatenate([own for _, own, _ in lists]), axis=1)
    reasons = np.repeat([reason for reason, _, _ in lists], [len(own) for _, own, _ in lists])
    ranks = np.concatenate([rank for *_, rank in lists])
    order = np.argsort(ranks, kind="stable")
    codes = pairs[:, 0] * len(asked) + pairs[:, 1]
    order = order[np.sort(np.unique(codes[order], return_index=True)[1])]
    is_near = np.isin(codes, codes[(reasons == "seams") | ((reasons == "neighbors") & (ranks < _NEAREST))])
    return ChosenPairs(asked[pairs[order]], tuple(reasons[order].tolist()), is_near[order])


def alike_pairs(descriptors: Sequence[IntArray], most: int) -> IntArray:
    """Return the pairs (k, 2), i < j, of each picture and those `most` that look most like it.

    Args:
        descriptors: (k, 128) of each picture, 0 to 255; a picture without any is in no pair.
        most: pairs of a picture that it has itself; others may have it too.
    """
    asked = np.flatnonzero([len(some) > 0 for some in descriptors])
    if len(asked) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    pairs = _most_alike(_signatures([descriptors[k] for k in asked.tolist()]), most).pairs()
    return asked[distinct_pairs(np.sort(pairs, axis=1))]


def nearest_pairs(positions: FloatArray, most: int) -> IntArray:
    """Return the pairs (k, 2), i < j, of each position (n, 3) and the `most` nearest to it.

    Heights have no part, since those of GPS are off by tens of meters.
    """
    from scipy.spatial import KDTree

    places = positions[:, :2]
    near = np.asarray(KDTree(places).query(places, np.arange(1, min(most + 1, len(places)) + 1))[1])
    pairs = np.column_stack([np.repeat(np.arange(len(near)), near.shape[1]), near.ravel()])
    return distinct_pairs(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1))


class _Ranked(NamedTuple):
    """The others that come first by some cost, for each of n images."""

    others: IntArray
    """(n, k)"""
    costs: FloatArray
    """(n, k) ascending."""

    def pairs(self) -> IntArray:
        """Return all pairs (n k, 2), an image's own first."""
        rows = np.repeat(np.arange(len(self.others)), self.others.shape[1])
        return np.column_stack([rows, self.others.ravel()])


def _lists(near: _Ranked, shared: Shared, alike: _Ranked) -> Iterator[tuple[str, IntArray, IntArray]]:
    """Yield a reason, pairs (k, 2), and how late each is asked (k,)."""
    count = len(near.others)
    most = np.concatenate([shared.pairs, shared.pairs[:, ::-1]])
    most = most[np.lexsort((most[:, 1], -np.tile(shared.counts, 2), most[:, 0]))]
    common = set(map(tuple, most.tolist()))
    apart = np.array([pair not in common for pair in map(tuple, near.pairs().tolist())], dtype=np.bool_)
    yield from _across_seams(near, shared, alike)
    yield "neighbors", *_first(near.pairs(), _NEIGHBORS, count)
    yield "shared", *_first(most, _SHARED, count)
    yield "unshared", *_first(near.pairs()[apart], _UNSHARED, count)
    yield "alike", *_first(alike.pairs(), _ALIKE, count)
    if count <= _FEW_IMAGES:
        every = np.column_stack(np.triu_indices(count, 1))
        yield "others", every, np.full(len(every), count)


def _first(pairs: IntArray, most: int, count: int) -> tuple[IntArray, IntArray]:
    """Return the first pairs of each image, which stand together, and which of its own each is."""
    begins = np.searchsorted(pairs[:, 0], np.arange(count))
    rank = np.arange(len(pairs)) - begins[pairs[:, 0]]
    return pairs[rank < most], rank[rank < most]


def _across_seams(near: _Ranked, shared: Shared, alike: _Ranked) -> Iterator[tuple[str, IntArray, IntArray]]:
    """Yield a reason, pairs across a long edge of the shortest tree, and how late each is asked."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import minimum_spanning_tree

    count, (among, costs) = len(near.others), (near.pairs(), near.costs.ravel())
    ends = np.concatenate([shared.pairs, among])
    lengths = np.concatenate([1.0 / shared.counts, 1.0 + costs])  # points are nearer than poses
    ends, first = np.unique(np.sort(ends, axis=1), axis=0, return_index=True)
    tree = minimum_spanning_tree(coo_array((lengths[first], ends.T), shape=(count, count)).tocsr()).tocoo()
    i, j, length = tree.row, tree.col, tree.data
    for edge in np.argsort(-length, kind="stable")[: -(-count // _IMAGES_A_SEAM)].tolist():
        left = np.arange(len(length)) != edge
        sides = connected_components(count, np.column_stack([i, j])[left].astype(np.int64))
        side = sides == sides[i[edge]]
        for reason, ranked in (("seams", near), ("alike", alike)):
            pairs, cost = ranked.pairs(), ranked.costs.ravel()
            across = np.flatnonzero(side[pairs[:, 0]] != side[pairs[:, 1]])
            taken = across[np.argsort(cost[across], kind="stable")][:_ACROSS]
            yield reason, pairs[taken], np.arange(len(taken))


def _nearest(centers: FloatArray, axes: FloatArray) -> _Ranked:
    """Return the images nearest in pose, by centers and viewing directions (n, 3)."""
    from scipy.spatial import KDTree

    count = min(_NEAR, len(centers) - 1)
    distances, others = map(np.asarray, KDTree(centers).query(centers, count + 1))
    usual = float(np.median(distances[:, 1:])) or 1.0
    turns = np.linalg.norm(axes[others[:, 1:]] - axes[:, None], axis=2)  # chords of angles
    places = np.hstack([centers / usual, axes / (float(np.median(turns)) or 1.0)])
    costs, others = map(np.asarray, KDTree(places).query(places, count + 1))
    own = others == np.arange(len(others))[:, None]  # one of two at the same place may come second
    own[~own.any(axis=1), -1] = True
    return _Ranked(others[~own].reshape(-1, count), costs[~own].reshape(-1, count))


def _signatures(descriptors: Sequence[IntArray]) -> IntArray:
    """Return a signature (n, s) of each picture, of whole numbers."""
    every = np.concatenate(descriptors)
    words = every[np.sort(np.random.default_rng(_SEED).permutation(len(every))[:_WORDS])]
    signatures = []
    for some in descriptors:
        nearest = np.argmin(np.sum(words**2, axis=1) - 2 * (some @ words.T), axis=1)
        sums = np.zeros(words.shape)
        np.add.at(sums, nearest, (some - words[nearest]).astype(np.float64))
        unit = normalized((np.sign(sums) * np.sqrt(np.abs(sums))).reshape(1, -1))[0]
        signatures.append(np.clip(np.rint(_STEPS * np.nan_to_num(unit)), -_MOST_STEPS, _MOST_STEPS))
    return np.array(signatures, dtype=np.int8).astype(np.int64)


def _most_alike(signatures: IntArray, most: int = _LOOKED_AT) -> _Ranked:
    """Return the images whose pictures are most alike; costs are negative likeness."""
    every = signatures.astype(np.float32)  # products of whole numbers below 2^24, so that sums are exact
    count = min(most, len(every) - 1)
    others, costs = [], []
    for begin in range(0, len(every), _ROWS):
        likeness = every[begin : begin + _ROWS] @ every.T
        rows = np.arange(len(likeness))
        likeness[rows, begin + rows] = -np.inf
        first = np.argsort(-likeness, axis=1, kind="stable")[:, :count]
        others.append(first)
        costs.append(-np.take_along_axis(likeness, first, axis=1))
    return _Ranked(np.concatenate(others), np.concatenate(costs).astype(np.float64))
