"""Does another focal length than the given one fit the matches of a camera better?

If the focal length of a camera is wrong by a factor, all its rays spread too much or too little about the
optical axis. A rotation and a translation of a pair cannot make up for that where the other image is taken by
another camera, or from another place. So for each camera the relative poses of some of its pairs are refined
anew for each of some factors, from the given rotations on, and the mean robust weight of the matches says
which factor fits best (`rotations.two_view_poses`):

    gain(camera, factor) = mean over its pairs of W(factor) - W(1)

A camera is named if over its pairs with other cameras the gain of the best factor is above 0.03 and the
pairs that gain 0.01 or more outnumber those that lose as much by three standard deviations of a fair coin, if
the pairs of its own images do not lose as clearly, and if the factor differs from 1 by 5 % or more. One wrong
camera makes others seem wrong, those that have pairs with it: the camera whose factor gains most in all is
named first, gets that focal length, and those that were doubted with it are asked again. Chosen on five
scenes, of whose images a third, or those of one camera, got a focal length off by 10 to 140 %.

Residuals are in pixels of the image with the larger focal length: in those of the other, a shorter focal
length would always fit better.
"""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.directions.estimate import estimate_directions
from sfm_shapefit.directions.matches import RayMatches
from sfm_shapefit.directions.pair_directions import is_usable
from sfm_shapefit.geometry import normalized
from sfm_shapefit.rotations.two_view_poses import refine_two_view_poses

_COARSE = (0.42, 0.6, 0.77, 0.9, 1.1, 1.3, 1.7, 2.4)
_FINE_STEPS = (0.85, 0.9, 0.95, 1.05, 1.1, 1.18)
_LEAST_GAIN, _NOTICED, _LEAST_SIGMAS = 0.03, 0.01, 3.0
_LEAST_CHANGE = 0.05
_FEWEST_PAIRS = 5
_MOST_NAMED = 5


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
    """By what the mean robust weight of its matches grows."""
    num_pairs: int
    """Pairs that were asked."""


def doubt_focal_lengths(
    rays: RayMatches, rotations: FloatArray, lenses: Lenses, threads: int = 1
) -> tuple[FocalDoubt, ...]:
    """Return the cameras whose matches clearly prefer another focal length, the worst first.

    Args:
        rays: matches of some pairs, in camera axes.
        rotations: (n, 3, 3) the given ones, cam_from_world, from which the poses are refined.
        lenses: of the n images.
        threads: number of threads to share the pairs among.
    """
    factors = np.ones(int(lenses.camera_of.max(initial=-1)) + 1)
    asked = _Asked(rays, rotations, lenses, threads)
    found: list[FocalDoubt] = []
    open_questions = np.arange(len(factors))
    while len(open_questions) and len(found) < min(_MOST_NAMED, len(factors) - 1):
        # Only what was doubted at first is asked again: a right focal length makes no other one look wrong.
        doubts = _ask(asked, factors, open_questions)
        if not doubts:
            break
        worst = max(doubts, key=lambda doubt: doubt.gain * doubt.num_pairs)
        factors[worst.camera] = worst.factor
        found.append(worst)
        open_questions = np.array([doubt.camera for doubt in doubts if doubt.camera != worst.camera])
    return tuple(found)


class _Asked(NamedTuple):
    """The pairs that are asked, and how."""

    rays: RayMatches
    rotations: FloatArray
    lenses: Lenses
    threads: int


def _ask(asked: _Asked, factors: FloatArray, cameras: IntArray) -> list[FocalDoubt]:
    """Return what the pairs of some cameras prefer to the given focal lengths, where they do."""
    of_images = asked.lenses.camera_of[asked.rays.pairs]
    shared, rows = np.nonzero((of_images[None] == cameras[:, None, None]).any(axis=2))
    asking = cameras[shared]
    is_mixed = (of_images[rows] != asking[:, None]).any(axis=1)
    enough = np.bincount(shared, is_mixed, len(cameras)) >= _FEWEST_PAIRS
    rows, asking, is_mixed = (column[enough[shared]] for column in (rows, asking, is_mixed))
    if len(rows) == 0:
        return []
    part = asked._replace(rays=_subset(asked.rays, rows))
    own = of_images[rows] == asking[:, None]

    def fit(tried: FloatArray) -> FloatArray:
        """Return the weight shares if the asking camera of each row has such a factor."""
        return _weight_shares(part, np.where(own, tried[:, None], factors[of_images[rows]]))

    given = fit(np.ones(len(rows)))
    gains = {factor: fit(np.full(len(rows), factor)) - given for factor in _COARSE}
    best = dict.fromkeys(cameras[enough].tolist(), 1.0)
    for camera in best:
        best[camera] = max(gains, key=lambda factor: float(gains[factor][asking == camera].mean()))
    clear = {
        camera: factor
        for camera, factor in best.items()
        if _is_clear(gains[factor][(asking == camera) & is_mixed])
    }
    doubts = []
    for camera, coarse in clear.items():
        chosen = np.flatnonzero(asking == camera)
        alone = part._replace(rays=_subset(part.rays, chosen))
        finer = {coarse: gains[coarse][chosen]}
        for step in _FINE_STEPS:
            tried = np.where(own[chosen], coarse * step, factors[of_images[rows[chosen]]])
            finer[coarse * step] = _weight_shares(alone, tried) - given[chosen]
        factor = max(finer, key=lambda one: float(finer[one].mean()))
        gain, mixed = finer[factor], is_mixed[chosen]
        if abs(factor - 1.0) >= _LEAST_CHANGE and _is_clear(gain[mixed]) and not _is_clear(-gain[~mixed]):
            doubts.append(FocalDoubt(camera, factor, float(gain.mean()), len(chosen)))
    return doubts


def _is_clear(gains: FloatArray) -> bool:
    """Return whether the mean of the gains (k,) of pairs is large, and clearly more gain than lose."""
    up, down = int(np.sum(gains > _NOTICED)), int(np.sum(gains < -_NOTICED))
    large = up > 0 and float(gains.mean()) > _LEAST_GAIN
    return large and up - down > _LEAST_SIGMAS * float(np.sqrt(up + down))


def _weight_shares(asked: _Asked, factors: FloatArray) -> FloatArray:
    """Return the weight share of each pair, (k,), for focal lengths that are factors (k, 2) as large."""
    rays, lenses = asked.rays, asked.lenses
    counts = np.diff(rays.offsets)
    i, j = rays.pairs.T
    rays_i, rays_j = (
        _spread(own, np.repeat(factor, counts), np.repeat(lenses.is_angular[side], counts))
        for own, factor, side in ((rays.rays_i, factors[:, 0], i), (rays.rays_j, factors[:, 1], j))
    )
    pixel_angles = 1.0 / (factors * lenses.focal_lengths_px[rays.pairs]).max(axis=1)
    rotations = asked.rotations[j] @ asked.rotations[i].transpose(0, 2, 1)
    turned = np.einsum("kab,kb->ka", np.repeat(rotations, counts, axis=0), rays_i)
    columns = {"pairs": rays.pairs, "offsets": rays.offsets, "pixel_angles": pixel_angles}
    directions = estimate_directions(RayMatches(rays_i=turned, rays_j=rays_j, **columns), None, asked.threads)
    known = is_usable(directions.status)[:, None]
    starts = np.where(known, directions.directions, [1.0, 0.0, 0.0])
    refined = refine_two_view_poses(
        RayMatches(rays_i=rays_i, rays_j=rays_j, **columns), rotations, starts, asked.threads
    )
    return refined.weight_shares


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


def _subset(rays: RayMatches, rows: IntArray) -> RayMatches:
    """Return some of the pairs."""
    counts = np.diff(rays.offsets)[rows]
    offsets = np.append(0, np.cumsum(counts))
    chosen = np.repeat(rays.offsets[:-1][rows] - offsets[:-1], counts) + np.arange(offsets[-1])
    return RayMatches(
        pairs=rays.pairs[rows],
        offsets=offsets,
        rays_i=rays.rays_i[chosen],
        rays_j=rays.rays_j[chosen],
        pixel_angles=rays.pixel_angles[rows],
    )
