"""Which cameras' rotations the matches improve: joint refinement, and evidence camera by camera.

`joint_refinement` refines all rotations and centers together on all matches. Its minimum can be wrong and
sure of itself: matches of one pair share their errors (calibration, repeated structure), so that a thousand
of them are not a thousand witnesses. The unit of evidence is therefore the pair. For camera i let

    w_i        how far it turned; the level is what such turns are like, from their median, at least 0.3 deg
    kept_p     cost of its pair p with the given rotation of i, and the center of i placed anew
    refined_p  cost of the pair with the refined one; the other cameras refined in both.

If each pair counts as nu = 2 independent residuals of unknown variance, the refined rotation is likelier by
sum_p log(kept_p / refined_p); a prior with Cauchy tails asks 2 log(1 + |w_i|^2 / level^2) for the turn. The
camera takes its refined rotation if the evidence exceeds that, most of its pairs gain, and it has enough
pairs and information; else it keeps the given one exactly, and the others are refined again around it.

Rotations from bundle adjustment are as good as these matches allow; refined without points, they would get a
little worse. They show in the pairs all together. With every rotation as given, and the centers alone placed
anew, the cost of the median pair is higher than refined by a factor of 0.996 to 1.004 after bundle adjustment
of five Strecha scenes, and of 1.06 to 1.6 after rotation averaging. Below 1.02 a camera has to show evidence
for each of its three parameters. The floor of the level, nu, the share of pairs that must gain and this
factor were chosen on these scenes, against their truth.

Source of the ratio: the likelihood of normal residuals of unknown variance, maximized over it, is
proportional to (sum of squares)^(-nu / 2).
"""

from dataclasses import dataclass

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray
from sfm_shapefit.directions.matches import RayMatches
from sfm_shapefit.geometry import MEDIAN_NORMAL_LENGTH, mean_rotation_l1, median_spread
from sfm_shapefit.rotations.joint_refinement import (
    NormalEquations,
    State,
    TurnPrior,
    at_state,
    camera_blocks,
    minimize,
    normal_equations,
    turn_vectors,
)

# The scales of the Cauchy loss, one after the other.
_SCALES_PX = (8.0, 3.0, 1.0)
_FINAL_PX = _SCALES_PX[-1]
# The level of the prior before anything is known of the turns, and at least: averaged rotations are off by
# the latter, most cameras by less, a few by more.
_FIRST_LEVEL_RAD, _LEAST_LEVEL_RAD = np.radians(1.0), np.radians(0.3)
# Residuals below this are as good as any; it keeps the ratios of exact matches sober.
_FLOOR_PX = 0.05
_MIN_PAIRS = 3
_MIN_GAINING_SHARE = 2.0 / 3.0
# Rotations are good already if the median pair gains less than this, as a logarithm of its costs. A turn is
# then asked for so much evidence: one for each parameter.
_GOOD_GAIN, _ASKED_OF_GOOD = 0.02, 3.0
_CENTER_STEPS = 12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RotationRefinement:
    """Rotations in world axes that improve the given ones, camera by camera."""

    turns: FloatArray
    """(n, 3, 3) refined ray = turn @ given ray; exactly the identity where the given rotation stays."""
    centers: FloatArray
    """(n, 3) centers that were refined with them; shift free, median spread about 1."""
    updated: BoolArray
    """(n,) which cameras take a refined rotation."""
    angles_deg: FloatArray
    """(n,) by how much; 0 where the given rotation stays."""
    evidence: FloatArray
    """(n,) log-likelihood gained less what the prior asks; above 0 for every updated camera, and above 3
    where the given rotations are good already."""


def refine_rotations(
    matches: RayMatches, centers: FloatArray, turns: FloatArray | None = None
) -> RotationRefinement:
    """Refine rotations and centers on the matches, and accept per camera what they give evidence for.

    Args:
        matches: the matches of k pairs of the n cameras, as the given rotations place their rays.
        centers: (n, 3) centers to start from, from the given rotations or refined ones.
        turns: (n, 3, 3) where to start, refined = turns @ given, from an earlier refinement: only the
            narrowest loss is used then. The identity if None. The prior stays at the given rotations.
    """
    n = len(centers)
    start = np.tile(np.eye(3), (n, 1, 1)) if turns is None else turns
    state = State(start, centers / median_spread(centers))
    prior = TurnPrior(float(_FIRST_LEVEL_RAD), np.ones(n, dtype=np.bool_))
    for scale_px in _SCALES_PX if turns is None else _SCALES_PX[-1:]:
        state = _remove_common_turn(minimize(matches, state, scale_px, prior))
    prior = prior._replace(level=_level(state.turns))
    state = _remove_common_turn(minimize(matches, state, _FINAL_PX, prior))
    evidence, updated = _judge(matches, state, prior.level)
    if _median_gain(matches, state, prior) < _GOOD_GAIN:
        updated &= evidence > _ASKED_OF_GOOD
    kept = np.where(updated[:, None, None], state.turns, np.eye(3))
    state = minimize(matches, State(kept, state.centers), _FINAL_PX, prior._replace(free=updated))
    angles = np.degrees(np.linalg.norm(turn_vectors(state.turns), axis=1))
    return RotationRefinement(
        turns=np.where(updated[:, None, None], state.turns, np.eye(3)),
        centers=state.centers,
        updated=updated,
        angles_deg=np.where(updated, angles, 0.0),
        evidence=evidence,
    )


def _remove_common_turn(state: State) -> State:
    """Return the same state seen in axes in which the cameras' mean turn is none."""
    common = mean_rotation_l1(state.turns)
    return State(np.ascontiguousarray(common.T @ state.turns), state.centers @ common)


def _level(turns: FloatArray) -> float:
    """Return the standard deviation per axis, in radians, that the turns speak of."""
    lengths = np.linalg.norm(turn_vectors(turns), axis=1)
    return float(max(np.median(lengths) / MEDIAN_NORMAL_LENGTH, _LEAST_LEVEL_RAD))


def _judge(matches: RayMatches, state: State, level: float) -> tuple[FloatArray, BoolArray]:
    """Return each camera's evidence (n,) and whether its refined rotation is to be believed."""
    n, pairs = len(state.centers), matches.pairs
    refined = at_state(matches, state, _FINAL_PX)
    camera = pairs.T.ravel()
    gained = np.concatenate([_gains(matches, kept, refined.costs) for kept in _kept_costs(matches, state)])
    degree = np.bincount(camera, minlength=n)
    gaining = np.bincount(camera[gained > 0.0], minlength=n)
    asked = 2.0 * np.log1p(np.sum(turn_vectors(state.turns) ** 2, axis=1) / level**2)
    evidence = np.bincount(camera, weights=gained, minlength=n) - asked
    informed = _rotation_sigmas(refined, matches, n) <= level
    enough = (degree >= _MIN_PAIRS) & (gaining >= _MIN_GAINING_SHARE * degree)
    updated: BoolArray = enough & informed & (evidence > 0.0)
    return evidence, updated


def _gains(matches: RayMatches, kept: FloatArray, refined: FloatArray) -> FloatArray:
    """Return log(kept / refined) of the costs of each pair, (k,), sober where both are next to nothing."""
    floor = 0.5 * _FLOOR_PX**2 * np.diff(matches.offsets)
    return np.asarray(np.log((kept + floor) / (refined + floor)))


def _median_gain(matches: RayMatches, state: State, prior: TurnPrior) -> float:
    """Return what the median pair gains over all given rotations, with centers placed for those."""
    n = len(state.centers)
    given = State(np.tile(np.eye(3), (n, 1, 1)), state.centers)
    placed = minimize(matches, given, _FINAL_PX, prior._replace(free=np.zeros(n, dtype=np.bool_)))
    kept, refined = (at_state(matches, one, _FINAL_PX).costs for one in (placed, state))
    return float(np.median(_gains(matches, kept, refined)))


def _rotation_sigmas(normal: NormalEquations, matches: RayMatches, num_cameras: int) -> FloatArray:
    """Return (n,) each camera's least certain standard deviation in radians at 1 px, the others held."""
    blocks = camera_blocks(normal, matches.pairs, num_cameras)[0]
    ridge = 1e-12 * float(blocks[:, range(3, 6), range(3, 6)].max())  # a camera may have no pair
    solved = np.linalg.solve(blocks[:, 3:, 3:] + ridge * np.eye(3), blocks[:, 3:, :3])
    information = np.linalg.eigvalsh(blocks[:, :3, :3] - blocks[:, :3, 3:] @ solved)[:, 0]
    return np.asarray(1.0 / np.sqrt(np.maximum(information, 1e-300)))


def _kept_costs(matches: RayMatches, state: State) -> tuple[FloatArray, FloatArray]:
    """Return the costs (k,) of all pairs with camera i, and with camera j, at its given rotation.

    The center of that camera alone is placed anew, by damped Newton steps for all cameras at once.
    """
    n, (i, j) = len(state.centers), matches.pairs.T
    given = np.tile(np.eye(3), (n, 1, 1))

    def both(centers: FloatArray) -> tuple[NormalEquations, NormalEquations]:
        keeping_i, keeping_j = (given[i], state.turns[j]), (state.turns[i], given[j])
        return (
            normal_equations(matches, keeping_i, centers[i] - state.centers[j], _FINAL_PX),
            normal_equations(matches, keeping_j, state.centers[i] - centers[j], _FINAL_PX),
        )

    def total(normals: tuple[NormalEquations, NormalEquations]) -> FloatArray:
        costs = (np.bincount(end, one.costs, n) for end, one in zip((i, j), normals, strict=True))
        return np.asarray(sum(costs))

    centers, damping = state.centers, np.full(n, 1e-3)
    found = both(centers)
    for _ in range(_CENTER_STEPS):
        candidate = centers - _center_steps(found, matches, damping)
        new = both(candidate)
        better = total(new) <= total(found)
        centers = np.where(better[:, None], candidate, centers)
        damping = np.where(better, damping / 10.0, damping * 10.0)
        found = (_choose_rows(better[i], new[0], found[0]), _choose_rows(better[j], new[1], found[1]))
    return found[0].costs, found[1].costs


def _choose_rows(rows: BoolArray, new: NormalEquations, old: NormalEquations) -> NormalEquations:
    """Return the new equations of some pairs (k,) and the old ones of the others."""
    shapes = rows[:, None, None], rows[:, None], rows
    return NormalEquations(*map(np.where, shapes, new, old))


def _center_steps(
    normals: tuple[NormalEquations, NormalEquations], matches: RayMatches, damping: FloatArray
) -> FloatArray:
    """Return the damped Newton step (n, 3) of each center with all others held."""
    n = len(damping)
    hessian, gradient = np.zeros((n, 3, 3)), np.zeros((n, 3))
    for end, sign, normal in zip(matches.pairs.T, (1.0, -1.0), normals, strict=True):
        np.add.at(hessian, end, normal.matrices[:, 6:, 6:])
        np.add.at(gradient, end, sign * normal.vectors[:, 6:])
    size = hessian[:, range(3), range(3)].max(axis=1)
    hessian += (damping * np.maximum(size, 1e-12 * size.max()))[:, None, None] * np.eye(3)
    return np.asarray(np.linalg.solve(hessian, gradient[:, :, None])[:, :, 0])
