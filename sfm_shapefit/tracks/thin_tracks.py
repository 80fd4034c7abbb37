"""The choice of few tracks that hold every camera: what a first, thin adjustment is made of.

Lengths count up to six; the longest come first, in random order among equals: by length alone small scenes
are held by few, coarse features. A track is taken if two of its images, or half of them, still want
observations, or if one has less than a third of what it wants. Each image wants 200, in small scenes its
share of 20,000, or some times that.

A track far longer than the others is none of them. It is one that wrong matches have joined of many, and it
joins every two of its images in the reduced system: on a facade of 2,500 images three such tracks of 17,730,
of 480 to 966 images, made 835,000 of the 954,000 pairs, and 14 times the work of the factor.

What is random is a hash of the pixels, so the choice depends neither on the order of the tracks nor on the
order of the images.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import IndexArray, IntArray, UInt64Array, quantile
from sfm_shapefit.base.jit import kernel, mix_bits
from sfm_shapefit.base.lists import RowLists
from sfm_shapefit.base.row_file import Gathered

_LONG = 6  # views; longer tracks come no earlier, see the header
_WANTED, _WANTED_IN_ALL = 200, 20_000  # observations per image, and in all; small scenes can afford more each
# Observations beyond which a track may be far longer than the others, and how many times as long as nine
# tenths of them it is then; see the header.
_MAYBE_JOINED, _FAR_LONGER = 100, 4.0
_MIXED_AT_ONCE = 1_000_000  # observations whose pixels are put together; they take 60 MB
_TURN = np.uint64(0x9E3779B97F4A7C15)  # multiplier of the second coordinate; the increment of splitmix64


def wanted_observations(num_images: int, times: int = 1) -> int:
    """Return how many observations each of so many images wants; arguments as of `choose_thin_tracks`."""
    return times * max(_WANTED, _WANTED_IN_ALL // max(num_images, 1))


def choose_thin_tracks(
    offsets: IntArray,
    images: IndexArray,
    pixels: npt.NDArray[np.floating] | Gathered,
    num_images: int,
    times: int = 1,
) -> IntArray:
    """Return tracks that together hold every image, ascending.

    Args:
        offsets: (t + 1,) track k has the observations offsets[k]:offsets[k + 1].
        images: (m,) the image of each observation.
        pixels: (m, 2) where it was seen.
        num_images: n.
        times: as many as each image usually wants.
    """
    lengths = np.diff(offsets)
    order = np.lexsort((_draw(offsets, pixels), -np.minimum(lengths, _LONG)))
    order = order[lengths[order] <= _longest(lengths)]
    wanted = wanted_observations(num_images, times)
    taken = np.zeros(len(lengths), dtype=np.bool_)
    _choose(order, offsets, images, wanted, np.zeros(num_images, dtype=np.int64), taken)
    return np.flatnonzero(taken)


def _longest(lengths: IntArray) -> float:
    """Return the length beyond which a track is far longer than the others."""
    if lengths.max(initial=0) <= _MAYBE_JOINED:
        return np.inf
    return max(_MAYBE_JOINED, _FAR_LONGER * float(quantile(lengths, 0.9)))


def _draw(offsets: IntArray, pixels: npt.NDArray[np.floating] | Gathered) -> UInt64Array:
    """Return a random number of each track, (t,), that its pixels alone determine."""
    drawn = [np.zeros(0, dtype=np.uint64)]
    for own in RowLists(offsets, np.zeros(0, dtype=np.int64)).cuts(_MIXED_AT_ONCE):
        bits = np.ascontiguousarray(pixels[own[0] : own[-1]], dtype=np.float64).view(np.uint64)
        mixed = mix_bits(mix_bits(bits[:, 0]) + _TURN * bits[:, 1])
        sums = np.append(np.uint64(0), np.cumsum(mixed))[own - own[0]]
        drawn.append(mix_bits(sums[1:] - sums[:-1]))
    return np.concatenate(drawn)


@kernel
def _choose(order: Any, offsets: Any, images: Any, wanted: int, seen: Any, taken: Any) -> None:
    """Write which tracks are taken, in the given order; `seen` and `taken` come as zeros."""
    for k in range(len(order)):
        first, last = offsets[order[k]], offsets[order[k] + 1]
        wanting, is_poor = 0, False
        for row in range(first, last):
            if seen[images[row]] < wanted:
                wanting += 1
            if 3 * seen[images[row]] < wanted:
                is_poor = True
        if is_poor or wanting >= 2 or (wanting > 0 and 2 * wanting >= last - first):
            taken[order[k]] = True
            for row in range(first, last):
                seen[images[row]] += 1
