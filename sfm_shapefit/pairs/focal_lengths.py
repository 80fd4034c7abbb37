"""Focal lengths of lenses that are no case of OPENCV, by the rays of the matches of some pairs.

A fundamental matrix of pixels says nothing of them: a fisheye bends what is straight. With rays, a pair has a
relative pose at any focal length, but only near the right one do all matches fit it. So the share of matches
that poses explain (their mean robust weight) is sought over factors of the focal length: a grid, then ever
smaller steps from the best of it. Lenses of one model, size and guess are off by the same factor.
"""

from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, distinct
from sfm_shapefit.base.lists import Lists, offsets_of
from sfm_shapefit.pairs.essential import LikelyPoses, estimate_relative_rotations
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.scene.lens import Lens
from sfm_shapefit.scene.matches import RayMatches, View

_STEP = 1.12  # factor between focal lengths that are tried; poses at the right one still fit half a step off
# COLMAP's guess, 1.2 times the larger side, is four times too long for a picture of a half sphere.
_FACTORS = _STEP ** np.arange(-17.0, 11.0)
_NARROWER = (0.5, 0.25, 0.125)  # steps from the best of these, in theirs; an adjustment does the rest
# Steps from the best, from which on focal lengths are to explain less of the matches, and by which share of
# all: through a fisheye .2 less, through a lens that hardly bends .03; chance makes less than .01.
_APART, _LEAST_GAIN = 4, 0.02
# Share of matches that a lens of the right bend explains at least, and first coefficients to be tried where
# none is reached: lenses of these models may be guessed planes and be fisheyes.
_FITS = 0.5
_MOST_KINDS = 8  # kinds of lenses, those of most images; each takes a second
# Pairs of a kind, evenly of all by their matches; pairs of the most matches alone are of neighbors, which say
# little. Pairs of few matches fit any focal length, and of very many a part does.
_MOST_PAIRS, _FEWEST_MATCHES, _MOST_MATCHES = 24, 40, 200


@dataclass(frozen=True, slots=True, eq=False)
class _PixelMatches(Lists):
    """Matches of k pairs, M in all, one pair after the other."""

    offsets: IntArray
    """(k + 1,) the matches of pair p are rows offsets[p] to offsets[p + 1]."""
    pixels: FloatArray
    """(M, 2, 2) in the first and in the second image."""
    lenses: IntArray
    """(k, 2) rows of the lenses of both images."""


def find_lenses(view: View, wanted: BoolArray, doubted: BoolArray) -> dict[int, Lens]:
    """Return lenses with the focal lengths that matches want, by row; nothing of those left open.

    Args:
        view: of images in axes of their cameras.
        asked: (l,) lenses that are no cases of OPENCV.
        doubted: (l,) lenses whose focal lengths are not known; pairs of others of these say nothing.
    """
    images = view.images
    kinds, num_images = defaultdict(list), np.bincount(images.lens_of, minlength=len(wanted))
    for k in np.flatnonzero(wanted).tolist():
        lens = images.lenses[k]
        kinds[lens.model, lens.width, lens.height, lens.parameters].append(k)
    lenses: dict[int, Lens] = {}
    for rows in sorted(kinds.values(), key=lambda rows: (-num_images[rows].sum(), rows))[:_MOST_KINDS]:
        of_group = np.isin(np.arange(len(wanted)), rows)
        matches, share = _choose_matches(view, of_group, of_group | ~doubted), -1.0
        start = images.lenses[rows[0]]
        for lens in (start, *(start.bent(bend) for bend in start.bends)):
            tried = tuple(
                lens if is_own else other for other, is_own in zip(images.lenses, of_group, strict=True)
            )
            factor, best = _find_factor(matches, tried, of_group)
            if factor is not None and best > share:
                share, parameters = best, lens.longer(factor).parameters
                lenses |= {k: replace(images.lenses[k], parameters=parameters) for k in rows}
            if best >= _FITS:
                break
    return lenses


def _choose_matches(view: View, own: BoolArray, known: BoolArray) -> _PixelMatches:
    """Return matches of pairs whose lenses are all `known` (l,), and one at least of the `own` (l,)."""
    lenses, counts = view.images.lens_of[view.pairs], view.matches.num_matches[view.rows]
    says = own[lenses].any(axis=1) & known[lenses].all(axis=1) & (counts >= _FEWEST_MATCHES)
    ranked = np.flatnonzero(says)[np.argsort(-counts[says], kind="stable")]
    taken = min(len(ranked), _MOST_PAIRS)
    is_chosen = np.zeros(view.num_pairs, dtype=np.bool_)
    is_chosen[ranked[np.arange(taken) * len(ranked) // max(taken, 1)]] = True
    pixels, pairs = [np.zeros((0, 2, 2))], [np.zeros((0, 2), dtype=np.int64)]
    for batch in view.links(chosen=is_chosen):
        pairs.append(batch.pairs)
        for (i, j), rows in zip(batch.pairs.tolist(), batch.slices(), strict=True):
            number = min(rows.stop - rows.start, _MOST_MATCHES)
            even = np.linspace(rows.start, rows.stop - 1, number).astype(np.int64)
            left, right = batch.keypoints[even].T
            pixels.append(np.stack([view.keypoints(i)[left], view.keypoints(j)[right]], axis=1))
    offsets = np.cumsum([len(part) for part in pixels])
    return _PixelMatches(offsets, np.concatenate(pixels), view.images.lens_of[np.concatenate(pairs)])


def _find_factor(
    matches: _PixelMatches, lenses: tuple[Lens, ...], own: BoolArray
) -> tuple[float | None, float]:
    """Return the factor at which the matches fit best, None if they do not determine one, and their share."""
    fits = [_fit(matches, lenses, own, factor) for factor in _FACTORS.tolist() if len(matches.pixels)]
    shares = np.array([share for share, _ in fits])
    best = int(np.argmax(shares)) if fits else 0
    is_apart = np.abs(np.arange(len(fits)) - best) >= _APART
    if not _APART <= best < len(fits) - _APART or shares[best] < shares[is_apart].max() + _LEAST_GAIN:
        return None, float(shares.max(initial=0.0))
    factor, (share, found) = float(_FACTORS[best]), fits[best]
    for part in _NARROWER:
        for tried in (factor / _STEP**part, factor * _STEP**part):
            again, there = _fit(matches, lenses, own, tried, found)
            if again > share:
                factor, share, found = tried, again, there
    return factor, share


def _fit(
    matches: _PixelMatches,
    lenses: tuple[Lens, ...],
    own: BoolArray,
    factor: float,
    near: RelativeRotations | None = None,
) -> tuple[float, RelativeRotations]:
    """Return the share of the matches that relative poses explain at a factor, and the poses.

    They are sought by trials, or near those of another factor.
    """
    rays = _rays(matches, lenses, own, factor)
    likely = None
    if near is not None:
        turns, shifts = np.tile(np.eye(3), (len(rays.pairs), 1, 1)), np.full((len(rays.pairs), 3), np.nan)
        turns[near.pairs[:, 0]], shifts[near.pairs[:, 0]] = near.rotations, near.translations
        likely = LikelyPoses(turns, shifts, np.zeros(len(rays.pairs)))
    found = estimate_relative_rotations(rays, likely=likely)
    return float(found.weight_shares @ found.num_matches) / len(matches.pixels), found


def _rays(matches: _PixelMatches, lenses: tuple[Lens, ...], own: BoolArray, factor: float) -> RayMatches:
    """Return the matches whose pixels have rays; pair p is (p, p)."""
    scaled = [lens.longer(factor) if own[k] else lens for k, lens in enumerate(lenses)]
    pair_of = matches.list_of_rows()
    rays = np.empty((*matches.pixels.shape[:2], 3))
    for k in distinct(matches.lenses).tolist():
        sees = matches.lenses[pair_of] == k
        rays[sees] = scaled[k].rays(matches.pixels[sees])
    has_ray = np.isfinite(rays).all(axis=(1, 2))
    counts = np.bincount(pair_of[has_ray], minlength=len(matches.lenses))
    focal_lengths_px = np.array([lens.focal_px for lens in scaled])[matches.lenses]
    return RayMatches(
        pairs=np.repeat(np.arange(len(counts))[:, None], 2, axis=1),
        offsets=offsets_of(counts),
        rays_i=rays[has_ray, 0],
        rays_j=rays[has_ray, 1],
        pixel_angles=1.0 / focal_lengths_px.min(axis=1),
    )
