"""Gravity as a term of rotation averaging: each measured direction fixes two degrees of freedom of a camera.

The world is a further node W, with rotation R_W to axes whose z points up. Gravity g_i in axes of camera i
says that R_W R_i^T takes g_i to d = (0, 0, -1): a pair (i, W) whose relative rotation is known up to a turn
about d,

    M_i = argmin { angle(M, R_W R_i^T) : M g_i = d },        information (I - d d^T) / sigma_i^2.

Its residual is the smallest turn that would bring the gravity down, M_i is found anew in each round, and all
else is a round with the full information (`rotations.annealing`): a Laplacian system, and the loss of Geman
and McClure.

W starts where most gravities put it, at the rotations that the pairs alone give. Pairs that contradict these
by more than 5 degrees have no part. Gravities may be off by more, because chains of pairs drift.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.geometry import angle_between, normalized
from sfm_shapefit.pairs.relative_rotations import AGREEMENT_DEG, RelativeRotations
from sfm_shapefit.rotations.annealing import (
    LAST_REDUCTION,
    LONGEST_STEP,
    SCALE_OF_MEDIAN,
    SETTLED,
    AveragingPairs,
    Linearized,
)
from sfm_shapefit.rotations.average import check_pairs
from sfm_shapefit.rotations.averaged import AveragedRotations
from sfm_shapefit.rotations.averaging_kernels import turn_cameras, weigh_blocks
from sfm_shapefit.rotations.averaging_system import AveragingSystem, plan_system
from sfm_shapefit.rotations.averaging_uncertainty import MOST_LEVERAGE, estimate_sigmas, residual_variance
from sfm_shapefit.scene.given import Gravity

DOWN = np.array([0.0, 0.0, -1.0])
"""Direction of gravity in world axes: z points up."""

_VOTING = np.radians(10.0)  # radians; gravities within this say the same of the world in the beginning
_LIMIT = np.radians(45.0)  # radians; a gravity that is farther off has no part
_ROUNDS = 60  # rounds, a bound; each leaves about half of the way to where cameras settle
_ABOUT_DOWN = 1e-9  # share of the information; about the axis gravity has none, and blocks stay definite
_WRONG_SIGMAS = 5.0  # own standard deviations, or levels of all; a gravity beyond is wrong
_MEDIAN_LENGTH = 1.1774  # median length of two normal components; sqrt(2 ln 2)
FEWEST_GRAVITIES = 2  # gravities; a single one has nothing to check it


def down_of(rotations: FloatArray, gravity: Gravity) -> FloatArray:
    """Return the direction (3,) in the world that most gravities of cameras (n, 3, 3) agree on."""
    down = normalized(np.einsum("kba,kb->ka", rotations[gravity.indices], gravity.directions))
    votes = np.array([np.sum(np.maximum(0.0, 1.0 - angle_between(down, one) / _VOTING)) for one in down])
    best = np.asarray(down[int(np.argmax(votes))])
    spread = np.maximum(gravity.sigmas, np.median(gravity.sigmas))
    for _ in range(20):
        off = angle_between(down, best)
        scale = SCALE_OF_MEDIAN * np.maximum(spread, _level(off))
        best = normalized(down.T @ (1.0 / (spread * (1.0 + (off / scale) ** 2)) ** 2))
    return np.asarray(best)


def turn_upright(down: FloatArray) -> FloatArray:
    """Return the smallest turn (3, 3) of the world that brings a direction to where gravity points."""
    return np.asarray(_shortest_turns(down[None], DOWN)[0].as_matrix())


def judge_gravity(rotations: FloatArray, gravity: Gravity) -> tuple[FloatArray, BoolArray]:
    """Return how far gravities are off an upright world's, in radians, and which of them are wrong, (k,)."""
    off = angle_between(np.einsum("kba,kb->ka", rotations[gravity.indices], gravity.directions), DOWN)
    return off, np.asarray(off > _WRONG_SIGMAS * np.maximum(gravity.sigmas, _level(off)))


def _level(off: FloatArray) -> float:
    """Return the standard deviation that angles (k,) show where most are near; 0 where none is near.

    None is near the middle of gravities that are all as inexact as 40 degrees; their own standard deviations
    say enough then.
    """
    near = off <= _VOTING
    return float(np.median(off[near])) / _MEDIAN_LENGTH if near.any() else 0.0


def refine_with_gravity(
    averaged: AveragedRotations, relative: RelativeRotations, gravity: Gravity
) -> AveragedRotations:
    """Return averaged rotations refined on pairs and gravities together, in a world whose z points up.

    Args:
        averaged: rotations of n images, by the pairs alone.
        relative: the pairs, among these images.
        gravity: gravities of images that have a rotation; with fewer than two `averaged` is returned.
    """
    members = np.flatnonzero(averaged.registered).astype(np.int64)
    gravities = gravity.of(members)
    if len(gravities.indices) < FEWEST_GRAVITIES:
        return averaged
    supports = relative.weight_shares * relative.num_matches
    given = check_pairs(
        relative.pairs, relative.rotations, relative.information, supports, len(averaged.registered)
    )
    upright = averaged.rotations @ turn_upright(down_of(averaged.rotations[members], gravities)).T
    inside: BoolArray = np.asarray(averaged.registered[given.pairs].all(axis=1))
    inner = given.subset(inside)
    pairs = np.ascontiguousarray(np.searchsorted(members, inner.pairs))
    refined = _refine(upright[members], replace(inner, num_cameras=len(members), pairs=pairs), gravities)
    rotations, sigmas = averaged.rotations.copy(), averaged.sigmas_deg.copy()
    to_world = Rotation.from_quat(refined.turns[:-1]) * Rotation.from_quat(refined.turns[-1]).inv()
    rotations[members] = to_world.as_matrix()
    sigmas[members] = np.degrees(_sigmas_of_cameras(refined))
    return replace(averaged, rotations=rotations, sigmas_deg=sigmas, certified=None)


class _Refined(NamedTuple):
    """The end of the rounds: all cameras, then the world."""

    turns: FloatArray
    """(n + 1, 4)"""
    last: Linearized
    graph: AveragingPairs
    system: AveragingSystem


def _sigmas_of_cameras(refined: "_Refined") -> FloatArray:
    """Return the standard deviations of the cameras per axis, in radians, (n,), relative to their mean turn.

    The world has no part in that mean: how it is turned about gravity nothing says. It becomes the first
    node, since the system is grounded at the last one, and all is known relative to a camera.
    """
    n = refined.graph.num_cameras
    pairs = np.ascontiguousarray(np.sort((refined.graph.pairs + 1) % n, axis=1))
    system = plan_system(n, pairs, np.sqrt(refined.graph.supports), refined.system.threads)
    is_camera = np.arange(n) > 0
    return estimate_sigmas(replace(refined.graph, pairs=pairs), system, refined.last, is_camera)[1:]


def _refine(upright: FloatArray, given: AveragingPairs, gravity: Gravity) -> _Refined:
    """Return the rotations of cameras (n, 3, 3) and of the world after rounds on pairs and gravities."""
    turns = np.ascontiguousarray(Rotation.from_matrix(upright).as_quat())
    graph = _join_world(given, turns, gravity)
    turns = np.concatenate([turns, [[0.0, 0.0, 0.0, 1.0]]])
    system = plan_system(graph.num_cameras, graph.pairs, np.sqrt(graph.supports), 1)
    k, m = len(graph.pairs), len(gravity.indices)
    distances, blocks, pulls = np.empty(k), np.empty((k, 3, 3)), np.empty((k, 3))

    def weigh(scale: float) -> float:
        graph.measured[k - m :] = _follow(turns, gravity)
        system.over_pairs(
            weigh_blocks, graph.pairs, graph.measured, turns, graph.information, float(_LIMIT), scale,
            distances, blocks, pulls,
        )  # fmt: skip
        inside = distances[: k - m][~np.isnan(distances[: k - m])]
        median = float(np.median(inside)) if len(inside) else 1.0
        return SCALE_OF_MEDIAN * max(median, 1.0)

    scale = weigh(weigh(SCALE_OF_MEDIAN))
    for _ in range(_ROUNDS):
        steps = system.solve_blocks(blocks, system.gradient_of(pulls), LAST_REDUCTION)
        turned = turn_cameras(turns, steps, LONGEST_STEP)
        scale = weigh(scale)
        if turned <= SETTLED:
            break
    return _Refined(turns, Linearized(blocks, distances), graph, system)


def _join_world(given: AveragingPairs, turns: FloatArray, gravity: Gravity) -> AveragingPairs:
    """Return the pairs that agree with rotations (n, 4), and those of the gravities with the world, node n.

    The information of pairs is divided by what their residuals exceed it by, as `averaging_uncertainty` has
    it, lest pairs that state too much outweigh the gravities; it is never multiplied.
    """
    n, k, m = given.num_cameras, len(given.pairs), len(gravity.indices)
    distances, limit = np.empty(k), float(np.radians(AGREEMENT_DEG))
    weigh_blocks(
        0, k, given.pairs, given.measured, turns, given.information, limit, 1.0, distances,
        np.empty((k, 3, 3)), np.empty((k, 3)),
    )  # fmt: skip
    agreeing = given.subset(~np.isnan(distances))
    # On average, of a connected graph.
    leverage = min((n - 1) / max(len(agreeing.pairs), 1), MOST_LEVERAGE)
    excess = max(1.0, residual_variance(distances, np.full(k, leverage)))
    # What gravity does not say, of the axis along it, keeps the blocks definite.
    across = np.eye(3) - (1.0 - _ABOUT_DOWN) * np.outer(DOWN, DOWN)
    return AveragingPairs(
        num_cameras=n + 1,
        pairs=np.concatenate([agreeing.pairs, np.column_stack([gravity.indices, np.full(m, n)])]),
        measured=np.concatenate([agreeing.measured, np.zeros((m, 4))]),
        information=np.concatenate(
            [agreeing.information / excess, across / gravity.sigmas[:, None, None] ** 2]
        ),
        supports=np.concatenate([agreeing.supports, np.full(m, float(np.median(given.supports)))]),
    )


def _follow(turns: FloatArray, gravity: Gravity) -> FloatArray:
    """Return M_i (k, 4): R_W R_i^T after the smallest turn that takes the gravity down."""
    world = Rotation.from_quat(turns[-1]) * Rotation.from_quat(turns[gravity.indices]).inv()
    return np.asarray((_shortest_turns(world.apply(gravity.directions), DOWN) * world).as_quat())


def _shortest_turns(sources: FloatArray, target: FloatArray) -> Rotation:
    """Return the smallest rotations that take unit vectors (k, 3) to one."""
    axes = np.cross(sources, target)
    sines = np.linalg.norm(axes, axis=1)
    opposite = sines < 1e-12
    axes[opposite] = np.cross(target, np.eye(3)[int(np.argmin(np.abs(target)))])
    angles = angle_between(sources, np.broadcast_to(target, sources.shape))
    return Rotation.from_rotvec(angles[:, None] * normalized(axes))
