"""Does another focal length than the given one fit the matches of a camera better?

If the focal length of a camera is wrong by a factor, all its rays spread too much or too little about the
optical axis. So for each camera some of its pairs are fitted anew for each of some factors, and the mean
robust weight W of the matches says which factor fits best:

    gain(pair, factor) = W(factor) - W(1)

Rotations held. The direction of each pair is estimated for its given relative rotation. With a rotation of
its own each pair would make up for most of a wrong focal length where the optical axes meet, as on a ring
about an object, or where the picture is flat. One rotation for all pairs of an image does not.

Rotations free. Where the given rotations are as wrong as the focal length, because they were found with it,
that says nothing. If no camera is named with rotations held, the relative pose of each pair is refined for
each factor (`rotations.two_view_poses`).

Residuals are in pixels of each image, as it was taken, lest a factor gain by making the noise of one smaller:

    r = e / sqrt(|de/dpixel_i|^2 + |de/dpixel_j|^2),    e = t . (R a x b)

A camera is doubted if the mean gain of its best factor over all of its pairs is large, if the pairs that
gain 0.01 or more outnumber those that lose as much by three standard deviations of a fair coin, if the pairs
of its own images do not lose as clearly, and if the factor differs from 1 by 5 % or more. With rotations
held, it must have two images, and three quarters of its images must gain: the pairs of a single one gain by a
factor if its rotation is wrong, too.

One wrong camera makes others seem wrong that have pairs with it, but their own pairs lose what these gain:
the camera that gains most in all is named first, gets that focal length, and those that were doubted with it
are examined again. If another one gains nearly as much, and is cleared by that correction, neither is named.
Chosen on seven scenes: `scripts/results/notes.md#focal-lengths`.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.pairs.estimate import estimate_directions
from sfm_shapefit.pairs.pair_directions import is_usable
from sfm_shapefit.pairs.two_view_poses import refine_two_view_poses
from sfm_shapefit.scene.matches import RayMatches

_COARSE = (0.42, 0.6, 0.77, 0.9, 1.1, 1.3, 1.7, 2.4)  # factors; one lies in the reach of any true one
_FINE_STEPS = (0.85, 0.9, 0.95, 1.05, 1.1, 1.18)  # factors on the best coarse one; as close as a gain shows
_WIDTH_PX = 1.5  # pixels; width of the robust weights
# Mean gain over all pairs, with rotations held and free; a rotation of its own lets each pair gain by chance.
_LEAST_GAINS = {True: 0.01, False: 0.03}
_NOTICED, _LEAST_SIGMAS = 0.01, 3.0  # gain of a pair, and deviations of a fair coin; see the header
_LEAST_CHANGE = 0.05  # relative change of the focal length; a smaller one is not worth a name
# Images of a camera, and the share of them that gain, with rotations held; see the header.
_FEWEST_IMAGES, _LEAST_SHARE_OF_IMAGES = 2, 0.75
_RIVAL = 0.8  # share of the largest gain; from here on a rival gains nearly as much
_FEWEST_PAIRS = 5  # pairs of a camera; fewer are chance
_MOST_NAMED = 5  # cameras named; each takes a round of trials


class Lenses(NamedTuple):
    """The cameras that took n images."""

    camera_of: IntArray
    """(n,) label of the camera of each image, from 0."""
    focal_lengths_px: FloatArray
    """(n,)"""
    is_angular: BoolArray
    """(n,) whether the distance from the center of the image grows with the angle, as of fisheye cameras, and
    not with its tangent."""


class FocalDoubt(NamedTuple):
    """A camera whose matches prefer another focal length."""

    camera: int
    """Its label."""
    factor: float
    """The preferred focal length over the given one."""
    gain: float
    """Growth of the mean robust weight of its matches."""
    num_pairs: int
    """Pairs that were asked."""


def doubt_focal_lengths(
    rays: RayMatches, rotations: FloatArray, lenses: Lenses, threads: int = 1
) -> tuple[FocalDoubt, ...]:
    """Return the cameras whose matches clearly prefer another focal length, the worst first.

    Args:
        rays: matches of some pairs, in camera axes.
        rotations: (n, 3, 3) the given ones, cam_from_world, from which the poses are refined.
        lenses: lenses of the n images.
        threads: number of threads to share the pairs among.
    """
    asked = _Asked(rays, rotations, lenses, threads)
    return _name(asked, hold=True) or _name(asked, hold=False)


class _Asked(NamedTuple):
    """The pairs that are asked, and how."""

    rays: RayMatches
    rotations: FloatArray
    lenses: Lenses
    threads: int


def _name(asked: _Asked, *, hold: bool) -> tuple[FocalDoubt, ...]:
    """Return the cameras that stay in doubt as one after the other is corrected; rotations held or free."""
    factors = np.ones(int(asked.lenses.camera_of.max(initial=-1)) + 1)
    found: list[FocalDoubt] = []
    # Only what was doubted at first is asked again: a right focal length makes no other one look wrong.
    doubts = _ask(asked, factors, np.arange(len(factors)), hold=hold)
    while doubts and len(found) < min(_MOST_NAMED, len(factors) - 1):
        worst = max(doubts, key=lambda doubt: doubt.gain * doubt.num_pairs)
        factors[worst.camera] = worst.factor
        others = [doubt for doubt in doubts if doubt is not worst]
        doubts = (
            _ask(asked, factors, np.array([doubt.camera for doubt in others]), hold=hold) if others else []
        )
        cleared = {doubt.camera for doubt in others} - {doubt.camera for doubt in doubts}
        enough = _RIVAL * worst.gain * worst.num_pairs
        if any(doubt.camera in cleared and doubt.gain * doubt.num_pairs > enough for doubt in others):
            factors[worst.camera] = 1.0
            break
        found.append(worst)
    return tuple(found)


def _ask(asked: _Asked, factors: FloatArray, cameras: IntArray, *, hold: bool) -> list[FocalDoubt]:
    """Return what the pairs of some cameras prefer to the given focal lengths, where they do."""
    of_images = asked.lenses.camera_of[asked.rays.pairs]
    shared, rows = np.nonzero((of_images[None] == cameras[:, None, None]).any(axis=2))
    asking = cameras[shared]
    is_mixed = (of_images[rows] != asking[:, None]).any(axis=1)
    enough = np.bincount(shared, is_mixed, len(cameras)) >= _FEWEST_PAIRS
    rows, asking = rows[enough[shared]], asking[enough[shared]]
    if len(rows) == 0:
        return []

    def fit(chosen: IntArray, factor: float) -> FloatArray:
        """Return the weight shares of some rows if the asking camera of each has such a factor."""
        pairs = of_images[rows[chosen]]
        tried = np.where(pairs == asking[chosen][:, None], factor, factors[pairs])
        return _weight_shares(asked._replace(rays=asked.rays.rays_of(rows[chosen])), tried, hold=hold)

    everyone = np.arange(len(rows))
    held = fit(everyone, 1.0)
    coarse = {factor: fit(everyone, factor) - held for factor in _COARSE}
    doubts = []
    for camera in cameras[enough].tolist():
        chosen = np.flatnonzero(asking == camera)
        gains = {factor: gain[chosen] for factor, gain in coarse.items()}
        own = of_images[rows[chosen]] == camera
        images = np.where(own, asked.rays.pairs[rows[chosen]], -1)
        best = _best(gains)
        if not _is_doubtful(gains[best], images, hold=hold):
            continue
        for step in _FINE_STEPS:
            gains[best * step] = fit(chosen, best * step) - held[chosen]
        best = _best(gains)
        if abs(best - 1.0) >= _LEAST_CHANGE and _is_doubtful(gains[best], images, hold=hold):
            doubts.append(FocalDoubt(camera, best, float(gains[best].mean()), len(chosen)))
    return doubts


def _best(gains: dict[float, FloatArray]) -> float:
    """Return the factor whose pairs gain most."""
    return max(gains, key=lambda factor: float(gains[factor].mean()))


def _is_doubtful(gains: FloatArray, images: IntArray, *, hold: bool) -> bool:
    """Return whether a camera's gains (k,) speak against it; `images` (k, 2) are its own, -1 for others."""
    least, inner = _LEAST_GAINS[hold], (images >= 0).all(axis=1)
    if not _is_clear(gains, least) or _is_clear(-gains[inner], least):
        return False
    _, labels = np.unique(images, return_inverse=True)
    of_images = np.bincount(labels.ravel(), np.repeat(gains, 2))[int(not inner.all()) :]
    gaining = float(np.mean(of_images > 0.0))
    return not hold or (len(of_images) >= _FEWEST_IMAGES and gaining >= _LEAST_SHARE_OF_IMAGES)


def _is_clear(gains: FloatArray, least: float) -> bool:
    """Return whether the mean of the gains (k,) of pairs is large, and clearly more gain than lose."""
    up, down = int(np.sum(gains > _NOTICED)), int(np.sum(gains < -_NOTICED))
    large = up > 0 and float(gains.mean()) > least
    return large and up - down > _LEAST_SIGMAS * float(np.sqrt(up + down))


def _weight_shares(asked: _Asked, factors: FloatArray, *, hold: bool) -> FloatArray:
    """Return the weight share of each pair, (k,), for focal lengths that are factors (k, 2) as large."""
    rays, lenses = asked.rays, asked.lenses
    counts = np.diff(rays.offsets)
    focal_lengths_px = factors * lenses.focal_lengths_px[rays.pairs]
    sides = [
        _Side(
            _spread(own, np.repeat(factors[:, side], counts), is_angular),
            np.repeat(focal_lengths_px[:, side], counts),
            is_angular,
        )
        for side, own in enumerate((rays.rays_i, rays.rays_j))
        for is_angular in [np.repeat(lenses.is_angular[rays.pairs[:, side]], counts)]
    ]
    rotations = asked.rotations[rays.pairs[:, 1]] @ asked.rotations[rays.pairs[:, 0]].transpose(0, 2, 1)
    turned = np.einsum("kab,kb->ka", np.repeat(rotations, counts, axis=0), sides[0].rays)
    given = replace(rays, rays_j=sides[1].rays, pixel_angles=1.0 / focal_lengths_px.max(axis=1))
    found = estimate_directions(replace(given, rays_i=turned), None, asked.threads)
    translations = np.where(is_usable(found.status)[:, None], found.directions, [1.0, 0.0, 0.0])
    if not hold:
        freed = replace(given, rays_i=sides[0].rays)
        refined = refine_two_view_poses(freed, rotations, translations, asked.threads)
        rotations, translations = refined.rotations, refined.translations
    errors_px = _residuals_px(
        sides[0], sides[1], np.repeat(rotations, counts, axis=0), np.repeat(translations, counts, axis=0)
    )
    weights = (1.0 + (errors_px / _WIDTH_PX) ** 2) ** -2
    sums = np.append(0.0, np.cumsum(weights))
    return np.diff(sums[rays.offsets]) / np.maximum(counts, 1)


class _Side(NamedTuple):
    """One of the two rays of k matches, and the lens it came through."""

    rays: FloatArray
    """(k, 3) unit rays in camera axes."""
    focal_lengths_px: FloatArray
    """(k,)"""
    is_angular: BoolArray
    """(k,) as of `Lenses`."""

    def change_per_pixel(self, normals: FloatArray) -> FloatArray:
        """Return the length of the derivatives (k,) of normals (k, 3) . ray by the two coordinates in pixels.

        In a plane picture (x, y) = f (X / Z, Y / Z), and where the product is 0 it changes by
        (n_x, n_y) Z / f for a unit ray, as its length over Z does not count. An angular picture has f pixels
        a radian, about.
        """
        rays, is_plane = self.rays, ~self.is_angular & (self.rays[:, 2] > 0.0)
        across = normals - np.einsum("ka,ka->k", normals, rays)[:, None] * rays
        on_plane = np.linalg.norm(normals[:, :2], axis=1) * rays[:, 2]
        return np.asarray(
            np.where(is_plane, on_plane, np.linalg.norm(across, axis=1)) / self.focal_lengths_px
        )


def _residuals_px(i: _Side, j: _Side, rotations: FloatArray, translations: FloatArray) -> FloatArray:
    """Return the Sampson errors (k,) of matches under relative poses (k, 3, 3) and (k, 3)."""
    turned = np.einsum("kab,kb->ka", rotations, i.rays)
    by_j = np.cross(translations, turned)
    by_i = np.einsum("kba,kb->ka", rotations, np.cross(j.rays, translations))
    change = np.hypot(i.change_per_pixel(by_i), j.change_per_pixel(by_j))
    return np.asarray(np.einsum("ka,ka->k", by_j, j.rays) / np.maximum(change, 1e-300))


def _spread(rays: FloatArray, factors: FloatArray, is_angular: BoolArray) -> FloatArray:
    """Return rays (k, 3) in camera axes as they are if the focal length is a factor (k,) larger."""
    across = np.hypot(rays[:, 0], rays[:, 1])
    angles = np.arctan2(across, rays[:, 2])
    in_front = angles < 0.5 * np.pi - 1e-3
    by_tangent = np.arctan2(across, factors * np.where(in_front, rays[:, 2], 1.0))
    narrowed = np.where(is_angular, angles / factors, np.where(in_front, by_tangent, angles))
    sideways = np.nan_to_num(normalized(rays[:, :2]))
    lengths = np.sin(np.minimum(narrowed, np.pi))
    heights = np.cos(np.minimum(narrowed, np.pi))
    return np.concatenate([lengths[:, None] * sideways, heights[:, None]], axis=1)
