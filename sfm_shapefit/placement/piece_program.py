"""Pieces in one world: ShapeFit over their scales and places, then all seven unknowns of each by the rays.

With the turn R_g of each piece known, x = s_g R_g c + t_g is linear in its scale and place, so the pieces are
rigid groups with units of their own (`graph.groups`), and the program is the certified one of `solver`,
over two kinds of directions:

    pairs   from a camera to a camera of another piece
    rays    from a camera to a point of another piece, which its keypoint observes there

Three pairs at least tell a scale; one pair with rays does, and pieces that follow one another need these.
Half of the weight goes to each kind, the rays of a pair count as the root of their number, and the program is
solved twice, the second time certified and with weights over lengths, so that angles count. Places are only
as good as the turns, so that a robust refinement moves all seven unknowns, its scale of the residuals falling
in steps.
"""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, frozen
from sfm_shapefit.base.damping import DampingRange, take_damped_step
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.base.losses import CAUCHY, loss, weighed
from sfm_shapefit.base.quaternions import rotations_of
from sfm_shapefit.base.wording import counted
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.placement.piece_ties import PieceCameras, PieceTies
from sfm_shapefit.solver.program import differences
from sfm_shapefit.solver.solve import solve
from sfm_shapefit.solver.solver_options import SolverResult

_MOST_RAYS = 30  # rays from one camera of a pair to the other's points; more tell nothing new
_LEAST_LENGTH = 1e-6  # share of the median; ends that nearly coincide would have all of the weight
_SCALES_PX = (32.0, 8.0, 2.0)  # pixels; a turn off by half a degree is 13 to 29 of them
_STEPS = 10  # Gauss-Newton steps at each scale; most scales settle in fewer
_SETTLED = 1e-5  # share of the cost; steps that lower it by less end a scale
# Shares of the diagonal; a refused step is a matter of the loss, and far less of it helps.
_DAMPING = DampingRange(first=1e-6, least=0.0, most=1.0, growth=100.0)
_SHIFT = 1e-6  # step of an unknown that tells its derivative; larger ones bend, smaller ones are rounding
_TINY = float(np.finfo(np.float64).tiny)
_EFFECTIVE = 10.0  # matches that count of a pair; its errors are common to all of them

_Linearized = tuple[float, FloatArray, FloatArray]


class Standing(NamedTuple):
    """Where pieces stand in the world of piece 0."""

    scales: FloatArray
    """(G,)"""
    turns: FloatArray
    """(G, 3, 3) world_from_piece."""
    middles: FloatArray
    """(G, 3) where the mean center of each piece's cameras comes to lie."""

    def similarity(self, piece: int, own_middles: FloatArray) -> Similarity:
        """Return world_from_piece; `own_middles` (G, 3) are the mean centers in the pieces' worlds."""
        scale, turn = float(self.scales[piece]), self.turns[piece]
        shift = self.middles[piece] - scale * turn @ own_middles[piece]
        return Similarity(scale=scale, rotation=turn, translation=shift)


def solve_pieces(
    cameras: PieceCameras, ties: PieceTies, directions: PairDirections, turns: FloatArray
) -> tuple[Standing, SolverResult]:
    """Return where pieces stand by the convex program, with their turns (G, 3, 3) held, and its certificate.

    Raises:
        UnsolvableError: if the directions do not determine it, or turn a piece inside out.
    """
    usable = np.union1d(directions.usable(), np.flatnonzero(ties.is_shared))
    rays = _rays_of(cameras, ties.subset(usable))
    between = directions.usable()
    num_cameras, num_rays = len(cameras.piece_of), len(rays.cameras)
    pieces = np.concatenate([cameras.piece_of, rays.targets])
    offsets = np.concatenate([cameras.centers, rays.points])
    edges = np.concatenate(
        [ties.matches.pairs[between], np.stack([num_cameras + np.arange(num_rays), rays.cameras], axis=1)]
    )
    if not len(edges):
        raise UnsolvableError("no pair of images between them has a direction")
    looks = np.einsum("rkl,rl->rk", turns[cameras.piece_of[rays.cameras]], rays.looks)
    units = np.where(cameras.is_metric, 0, np.cumsum(~cameras.is_metric) - (not cameras.is_metric.any()))
    every = RigidGroups(
        group_of=pieces, offsets=np.einsum("nkl,nl->nk", turns[pieces], offsets), unit_of=units
    )
    nodes, renumbered = np.unique(edges, return_inverse=True)
    groups = every.restricted_to(nodes)
    seen = np.concatenate([directions.directions[between], looks])
    sigmas = np.hypot(directions.sigma_deg()[between], 0.1)
    weights = _halved(np.concatenate([directions.weights()[between], rays.weights]), len(between))
    pairs = frozen(renumbered.reshape(-1, 2))
    try:
        graph = ViewGraph(len(nodes), pairs, seen, weights)
        locations = solve(graph, groups=groups, certified=False).locations
        lengths = np.linalg.norm(differences(locations, pairs), axis=1)
        lengths = np.maximum(lengths, _LEAST_LENGTH * np.median(lengths))
        weights = _halved(np.concatenate([1.0 / sigmas, rays.weights]) / lengths, len(between))
        graph = ViewGraph(len(nodes), pairs, seen, weights)
        solved = _certified(graph, groups)
    except UnsolvableError as error:
        number = counted(len(usable), "pair")
        raise UnsolvableError(f"{number} of images cannot tell how large it is and where") from error
    centers, scales = groups.split(groups.fit(solved.locations)[0])
    scales = scales[units]
    if not scales.min() > 0.0:
        raise UnsolvableError("the pairs of images between them turn one of them inside out")
    # `fit` returns where the origin of each group's own offsets comes to lie.
    own = np.einsum("gkl,gl->gk", turns, cameras.middles())
    middles = centers + scales[:, None] * own
    back = turns[0].T
    standing = Standing(scales / scales[0], back @ turns, (middles - centers[0]) / scales[0] @ back.T)
    return standing, solved


def _certified(graph: ViewGraph, groups: RigidGroups) -> SolverResult:
    """Return the solve with its certificate; without one where the pairs are too few for a feasible dual."""
    try:
        return solve(graph, groups=groups)
    except UnsolvableError:  # pairs that agree are counted all the same
        return solve(graph, groups=groups, certified=False)


class _Rays(NamedTuple):
    """Rays of cameras v to points of other pieces, r in all."""

    cameras: IntArray
    looks: FloatArray
    """(r, 3) unit, in the world of the camera's piece."""
    targets: IntArray
    """Piece of the point."""
    points: FloatArray
    """(r, 3) in the world of that piece."""
    pairs: IntArray
    """Pair of cameras by which it is seen."""
    pixel_angles: FloatArray

    @property
    def weights(self) -> FloatArray:
        """Return the inverse root of the number of rays of a pair, (r,)."""
        return np.asarray(np.bincount(self.pairs)[self.pairs] ** -0.5)


def _rays_of(cameras: PieceCameras, ties: PieceTies) -> _Rays:
    """Return some rays of every pair, both ways."""
    found = []
    pair_of = ties.pair_of
    for way, rays in enumerate((ties.matches.rays_i, ties.matches.rays_j)):
        known = np.isfinite(ties.points[:, 1 - way]).all(axis=1)
        rows = _thinned(np.flatnonzero(known), pair_of)
        pairs = pair_of[rows]
        eyes, others = ties.matches.pairs[pairs, way], ties.matches.pairs[pairs, 1 - way]
        looks = np.einsum("rk,rkl->rl", rays[rows], cameras.rotations[eyes])
        targets, points = cameras.piece_of[others], ties.points[rows, 1 - way]
        found.append((eyes, looks, targets, points, pairs, ties.matches.pixel_angles[pairs]))
    return _Rays(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _thinned(rows: IntArray, pair_of: IntArray) -> IntArray:
    """Return the rows with a bounded number of each pair, taken evenly."""
    pairs = pair_of[rows]
    starts = np.searchsorted(pairs, pairs)
    steps = -(-np.bincount(pairs, minlength=1)[pairs] // _MOST_RAYS)
    return np.asarray(rows[(np.arange(len(rows)) - starts) % steps == 0])


def _halved(weights: FloatArray, first: int) -> FloatArray:
    """Return positive weights whose first ones, and whose others, add up to the same."""
    totals = weights[:first].sum(), weights[first:].sum()
    return np.concatenate([weights[:first] / (totals[0] or 1.0), weights[first:] / (totals[1] or 1.0)])


class Residuals(NamedTuple):
    """What k residuals are of, each between two pieces, and in pixels.

    With a point, the unit vector to it less the ray; else the first entry alone, the volume of both rays and
    the line between the centers over the smaller of its planes.
    """

    pieces: IntArray
    """(k, 2)"""
    pairs: IntArray
    """(k,) pair of cameras."""
    eyes: FloatArray
    """(k, 3) center of the first piece's camera, in its world, from the middle of its cameras."""
    looks: FloatArray
    """(k, 3) its unit ray, there."""
    targets: FloatArray
    """(k, 3) in the second piece: the point, or the other camera's center."""
    other_looks: FloatArray
    """(k, 3) in the second piece, the other camera's unit ray; NaN where the target is a point."""
    pixel_angles: FloatArray
    """(k,)"""


def residuals_of(cameras: PieceCameras, ties: PieceTies) -> Residuals:
    """Return the residuals of some matches of a pair: of rays to points or, where none is, of two rays."""
    middles = cameras.middles()
    rays = _rays_of(cameras, ties)
    has_point = np.asarray(np.isfinite(ties.points).all(axis=2))
    bare = ~has_point.any(axis=1) & ~ties.is_shared[ties.pair_of]
    rows = _thinned(np.flatnonzero(bare), ties.pair_of)
    pairs = ties.pair_of[rows]
    i, j = ties.matches.pairs[pairs].T
    looks = [
        np.einsum("rk,rkl->rl", side[rows], cameras.rotations[eyes])
        for side, eyes in ((ties.matches.rays_i, i), (ties.matches.rays_j, j))
    ]
    eyes = np.concatenate([rays.cameras, i])
    pieces = np.stack([cameras.piece_of[eyes], np.append(rays.targets, cameras.piece_of[j])], axis=1)
    return Residuals(
        pieces=pieces,
        pairs=np.append(rays.pairs, pairs),
        eyes=cameras.centers[eyes] - middles[pieces[:, 0]],
        looks=np.concatenate([rays.looks, looks[0]]),
        targets=np.concatenate([rays.points, cameras.centers[j]]) - middles[pieces[:, 1]],
        other_looks=np.concatenate([np.full_like(rays.looks, np.nan), looks[1]]),
        pixel_angles=np.append(rays.pixel_angles, ties.matches.pixel_angles[pairs]),
    )


def misses_px(residuals: Residuals, standing: Standing) -> FloatArray:
    """Return the sizes of residuals, (k,)."""
    found = np.empty((len(residuals.pairs), 3))
    _measure(residuals, standing, found)
    return np.asarray(np.linalg.norm(found, axis=1))


def refine_pieces(cameras: PieceCameras, ties: PieceTies, standing: Standing) -> tuple[Standing, FloatArray]:
    """Return the standing of least robust (Cauchy) cost near one, and its covariance.

    The covariance (G, 7, 7) of each piece but the first, which is 0, is that of its turn (rad), the logarithm
    of its scale, and the place of its middle in sizes of the piece; infinite where nothing determines it.
    """
    residuals = residuals_of(cameras, ties)
    sizes, free = cameras.sizes(), ~cameras.is_metric
    counts = np.bincount(residuals.pairs, minlength=ties.num_pairs)[residuals.pairs]
    weights = np.asarray(counts**-0.5, dtype=np.float64)
    held = np.zeros((len(sizes), 7), dtype=np.bool_)
    held[0] = True
    held[:, 3] |= ~free
    for scale in _SCALES_PX:
        system, damping = _linearize(residuals, standing, sizes, weights, scale), _DAMPING.first
        for _ in range(_STEPS):
            propose = partial(_propose, (residuals, sizes, weights, scale), standing, system, held.ravel())
            moved, damping = take_damped_step(propose, damping, _DAMPING)
            if moved is None:
                break
            before, (standing, system) = system[0], moved
            if before - system[0] < _SETTLED * before:
                break
    _, hessian, _ = _linearize(
        residuals, standing, sizes, np.minimum(_EFFECTIVE / counts, 1.0), _SCALES_PX[-1]
    )
    return standing, _covariances(hessian, held)


def _propose(
    problem: tuple[Residuals, FloatArray, FloatArray, float],
    standing: Standing,
    system: _Linearized,
    held: BoolArray,
    damping: float,
) -> tuple[Standing, _Linearized] | None:
    """Return where a damped step leads, and what `_linearize` says there; None if the cost is not lower."""
    residuals, sizes, weights, scale = problem
    moved = _moved(standing, -_solve(*system[1:], held, damping), sizes)
    then = _linearize(residuals, moved, sizes, weights, scale)
    return (moved, then) if then[0] < system[0] else None


def _solve(hessian: FloatArray, slope: FloatArray, held: BoolArray, damping: float) -> FloatArray:
    """Return the step of the free unknowns, damped along the diagonal."""
    rows = np.flatnonzero(~held)
    matrix = hessian[np.ix_(rows, rows)]
    diagonal = np.diagonal(matrix)
    matrix = matrix + np.diag(damping * diagonal + 1e-12 * (diagonal.max() or 1.0))
    step = np.zeros(len(held))
    step[rows] = np.linalg.solve(matrix, slope[rows])
    return step


def _covariances(hessian: FloatArray, held: BoolArray) -> FloatArray:
    """Return the 7 x 7 blocks of the inverse of the free unknowns."""
    rows = np.flatnonzero(~held.ravel())
    values, vectors = np.linalg.eigh(hessian[np.ix_(rows, rows)])
    least = 1e-12 * max(float(values.max(initial=0.0)), 1e-300)
    whole = np.zeros((held.size, held.size))
    whole[np.ix_(rows, rows)] = (vectors / np.maximum(values, least)) @ vectors.T
    return np.stack([whole[k : k + 7, k : k + 7] for k in range(0, held.size, 7)])


def _moved(standing: Standing, step: FloatArray, sizes: FloatArray) -> Standing:
    """Return the pieces after a step (7 G,): turned about their middles, scaled, and shifted."""
    by_piece = step.reshape(-1, 7)
    return Standing(
        standing.scales * np.exp(by_piece[:, 3]),
        rotations_of(by_piece[:, :3]) @ standing.turns,
        standing.middles + (standing.scales * sizes)[:, None] * by_piece[:, 4:],
    )


def _linearize(
    residuals: Residuals, standing: Standing, sizes: FloatArray, weights: FloatArray, scale: float
) -> _Linearized:
    """Return the Cauchy cost, and Hessian (7 G, 7 G) and slope (7 G,) of its reweighted squares."""
    count, num_unknowns = len(sizes), 7 * len(sizes)
    steps = np.repeat(np.vstack([np.zeros(7), _SHIFT * np.eye(7)]), count, axis=0)  # (8 G, 7)
    moved = _moved(Standing(*(np.concatenate(8 * [part]) for part in standing)), steps, np.tile(sizes, 8))
    pieces, index = np.unique(residuals.pieces, axis=0, return_inverse=True)
    blocks, slopes = np.zeros((len(pieces), 14, 14)), np.zeros((len(pieces), 14))
    cost = _sum_squares(residuals, moved, index.ravel(), weights, scale, (blocks, slopes))
    hessian, slope = np.zeros((num_unknowns, num_unknowns)), np.zeros(num_unknowns)
    for two, block, own in zip(pieces, blocks, slopes, strict=True):
        places = (7 * two[:, None] + np.arange(7)).ravel()
        hessian[np.ix_(places, places)] += block + np.tril(block, -1).T
        slope[places] += own
    return float(cost) * scale**2, hessian, slope


@kernel
def _measure(residuals: Any, standing: Any, out: Any) -> None:
    """Write the residuals (k, 3) of pieces that stand as given (G,)."""
    for row in range(len(out)):
        _residual(row, residuals, standing, residuals.pieces[row, 0], residuals.pieces[row, 1], out[row])


@kernel
def _sum_squares(residuals: Any, moved: Any, index: Any, weights: Any, scale: float, sums: Any) -> float:
    """Return the Cauchy cost over scale^2, and add up its blocks (P, 14, 14), lower half, and slopes.

    Args:
        residuals, weights: (k,)
        moved: (8 G,) the pieces as they stand, then with each unknown in turn moved by `_SHIFT`.
        index: (k,) the pair of pieces of each residual, of P.
        scale: see `refine_pieces`.
        sums: the blocks and the slopes (P, 14).
    """
    (blocks, slopes), total, count = sums, 0.0, len(moved.scales) // 8
    now, there, columns = np.empty(3), np.empty(3), np.empty((3, 14))
    for row in range(len(index)):
        i, j, p = residuals.pieces[row, 0], residuals.pieces[row, 1], index[row]
        _residual(row, residuals, moved, i, j, now)
        square = (now[0] ** 2 + now[1] ** 2 + now[2] ** 2) / scale**2
        total += weights[row] * loss(CAUCHY, square)
        weight = weighed(CAUCHY, weights[row], square)
        used = 1 if np.isfinite(residuals.other_looks[row, 0]) else 3
        for k in range(14):
            step = count * (k % 7 + 1)
            first, second = (i + step, j) if k < 7 else (i, j + step)
            _residual(row, residuals, moved, first, second, there)
            for a in range(used):
                columns[a, k] = (there[a] - now[a]) / _SHIFT
        for a in range(used):
            for k in range(14):
                pull = weight * columns[a, k]
                slopes[p, k] += pull * now[a]
                for other in range(k + 1):
                    blocks[p, k, other] += pull * columns[a, other]
    return total


@inner_kernel
def _residual(row: int, residuals: Any, standing: Any, first: int, second: int, out: Any) -> None:
    """Write one residual (3,) where its pieces stand as two entries of `standing` say."""
    turn, other_turn = standing.turns[first], standing.turns[second]
    has_point = not np.isfinite(residuals.other_looks[row, 0])
    square = 0.0
    for a in range(3):
        eye, target = 0.0, 0.0
        for b in range(3):
            eye += turn[a, b] * residuals.eyes[row, b]
            target += other_turn[a, b] * residuals.targets[row, b]
        out[a] = standing.scales[second] * target + standing.middles[second, a]
        out[a] -= standing.scales[first] * eye + standing.middles[first, a]
        square += out[a] ** 2
    length = max(np.sqrt(square), _TINY)
    x, y, z = out[0] / length, out[1] / length, out[2] / length
    u, v, w = _turned(turn, residuals.looks[row])
    pixel = residuals.pixel_angles[row]
    if has_point:
        out[0], out[1], out[2] = (x - u) / pixel, (y - v) / pixel, (z - w) / pixel
        return
    p, q, r = _turned(other_turn, residuals.other_looks[row])
    plane = (y * w - z * v) ** 2 + (z * u - x * w) ** 2 + (x * v - y * u) ** 2
    other = (y * r - z * q) ** 2 + (z * p - x * r) ** 2 + (x * q - y * p) ** 2
    volume = (v * r - w * q) * x + (w * p - u * r) * y + (u * q - v * p) * z
    out[0], out[1], out[2] = volume / max(np.sqrt(min(plane, other)), 1e-12) / pixel, 0.0, 0.0


@inner_kernel
def _turned(turn: Any, x: Any) -> tuple[float, float, float]:
    return (
        turn[0, 0] * x[0] + turn[0, 1] * x[1] + turn[0, 2] * x[2],
        turn[1, 0] * x[0] + turn[1, 1] * x[1] + turn[1, 2] * x[2],
        turn[2, 0] * x[0] + turn[2, 1] * x[1] + turn[2, 2] * x[2],
    )
