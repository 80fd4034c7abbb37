"""What ties pieces together: pairs of cameras of two pieces, the turns that they suggest, their directions.

A piece is a model with a world of its own, of unknown scale, turn and place: y = s R x + t. An image that two
pieces have is a camera of each, and the two are a pair, too: they stand at one place and look the same way,
so that each sees the points of the other's piece, or its cameras where it has no points.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, distinct_pairs
from sfm_shapefit.base.geometry import mean_rotation_l1, median_spread, nearest_rotations, rotation_angles_deg
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.base.losses import GEMAN_MCCLURE, weighed
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.pairs.essential import estimate_relative_rotations
from sfm_shapefit.pairs.estimate import estimate_directions
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.pairs.relative_rotations import AGREEMENT_DEG
from sfm_shapefit.scene.matches import RayMatches

_SET_ASIDE = 5  # matches, of which one is set aside to judge by; more would weaken the join
_SIGMA_FLOOR_DEG = 0.1  # degrees added to the sigma of a turn; pieces bend by as much
_LEAST_SOUNDNESS = 0.01  # soundness of a vote whose matches fit no pose well; it counts, but hardly
# Degrees, and soundness, of the turn between two poses of one image; a pair of 50 good matches has as much.
_SHARED_SIGMA_DEG, _SHARED_SOUNDNESS = 0.1, 4.0
_MEAN_STEPS = 20  # reweightings of a mean turn; it settles in fewer
_ROUNDS = 30  # rounds in which every piece is turned anew; loops of pieces settle in fewer
_LEAST_INLIERS = 8  # inliers of a direction; fewer agree on one by chance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PieceCameras:
    """The v cameras of G pieces, each in the world of its own piece."""

    piece_of: IntArray
    """(v,) the larger a piece, the smaller its number."""
    rotations: FloatArray
    """(v, 3, 3) cam_from_piece."""
    centers: FloatArray
    """(v, 3)"""
    is_metric: BoolArray
    """(G,) pieces that know their scale, as those of rigs do; it is the same for all of them."""
    points: tuple[FloatArray, ...]
    """Points of each of the G pieces, (n, 3)."""

    @property
    def num_pieces(self) -> int:
        """Number of pieces, G."""
        return len(self.is_metric)

    def subset(self, cameras: BoolArray, piece_of: IntArray, pieces: BoolArray) -> "PieceCameras":
        """Return some cameras, of pieces with other numbers, and what is known of some pieces."""
        return PieceCameras(
            piece_of=piece_of,
            rotations=self.rotations[cameras],
            centers=self.centers[cameras],
            is_metric=self.is_metric[pieces],
            points=tuple(self.points[g] for g in np.flatnonzero(pieces)),
        )

    def centers_of(self, piece: int) -> FloatArray:
        """Return the centers of a piece's cameras."""
        return np.asarray(self.centers[self.piece_of == piece])

    def sizes(self) -> FloatArray:
        """Return the spreads of the pieces' cameras, (G,), in units of each."""
        return np.array([median_spread(self.centers_of(g)) or 1.0 for g in range(self.num_pieces)])

    def middles(self) -> FloatArray:
        """Return the mean centers of the pieces' cameras, (G, 3)."""
        return np.stack([self.centers_of(g).mean(axis=0) for g in range(self.num_pieces)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PieceTies:
    """The matches of k pairs of cameras of two pieces each, M in all."""

    matches: RayMatches
    """Pairs of cameras v; rays in axes of the cameras."""
    points: FloatArray
    """(M, 2, 3) the points that the two keypoints observe, each in the world of its piece; NaN for none."""
    is_shared: BoolArray
    """(k,) pairs whose cameras are one image."""

    @property
    def num_pairs(self) -> int:
        """Number of pairs, k."""
        return len(self.matches.pairs)

    @property
    def pair_of(self) -> IntArray:
        """Pair of each match, (M,)."""
        return self.matches.list_of_rows()

    def subset(self, pairs: IntArray | BoolArray) -> "PieceTies":
        """Return some of the pairs."""
        chosen = np.arange(self.num_pairs)[pairs]
        rows = self.matches.rows_of(chosen).rows
        return PieceTies(
            matches=self.matches.rays_of(chosen), points=self.points[rows], is_shared=self.is_shared[chosen]
        )

    def renumbered(self, cameras: IntArray) -> "PieceTies":
        """Return the same ties with other numbers (v,) of the cameras."""
        return replace(self, matches=replace(self.matches, pairs=cameras[self.matches.pairs]))

    def split(self) -> "tuple[PieceTies, PieceTies]":
        """Return the matches to place pieces by, and every fifth of a pair's, which are set aside."""
        aside = self.matches.ranks() % _SET_ASIDE == _SET_ASIDE - 1
        return self._of_matches(~aside), self._of_matches(aside)

    def _of_matches(self, kept: BoolArray) -> "PieceTies":
        counts = np.bincount(self.pair_of[kept], minlength=self.num_pairs)
        matches = replace(
            self.matches,
            offsets=offsets_of(counts),
            rays_i=self.matches.rays_i[kept],
            rays_j=self.matches.rays_j[kept],
        )
        return replace(self, matches=matches, points=self.points[kept])


class Votes(NamedTuple):
    """The turns that single pairs suggest between the two pieces of theirs."""

    pieces: IntArray
    """(k, 2)"""
    turns: FloatArray
    """(k, 3, 3) first_from_second; NaN where a pair suggests none."""
    sigmas_deg: FloatArray
    """(k,)"""
    soundness: FloatArray
    """(k,) how well one pose explains the matches of the pair."""


def collect_votes(cameras: PieceCameras, ties: PieceTies) -> Votes:
    """Return the turns that pairs suggest, by their relative rotations or as the poses of one image."""
    i, j = ties.matches.pairs.T
    k = ties.num_pairs
    between = np.where(ties.is_shared[:, None, None], np.eye(3), np.nan)
    sigmas = np.full(k, _SHARED_SIGMA_DEG)
    soundness = np.full(k, _SHARED_SOUNDNESS)
    apart = np.flatnonzero(~ties.is_shared)
    numbered = replace(ties.matches.rays_of(apart), pairs=_numbered(len(apart)))
    estimated = estimate_relative_rotations(numbered)
    rows = apart[estimated.pairs[:, 0] // 2]
    between[rows] = estimated.rotations
    least = np.maximum(np.linalg.eigvalsh(estimated.information)[:, 0], 1e-9) if len(rows) else np.ones(0)
    sigmas[rows] = np.minimum(np.degrees(least**-0.5), 90.0)
    believed = estimated.weight_shares * np.log(np.maximum(estimated.num_matches, 1))
    soundness[rows] = np.where(
        estimated.are_sound(0.0), np.maximum(believed, _LEAST_SOUNDNESS), _LEAST_SOUNDNESS
    )
    turns = cameras.rotations[i].transpose(0, 2, 1) @ between.transpose(0, 2, 1) @ cameras.rotations[j]
    return Votes(cameras.piece_of[[i, j]].T, turns, sigmas, soundness)


def turn_pieces(votes: Votes, num_pieces: int) -> FloatArray:
    """Return world_from_piece (G, 3, 3) with piece 0 as the world; NaN for pieces that no vote reaches.

    Between two pieces the turn counts that most pairs agree with: an L1 mean follows wrong pairs where they
    are the most, and between real pieces 50 to 80 % of them are. Then a tree of the best supported turns, and
    rounds of means in which each piece hears all others.
    """
    has_turn = np.asarray(np.isfinite(votes.turns).all(axis=(1, 2)))
    elected = list(_elect(votes, has_turn))
    turns = np.full((num_pieces, 3, 3), np.nan)
    turns[0] = np.eye(3)
    reached = {0}
    while True:
        open_ends = [one for one in elected if (one[1] in reached) != (one[2] in reached)]
        if not open_ends:
            break
        _, first, second, turn = max(open_ends, key=lambda one: one[0])
        if first in reached:
            turns[second] = turns[first] @ turn
        else:
            turns[first] = turns[second] @ turn.T
        reached |= {first, second}
    for _ in range(_ROUNDS if len(reached) > 2 else 0):
        for piece in sorted(reached - {0}):
            turns[piece] = _hear(votes, turns, piece)
    return turns


def _elect(votes: Votes, has_turn: BoolArray) -> Iterator[tuple[float, int, int, FloatArray]]:
    """Yield, of every two pieces with votes, the support of the turn that most agree with, and the turn."""
    for first, second in distinct_pairs(votes.pieces[has_turn]).tolist():
        rows = np.flatnonzero(has_turn & (votes.pieces == [first, second]).all(axis=1))
        turns, sigmas, soundness = votes.turns[rows], votes.sigmas_deg[rows], votes.soundness[rows]
        near = rotation_angles_deg(turns[:, None].transpose(0, 1, 3, 2) @ turns[None]) <= AGREEMENT_DEG
        support = near @ (soundness / np.hypot(sigmas, 1.0))
        chosen = int(np.argmax(support))
        turn = mean_rotation_l1(turns[near[chosen]])
        for _ in range(_MEAN_STEPS):
            turn = _mean(turns, sigmas, soundness, turn)
        yield float(support[chosen]), first, second, turn


def _mean(turns: FloatArray, sigmas_deg: FloatArray, soundness: FloatArray, near: FloatArray) -> FloatArray:
    """Return the mean of turns (k, 3, 3), in which those far from one hardly count."""
    off = rotation_angles_deg(turns @ near.T) / (2.0 * np.hypot(sigmas_deg, 3.0 * _SIGMA_FLOOR_DEG))
    weights = weighed(GEMAN_MCCLURE, soundness / np.hypot(sigmas_deg, _SIGMA_FLOOR_DEG) ** 2, off**2)
    return nearest_rotations((weights[:, None, None] * turns).sum(axis=0))


def _hear(votes: Votes, turns: FloatArray, piece: int) -> FloatArray:
    """Return the turn of a piece by the votes of all pairs with pieces that have one."""
    others = turns[votes.pieces[:, ::-1]]
    is_own = votes.pieces == piece
    heard = np.where(is_own[:, 1, None, None], others[:, 1] @ votes.turns, np.nan)
    back = others[:, 0] @ votes.turns.transpose(0, 2, 1)
    heard = np.where(is_own[:, 0, None, None], back, heard)
    rows = np.isfinite(heard).all(axis=(1, 2))
    return _mean(heard[rows], votes.sigmas_deg[rows], votes.soundness[rows], turns[piece])


def direct_ties(cameras: PieceCameras, ties: PieceTies, turns: FloatArray) -> PairDirections:
    """Return the directions of pairs under turns of their pieces; shared images have none."""
    i, j = ties.matches.pairs.T
    world = cameras.rotations @ turns[cameras.piece_of].transpose(0, 2, 1)
    matches, pair_of = ties.matches, ties.pair_of
    turned = replace(
        matches,
        pairs=_numbered(ties.num_pairs),
        rays_i=np.einsum("mk,mkl->ml", matches.rays_i, world[i][pair_of]),
        rays_j=np.einsum("mk,mkl->ml", matches.rays_j, world[j][pair_of]),
    )
    return estimate_directions(turned, DirectionOptions(min_inliers=_LEAST_INLIERS))


def _numbered(count: int) -> IntArray:
    """Return pairs of cameras of which each is in one pair alone, so that none is merged with another."""
    return np.arange(2 * count).reshape(-1, 2)
