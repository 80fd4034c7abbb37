"""Matches of image pairs: the file that has them, and what they are for images with rotations.

A match of images i and j is a pair of keypoints that see the same point. With known rotations, all that
matters of a keypoint is the unit ray of its pixel in world axes. So there are two nouns:

    Matches    the file, opened once: which pairs there are, and integers; nothing of any pose
    View       the same as some images see them: rays, which die with the images they were made for
"""

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, TypeVar
from weakref import WeakSet

import numpy as np

from sfm_shapefit.base.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    UInt32Array,
    distinct,
    hand_back_memory,
)
from sfm_shapefit.base.executors import Advance, Answer, nobody, overlapped
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.base.lists import Lists, RowLists, offsets_of
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Lens

PairNames = frozenset[tuple[str, str]]
"""Pairs of images by their names, the smaller name first."""

_OBSERVATIONS_A_RUN = 50_000  # observations seen through one lens; the arrays of so many take 4 MB
KEPT_MATCHES = 1_000_000  # matches that are kept with their rays; they take 80 MB
# Matches of a database; of more, none is kept while points are made of them. To read 30 million again takes a
# twentieth of the time of a run, and to keep them an eighth of its memory.
MOST_BESIDE_TRACKS = 16_000_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RayMatches(Lists):
    """The matches of k image pairs, M in all, one pair after the other, as rays in world axes."""

    pairs: IntArray
    """(k, 2) images (i, j)."""
    offsets: IntArray
    """(k + 1,) the matches of pair p are rows offsets[p] to offsets[p + 1]."""
    rays_i: FloatArray
    """(M, 3) unit rays of image i."""
    rays_j: FloatArray
    """(M, 3) unit rays of image j."""
    pixel_angles: FloatArray
    """(k,) angle of one pixel in radians, 1 / the smaller focal length in px."""

    def rays_of(self, chosen: IntArray) -> "RayMatches":
        """Return the rays of some of the pairs, in that order."""
        pairs, pixel_angles = self.pairs[chosen], self.pixel_angles[chosen]
        return replace(self._taken(self.rows_of(chosen)), pairs=pairs, pixel_angles=pixel_angles)

    def thinned(self, most: int) -> "RayMatches":
        """Return the pairs with at most so many matches each, taken evenly."""
        counts = self.lengths()
        taken = np.minimum(counts, most)
        places = RowLists(offsets_of(taken), np.zeros(0, dtype=np.int64))
        steps = places.ranks() * places.spread(counts) // places.spread(taken)
        return self._taken(replace(places, rows=places.spread(self.offsets[:-1]) + steps))

    def _taken(self, kept: RowLists) -> "RayMatches":
        return RayMatches(
            pairs=self.pairs,
            offsets=kept.offsets,
            rays_i=self.rays_i[kept.rows],
            rays_j=self.rays_j[kept.rows],
            pixel_angles=self.pixel_angles,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeypointMatches(Lists):
    """The matches of k image pairs, M in all, one pair after the other, as keypoints; no rays."""

    pairs: IntArray
    """(k, 2) images (i, j), i < j."""
    offsets: IntArray
    """(k + 1,) the matches of pair p are rows offsets[p] to offsets[p + 1]."""
    keypoints: IntArray
    """(M, 2) index of the keypoint in image i and in image j."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchBatch(RayMatches):
    """Matches that know their keypoints; i < j."""

    keypoints: IntArray
    """(M, 2) index of the keypoint in image i and in image j."""


class Reading(NamedTuple):
    """How much memory may be taken, so that nothing is read or computed twice."""

    batch: int = 250_000
    """Matches that are put together at a time, beyond which only a single pair goes: 60 MB. The arrays of
    larger batches come from the system and go back to it each time, and its zeros cost as much as what is
    written over them."""
    rays_bytes: int = 1_000_000_000
    """Bytes of the rays of keypoints that are kept for the next pair."""
    keeps: bool = True
    """Whether matches that were read are kept."""


PLENTY = Reading()
"""Where memory is no concern."""


AnyMatches = TypeVar("AnyMatches", KeypointMatches, MatchBatch)


class Matches(ABC):
    """The matches between some images of an open file, whatever their poses."""

    names: tuple[str, ...]
    """Names of the images, ascending."""
    missing_names: tuple[str, ...] = ()
    """Names that the file does not have."""
    pairs: IntArray
    """(p, 2) images (i, j), i < j, that have matches; ascending."""
    num_matches: IntArray
    """(p,) how many they have, at most."""
    num_keypoints: IntArray
    """Number of keypoints of each image; 0 where the file does not have it."""
    total_keypoints: int
    """Number of keypoints of all images of the file."""
    notes: Sequence[str] = ()
    """What of the file was read otherwise than it stands there, a sentence each."""

    lacking: str = ""
    """What was left aside of the input where no images share matches; empty if nothing was."""

    def __init__(self) -> None:
        self._views: WeakSet[View] = WeakSet()

    def at(self, images: Images, left_out: PairNames = frozenset(), reading: Reading = PLENTY) -> "View":
        """Return the matches as other images see them, which is cheap.

        Args:
            images: some of these, by name, and maybe others, in the order of their names.
            left_out: pairs that are taken for unmatched.
            reading: how much memory may be taken; where nothing is kept, what earlier views keep goes, too.
        """
        if not reading.keeps:
            self.forget()
            for earlier in self._views:
                earlier.forget()
        view = View(self, images, left_out, reading)
        self._views.add(view)
        return view

    @abstractmethod
    def keypoints(self, name: str) -> FloatArray:
        """Return the pixels (k, 2) of the keypoints of an image; k = 0 if there are none.

        Raises:
            InputError: if they are damaged, or a coordinate is not finite.
        """

    @abstractmethod
    def rays(self, lens: Lens, pixels: FloatArray) -> FloatArray:
        """Return the unit rays (k, 3) of pixels (k, 2) in camera axes; NaN for those without."""

    @abstractmethod
    def read(self, pairs: IntArray, *, keep: bool) -> tuple[IntArray, UInt32Array]:
        """Return the matches of pairs (k,), ascending: how many each has, and the keypoints (M, 2) of all.

        The matches of a pair ascend, and each stands once. With `keep` they are not read again.

        Raises:
            InputError: naming the pair whose matches are damaged or refer to keypoints that do not exist.
        """

    def forget(self) -> None:  # noqa: B027  that is all where none is kept
        """Give back the memory of all matches that were read; they are read again where they are needed."""

    def parts(self, view: "View", ranges: Sequence[slice]) -> "Sequence[MatchPart]":  # noqa: ARG002
        """Return ranges of a view's pairs for other processes; nothing where only this one has the file."""
        return ()

    def close(self) -> None:  # noqa: B027  that is all where no file is open
        """Close the file; nothing is read after that."""


class MatchPart(Protocol):
    """Some pairs of a view, to be pickled, and opened by another process."""

    @property
    def num_pairs(self) -> int:
        """Number of pairs."""

    def open(self, images: Images) -> AbstractContextManager["View"]:
        """Open the file again, for a view of the same images and of these pairs, which are read once."""


class View:
    """Matches between some images, whose indices all that is returned refers to; made by `Matches.at`.

    A pass yields the pairs (i, j), i < j, in their order, and of each those matches whose pixels have rays.
    """

    _rays: FloatArray
    _num_rays: int
    _begins: IntArray

    def __init__(self, matches: Matches, images: Images, left_out: PairNames, reading: Reading) -> None:
        self.matches, self.images, self.reading = matches, images, reading
        index = {name: k for k, name in enumerate(images.names)}
        index_of = np.array([index.get(name, -1) for name in matches.names], dtype=np.int64)
        assert (np.diff(index_of[index_of >= 0]) > 0).all(), "images must stand in the order of their names"
        ends = index_of[matches.pairs]
        kept = (ends >= 0).all(axis=1) & ~is_among(ends, indices_of_pairs(index, left_out))
        self.rows, self.pairs = np.flatnonzero(kept), ends[kept]
        """(k,) the pairs by their place in the file, and (k, 2) by the images."""
        self._counts = matches.num_matches[self.rows]
        self.num_pairs, self.num_matches = len(self.rows), int(self._counts.sum())
        count_of = dict(zip(matches.names, matches.num_keypoints.tolist(), strict=True))
        self.num_keypoints = np.array([count_of.get(name, 0) for name in images.names], dtype=np.int64)
        """(n,) keypoints of each image."""
        self._rotations, self._focal_lengths_px = images.rotations, images.focal_lengths_px
        self._forget_rays()
        self._kept: dict[int, list[MatchBatch]] = {}
        self._blind: dict[int, BoolArray | None] = {}

    def keypoints(self, image: int) -> FloatArray:
        """Return the pixels (k, 2) of the keypoints of an image; errors as of `Matches.keypoints`."""
        return self.matches.keypoints(self.images.names[image])

    def batches(
        self,
        min_matches: int = 1,
        without: IntArray | None = None,
        advance: Advance = nobody,
    ) -> Iterator[MatchBatch]:
        """Yield the matches with rays in world axes, in batches; few matches are kept with these.

        Args:
            min_matches: pairs with fewer are left out.
            without: (m, 2) pairs that are left out, too, whatever the order of their images.
            advance: hears of the pairs that are done, while batches are consumed, and of their number.

        Raises:
            InputError: as `Matches.read`.
        """
        if min_matches in self._kept and without is None:
            return self._tell(iter(self._kept[min_matches]), advance)
        wanted = self._counts >= min_matches
        if without is not None:
            wanted &= ~is_among(self.pairs, without)
        found = self._batches(np.flatnonzero(wanted), min_matches)
        if self.reading.keeps and self.num_matches <= KEPT_MATCHES and without is None:
            found = iter(self._kept.setdefault(min_matches, list(found)))
        return self._tell(found, advance)

    def measured(
        self, batches: Iterator[MatchBatch], measure: Callable[[MatchBatch], Answer], threads: int
    ) -> Iterator[Answer]:
        """Yield what is measured of batches, see `overlapped`; where memory is short, of one at a time."""
        return overlapped(threads if self.reading.keeps else 1, measure, batches)

    def links(
        self,
        min_matches: int = 1,
        chosen: BoolArray | None = None,
        advance: Advance = nobody,
        *,
        consume: bool = False,
    ) -> Iterator[KeypointMatches]:
        """Yield the matches without their rays, which takes a fraction of the time.

        Args:
            min_matches: as in `batches`.
            chosen: (k,) which of the pairs; None: all.
            advance: as in `batches`.
            consume: give back the memory of rays, at once and in the end, and then that of very many matches:
                to make tracks of them takes more memory than anything else.

        Raises:
            InputError: as `Matches.read`.
        """
        wanted = self._counts >= min_matches
        if chosen is not None:
            wanted &= chosen
        found = self._tell(self._links(np.flatnonzero(wanted), min_matches), advance)
        if not consume:
            return found
        self._forget_rays()
        hand_back_memory()
        return self._consumed(found)

    def _consumed(self, links: Iterator[KeypointMatches]) -> Iterator[KeypointMatches]:
        yield from links
        self.give_back()  # rays too, by which those without one are told

    def of_pairs(self, wanted: IntArray) -> Iterator[MatchBatch]:
        """Yield the matches of wanted pairs (m, 2), whatever the order of their images."""
        return self._batches(np.flatnonzero(is_among(self.pairs, wanted)), 1)

    def between(self, labels: IntArray) -> Iterator[MatchBatch]:
        """Yield the matches of pairs whose images have different labels (n,), none of them negative."""
        ends = labels[self.pairs]
        return self._batches(np.flatnonzero((ends >= 0).all(axis=1) & (ends[:, 0] != ends[:, 1])), 1)

    def parts(self, max_matches: int) -> Sequence[MatchPart]:
        """Return all pairs, in their order, in parts of about equally many matches; see `Matches.parts`."""
        totals = offsets_of(self._counts)
        count = max(-(-int(totals[-1]) // max(max_matches, 1)), 1)
        bounds = distinct(np.searchsorted(totals, np.linspace(0, totals[-1], count + 1)))
        bounds[-1] = len(totals) - 1
        return self.matches.parts(self, [slice(*ends) for ends in itertools.pairwise(bounds.tolist())])

    def _tell(self, batches: Iterator[AnyMatches], advance: Advance) -> Iterator[AnyMatches]:
        """Yield batches, and report the pairs as they are consumed."""
        done = 0
        for batch in batches:
            yield batch
            done += len(batch.pairs)
            advance(done, self.num_pairs)
        advance(self.num_pairs, self.num_pairs)

    def _batches(self, chosen: IntArray, min_matches: int) -> Iterator[MatchBatch]:
        for found in self._links(chosen, min_matches):
            self._keep_rays(distinct(found.pairs))
            rows = found.spread(self._begins[found.pairs]) + found.keypoints
            yield MatchBatch(
                pairs=found.pairs,
                offsets=found.offsets,
                keypoints=found.keypoints,
                rays_i=self._rays.take(rows[:, 0], axis=0),
                rays_j=self._rays.take(rows[:, 1], axis=0),
                pixel_angles=1.0 / self._focal_lengths_px[found.pairs].min(axis=1),
            )

    def _links(self, chosen: IntArray, min_matches: int) -> Iterator[KeypointMatches]:
        """Yield the matches of chosen pairs whose keypoints have rays, of those pairs that have enough."""
        for first, last in batch_ranges(self._counts[chosen], self.reading.batch):
            batch = self._keypoint_batch(chosen[first:last], max(min_matches, 1))
            if len(batch.pairs):
                yield batch

    def _keypoint_batch(self, chosen: IntArray, min_matches: int) -> KeypointMatches:
        pairs = self.pairs[chosen]
        all_see = all(self._blind_of(image) is None for image in distinct(pairs).tolist())
        counts, keypoints = self.matches.read(self.rows[chosen], keep=self.reading.keeps)
        if not all_see:
            has_ray = np.ones(len(keypoints), dtype=np.bool_)
            ends = itertools.pairwise(offsets_of(counts).tolist())
            for images, (first, last) in zip(pairs.tolist(), ends, strict=True):
                for side, image in enumerate(images):
                    blind = self._blind_of(image)
                    if blind is not None:
                        has_ray[first:last] &= ~blind[keypoints[first:last, side]]
            keypoints = keypoints[has_ray]
            counts = np.bincount(np.repeat(np.arange(len(pairs)), counts)[has_ray], minlength=len(pairs))
        kept = counts >= min_matches
        if not kept.all():
            keypoints = keypoints[np.repeat(kept, counts)]
        return KeypointMatches(
            pairs=pairs[kept],
            offsets=offsets_of(counts[kept]),
            keypoints=keypoints.astype(np.int64),
        )

    def _keep_rays(self, images: IntArray) -> None:
        """Make the rays of images' keypoints; those of others are given up where there is no room."""
        new = images[self._begins[images] < 0]
        if self._num_rays + self.num_keypoints[new].sum() > len(self._rays):
            self._forget_rays()
            new, needed = images, int(self.num_keypoints[images].sum())
            most = min(int(self.num_keypoints.sum()), self.reading.rays_bytes // 24)
            self._rays = np.empty((max(needed, most), 3))  # memory is taken as they come
        for image in new.tolist():
            begin, pixels = self._num_rays, self.matches.keypoints(self.images.names[image])
            rays = self.matches.rays(self.images.lenses[int(self.images.lens_of[image])], pixels)
            self._rays[begin : begin + len(rays)] = normalized(rays @ self._rotations[image])
            self._begins[image], self._num_rays = begin, begin + len(rays)

    def forget(self) -> None:
        """Give back the memory of all that is kept with rays; it is made again where it is needed."""
        self._kept.clear()
        self._forget_rays()

    def give_back(self) -> None:
        """Give back the memory of the rays of keypoints, and of very many matches."""
        self._forget_rays()
        if self.num_matches > MOST_BESIDE_TRACKS:
            self.matches.forget()

    def _forget_rays(self) -> None:
        self._rays, self._num_rays = np.empty((0, 3)), 0
        self._begins = np.full(self.images.num_images, -1)

    def _blind_of(self, image: int) -> BoolArray | None:
        """Return which keypoints of an image have no ray, (k,); None if all have one."""
        if image not in self._blind:
            self._keep_rays(np.array([image]))
            begin = self._begins[image]
            blind = np.isnan(self._rays[begin : begin + self.num_keypoints[image], 0])
            self._blind[image] = blind if blind.any() else None
        return self._blind[image]


def is_among(pairs: IntArray, others: IntArray) -> BoolArray:
    """Return which pairs (k, 2) are among others (m, 2), whatever the order of their images."""
    return rows_of_pairs(pairs, others) >= 0


def rows_of_pairs(pairs: IntArray, others: IntArray) -> IntArray:
    """Return the row of each pair (k, 2) among others (m, 2), -1 for none, whatever the order of images."""
    size = 1 + max(int(pairs.max(initial=0)), int(others.max(initial=0)))
    keys, those = (np.sort(ends, axis=1) @ np.array([size, 1]) for ends in (pairs, others))
    those = np.append(those, -1)  # which is none
    order = np.argsort(those, kind="stable")
    rows = order[np.minimum(np.searchsorted(those, keys, sorter=order), len(those) - 1)]
    return np.asarray(np.where(those[rows] == keys, rows, -1))


def indices_of_pairs(index: Mapping[str, int], pairs: PairNames) -> IntArray:
    """Return pairs (k, 2) by the index of each name; those of images that have none are dropped."""
    ends = [(index[a], index[b]) for a, b in pairs if a in index and b in index]
    return np.array(ends, dtype=np.int64).reshape(-1, 2)


def batch_ranges(sizes: IntArray, limit: int) -> Iterator[tuple[int, int]]:
    """Yield ranges [first, last) of consecutive items whose sizes sum to at most `limit`, or of one item."""
    first, total = 0, 0
    for item, size in enumerate(sizes.tolist()):
        if item > first and total + size > limit:
            yield first, item
            first, total = item, 0
        total += size
    if first < len(sizes):
        yield first, len(sizes)


def lens_runs(lens_of: IntArray, counts: IntArray) -> list[tuple[int, int]]:
    """Return ranges of images (i,) that follow one another through one lens, of few observations (i,) in all.

    What a lens does to them is computed at once: a call takes as long as a thousand observations.
    """
    ends = [0, *(1 + np.flatnonzero(np.diff(lens_of))).tolist(), len(lens_of)]
    return [
        (first + begin, first + end)
        for first, last in itertools.pairwise(ends)
        for begin, end in batch_ranges(counts[first:last], _OBSERVATIONS_A_RUN)
    ]
