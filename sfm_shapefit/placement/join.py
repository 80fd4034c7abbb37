"""Pieces joined where evidence that the join did not use speaks for it; else refused, with the reason.

    votes       the turn between two pieces that most of their pairs agree on
    program     scales and places of all pieces at once, over directions and rays to points
    refinement  all seven unknowns of each, by the rays
    judge       pairs that agree: most of their matches that were set aside fit within a few pixels
    rivals      whether pairs that do not agree do so among themselves on another join
    points      whether, at one of two joins, points of the one piece stand where the other has its own

Shares of matches do not tell right joins from wrong ones: the matches of a wrong pair agree with the place
that its other matches made. Other pairs do, so that three are asked for, not all of one image, which may be
taken for another wherever it is matched; an image that both pieces have counts as two, for it knows its turn
and its place.

Pairs that agree on a false place, as houses that look the same make them, may be more than the right ones.
What neither join has used are the points of no pair that agrees with either: where two pieces show one
surface, hundreds of these coincide at the right join, and at a wrong one about ten. Where they speak for one
of two joins it is taken, and the pairs of the other are named; they tell even against a join with which all
pairs agree but one. Where they do not, and as many as a quarter of the pairs that agree do so on another
join, nothing says which is right, and these pairs count for neither; a piece may still be joined by its pairs
with a third one.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, distinct_pairs
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.base.geometry import Similarity, compose, invert, rotation_angles_deg
from sfm_shapefit.base.wording import counted
from sfm_shapefit.pairs.relative_rotations import AGREEMENT_DEG
from sfm_shapefit.placement.coinciding import count_coinciding
from sfm_shapefit.placement.piece_program import (
    Standing,
    misses_px,
    refine_pieces,
    residuals_of,
    solve_pieces,
)
from sfm_shapefit.placement.piece_ties import (
    PieceCameras,
    PieceTies,
    Votes,
    collect_votes,
    direct_ties,
    turn_pieces,
)
from sfm_shapefit.solver.solver_options import SolverResult

FEWEST_PAIRS = 3
"""Agreeing pairs that a join needs; a wrong one has two by chance, and two leave nothing to check it by."""
_SHARED = 2  # pairs; an image that both pieces have knows its turn and its place
_MOST_TURNS = 4  # turns between two pieces that are tried; bounds the time where single votes scatter
_MOST_ALONE = 10  # pairs by each of which alone two pieces are placed; bounds the time where few are right
_RIVAL_SHARE = 0.25  # share of the agreeing pairs; from as many rivals on nothing says which join is right
_FEWEST_RIVALS = 2  # pairs that agree on another join, and are named; one always agrees with itself
_FEWEST_POINTS, _CLEARLY = 20, 3.0
"""Coinciding points that speak for a join: so many more than of another, and that many times as many."""
AGREEING_PX = 4.0
"""Pixels by which a match may miss; pieces bend by as much, and wrong pairs miss by hundreds."""
_LARGEST_SCALE_SIGMA = 0.03  # relative; above, joins come out wrong
_LARGEST_TURN_SIGMA_DEG = 3.0  # degrees; above, the join is refused
_LARGEST_CENTER_SIGMA = 0.1  # sizes of the piece; above, the join is refused
UNTIED = "no pair of images ties it to another"
"""Why a piece is not joined of which nothing is known."""


def _none() -> IntArray:
    return np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PieceJoin:
    """How a piece stands in the world of another, and how surely."""

    piece: int
    to: int
    """The piece whose world it is."""
    to_from_piece: Similarity
    scale_sigma: float
    """Relative standard deviation of its scale."""
    turn_sigma_deg: float
    center_sigma: float
    """Standard deviation of the middle of its cameras, in units of the other piece."""
    agreeing: IntArray = field(default_factory=_none)
    """Pairs, rows of the ties, between it and the other pieces in that world that agree with it."""
    contradicting: IntArray = field(default_factory=_none)
    """Pairs between it and these that do not agree."""
    rivals: IntArray = field(default_factory=_none)
    """Pairs among these that agree on another join."""
    solved: SolverResult | None = None
    """The last solve of the convex program over all pieces that were placed with it; None without one."""
    evidence: str = ""
    """What it rests on, in words."""
    reason: str = ""
    """Why it is refused, a clause; nothing if it is not."""


def uncertainty(scale_sigma: float, turn_sigma_deg: float, center_sigma: float) -> str:
    """Say what of a join is too uncertain, a clause; nothing if it is known well enough.

    The standard deviations are those of the scale, relative, of the turn, and of the place in sizes of the
    piece.
    """
    if scale_sigma > _LARGEST_SCALE_SIGMA:
        return f"the scale between them is known to {scale_sigma:.0%} only"
    if turn_sigma_deg > _LARGEST_TURN_SIGMA_DEG:
        return f"the turn between them is known to {turn_sigma_deg:.2g} deg only"
    if center_sigma > _LARGEST_CENTER_SIGMA:
        return f"where one is beside the other is known to {center_sigma:.0%} of its size only"
    return ""


def join_pieces(cameras: PieceCameras, ties: PieceTies) -> dict[int, PieceJoin | str]:
    """Return what comes of joining each piece but the first to an earlier one.

    A join may be refused; where there was none to judge, the reason stands in its place.
    """
    whole = _Evidence.of(cameras, ties)
    outcomes: dict[int, PieceJoin | str] = {}
    waiting = np.arange(cameras.num_pieces)
    while len(waiting) > 1:
        rest = waiting[1:]
        grown = dict(_grow(whole.part(waiting)))
        accepted = [k for k, join in grown.items() if isinstance(join, PieceJoin) and not join.reason]
        for k in rest.tolist():
            if k in accepted or k not in outcomes or outcomes[k] == UNTIED:
                outcomes[k] = grown.get(k, UNTIED)
        waiting = np.setdiff1d(rest, accepted)
    return outcomes


class _Evidence(NamedTuple):
    """Ties between pieces in two parts, to place by and to judge by, and the turns that they vote for."""

    cameras: PieceCameras
    ties: PieceTies
    aside: PieceTies
    votes: Votes
    numbers: IntArray
    """Numbers of the pieces among all."""
    rows: IntArray
    """Numbers of the pairs among all."""

    @classmethod
    def of(cls, cameras: PieceCameras, ties: PieceTies) -> "_Evidence":
        """Set matches aside, and collect the votes of the others."""
        used, aside = ties.split()
        votes = collect_votes(cameras, used)
        return cls(cameras, used, aside, votes, np.arange(cameras.num_pieces), np.arange(ties.num_pairs))

    @property
    def pieces(self) -> IntArray:
        """Pieces of each pair, (k, 2)."""
        return self.votes.pieces

    def touches(self, number: int) -> bool:
        """Return whether a pair ties a piece, by its number among all, to the first."""
        return bool((self.numbers[self.pieces] == [self.numbers[0], number]).all(axis=1).any())

    def weigh(self, agreeing: BoolArray) -> int:
        """Return what agreeing pairs (k,) of two pieces count: all that have one image in common, one."""
        chosen = np.flatnonzero(agreeing)
        shared = self.ties.is_shared[chosen]
        ends = self.ties.matches.pairs[chosen]
        has_one = len(ends) > 0 and bool((ends == ends[0]).all(axis=0).any())
        return int(np.sum(np.where(shared, _SHARED, 1))) if not has_one or shared.any() else 1

    def coinciding(self, two: IntArray, pairs: BoolArray, *joins: Similarity) -> list[int]:
        """Return how many points of two pieces coincide by each join, without those that pairs (k,) match."""
        first, second = (
            _without(
                self.cameras.points[piece],
                *(part.points[pairs[part.pair_of], way] for part in (self.ties, self.aside)),
            )
            for way, piece in enumerate(two.tolist())
        )
        return [count_coinciding(first, second, one) for one in joins]

    def part(self, pieces: IntArray, chosen: BoolArray | None = None) -> "_Evidence":
        """Return some pieces, by their numbers among all, and their pairs, or the chosen ones (k,)."""
        here = np.isin(self.numbers, pieces)
        cameras = here[self.cameras.piece_of]
        new, camera_of = np.cumsum(here) - 1, np.cumsum(cameras) - 1
        kept = np.asarray(here[self.pieces].all(axis=1) & (True if chosen is None else chosen))
        turns, *known = (column[kept] for column in self.votes[1:])
        votes = Votes(new[self.pieces[kept]], turns, *known)
        return _Evidence(
            self.cameras.subset(cameras, new[self.cameras.piece_of[cameras]], here),
            self.ties.subset(kept).renumbered(camera_of),
            self.aside.subset(kept).renumbered(camera_of),
            votes,
            self.numbers[here],
            self.rows[kept],
        )


def _without(points: FloatArray, *others: FloatArray) -> FloatArray:
    """Return the points (k, 3) that are not among others, by their first coordinate."""
    return points[~np.isin(points[:, 0], np.concatenate(others)[:, 0])]


class _JoinedWorld(NamedTuple):
    """Pieces in the world of the first, and which pairs agree."""

    evidence: _Evidence
    standing: Standing
    covariances: FloatArray
    agrees: BoolArray
    """(k,)"""
    solved: SolverResult
    """The program's last solve, from which the refinement started."""

    def between(self, two: IntArray) -> Similarity:
        """Return how the second of two pieces stands in the world of the first."""
        middles = self.evidence.cameras.middles()
        to_first, to_second = (self.standing.similarity(k, middles) for k in two.tolist())
        return compose(invert(to_first), to_second)

    def support(self, counted: BoolArray) -> IntArray:
        """Return how many agreeing pairs are between every two pieces, (G, G), of those that count (k,).

        Where just one is missing, or all are of one image, points that speak for the join stand in for it.
        """
        pieces, count = self.evidence.pieces, self.evidence.cameras.num_pieces
        support = np.zeros((count, count), dtype=np.int64)
        for two in distinct_pairs(pieces):
            between = (pieces == two).all(axis=1) & self.agrees & counted
            weight = self.evidence.weigh(between)
            if weight < FEWEST_PAIRS <= max(weight, int(between.sum())) + 1:
                (points,) = self.evidence.coinciding(two, between, self.between(two))
                weight = FEWEST_PAIRS if _speaks(points, 0) else weight
            support[*two] = support[*two[::-1]] = weight
        return support


def _search(evidence: _Evidence, enough: int) -> _JoinedWorld:
    """Place pieces; two, of which fewer pairs agree than are enough, by other turns that are voted for too.

    Raises:
        UnsolvableError: as `_place`, if the first turn leads to none.
    """
    best = latest = _place(evidence)
    rest = best.evidence
    for _ in range(_MOST_TURNS - 1):
        if rest.cameras.num_pieces > 2 or best.evidence.weigh(best.agrees) >= enough:
            break
        turn = latest.standing.turns[0].T @ latest.standing.turns[1]
        off_deg = rotation_angles_deg(rest.votes.turns @ turn.T)
        rest = rest.part(rest.numbers, ~(off_deg <= AGREEMENT_DEG))
        try:
            latest = _place(rest)
        except UnsolvableError:
            break
        best = _better(best, latest)
    return best


def _search_alone(best: _JoinedWorld) -> _JoinedWorld:
    """Place two pieces, of which too few pairs agree, by each pair alone, the soundest first."""
    evidence = best.evidence
    if evidence.cameras.num_pieces > 2:
        return best
    for pair in np.argsort(-evidence.votes.soundness, kind="stable")[:_MOST_ALONE].tolist():
        if best.evidence.weigh(best.agrees) >= FEWEST_PAIRS:
            break
        try:
            best = _better(
                best, _place(evidence.part(evidence.numbers, np.arange(len(evidence.rows)) == pair))
            )
        except UnsolvableError:
            continue
    return best


def _better(best: _JoinedWorld, other: _JoinedWorld) -> _JoinedWorld:
    """Return of two joints of the same pieces the one with which more pairs of the first agree."""
    agrees = _agreeing(best.evidence, other.standing)
    if best.evidence.weigh(agrees) <= best.evidence.weigh(best.agrees):
        return best
    return other._replace(evidence=best.evidence, agrees=agrees)


def _place(evidence: _Evidence) -> _JoinedWorld:
    """Place all pieces that are tied to the first, and see which pairs agree.

    Raises:
        UnsolvableError: if none is tied to it, or the program has no answer.
    """
    turns = turn_pieces(evidence.votes, evidence.cameras.num_pieces)
    turned = np.isfinite(turns).all(axis=(1, 2))
    if np.sum(turned) < 2:
        raise UnsolvableError("no pair of images between them tells the turn between them")
    if not turned.all():
        return _place(evidence.part(evidence.numbers[turned]))
    directions = direct_ties(evidence.cameras, evidence.ties, turns)
    used = np.union1d(directions.usable(), np.flatnonzero(evidence.ties.is_shared))
    labels = connected_components(evidence.cameras.num_pieces, evidence.pieces[used])
    tied = labels == labels[0]
    if np.sum(tied) < 2:
        raise UnsolvableError("no pair of images between them has a direction")
    if not tied.all():
        return _place(evidence.part(evidence.numbers[tied]))
    standing, solved = solve_pieces(evidence.cameras, evidence.ties, directions, turns)
    standing, covariances = refine_pieces(evidence.cameras, evidence.ties.subset(used), standing)
    return _JoinedWorld(evidence, standing, covariances, _agreeing(evidence, standing), solved)


def _agreeing(evidence: _Evidence, standing: Standing) -> BoolArray:
    """Return of which pairs more than half of the matches that were set aside fit."""
    residuals = residuals_of(evidence.cameras, evidence.aside)
    fits = misses_px(residuals, standing) <= AGREEING_PX
    count = evidence.ties.num_pairs
    rows = np.bincount(residuals.pairs, minlength=count)
    return np.asarray(2 * np.bincount(residuals.pairs, fits, count) > rows)


def _grow(evidence: _Evidence) -> Iterator[tuple[int, PieceJoin | str]]:
    """Yield what comes of joining pieces to the first, by their numbers among all."""
    false = _none()
    while True:
        believed = evidence.part(evidence.numbers, ~np.isin(evidence.rows, false))
        try:
            joint = _search_alone(_search(believed, FEWEST_PAIRS))
        except UnsolvableError as error:
            yield from ((k, str(error)) for k in evidence.numbers[1:].tolist() if evidence.touches(k))
            return
        every = evidence.part(joint.evidence.numbers)
        agrees = np.isin(every.rows, joint.evidence.rows[joint.agrees])
        joint = joint._replace(evidence=every, agrees=agrees)
        rivals = _find_rivals(joint, false)
        if len(rivals.beaten):
            false = np.append(false, rivals.beaten)
            continue
        joins = list(_judge(joint, rivals))
        accepted = [join.piece for join in joins if not join.reason]
        yield from ((join.piece, join) for join in joins if join.reason)
        if len(accepted) == len(joins):
            yield from ((join.piece, join) for join in joins)
            return
        if not accepted:
            return
        evidence = evidence.part(np.append(evidence.numbers[0], accepted))


def _judge(joint: _JoinedWorld, rivals: "_Rivals") -> Iterator[PieceJoin]:
    """Yield the join of each piece but the first, or why it is refused."""
    evidence = joint.evidence
    clean, whole = joint.support(~rivals.in_doubt), joint.support(np.ones_like(rivals.in_doubt))
    held = _reached(clean, 0)
    for k in range(1, evidence.cameras.num_pieces):
        join = _join_of(joint, k, rivals.named)
        if not held[k]:
            join = replace(join, reason=_reason_of_few(join, has_rival=bool(_reached(whole, 0)[k])))
        elif evidence.weigh(np.isin(evidence.rows, join.agreeing)) < FEWEST_PAIRS:
            join = replace(join, evidence=f"{join.evidence}, and points that coincide")
        yield join


def _reached(support: IntArray, first: int) -> BoolArray:
    """Return which pieces enough pairs tie to the first, or to those that are tied to it, one by one."""
    held = np.arange(len(support)) == first
    while True:
        ties = np.where(held, 0, support[:, held].sum(axis=1))
        best = int(np.argmax(ties))
        if ties[best] < FEWEST_PAIRS:
            return np.asarray(held)
        held[best] = True


class _Rivals(NamedTuple):
    """Pairs that agree on another join of their two pieces than the rest does."""

    named: BoolArray
    """(k,)"""
    in_doubt: BoolArray
    """(k,) pairs of pieces of which nothing says which join is right."""
    beaten: IntArray
    """Pairs, by their numbers among all, that agree with the join where points speak for the other."""


def _find_rivals(joint: _JoinedWorld, false: IntArray) -> _Rivals:
    """Look between every two pieces for pairs that agree on another join, and ask points which is right.

    Pairs that were found false are rivals, by their numbers among all.
    """
    evidence = joint.evidence
    named = np.isin(evidence.rows, false)
    in_doubt, beaten = np.zeros((2, len(evidence.rows)), dtype=np.bool_)
    for two in distinct_pairs(evidence.pieces[~joint.agrees]):
        between = (evidence.pieces == two).all(axis=1)
        agreeing = between & joint.agrees
        part = evidence.part(evidence.numbers[two], ~joint.agrees)
        for rival, most_agree in _rivals_among(part):
            if not most_agree and evidence.weigh(agreeing) < FEWEST_PAIRS - 1:
                break  # it is refused anyhow
            elsewhere = _join_of(rival, 1, ~rival.agrees)
            if elsewhere.reason:
                continue
            others = between & np.isin(evidence.rows, rival.evidence.rows[rival.agrees])
            joins = joint.between(two), elsewhere.to_from_piece
            counts = evidence.coinciding(two, agreeing | others, *joins)
            if agreeing.any() and _speaks(*counts[::-1]):
                beaten = beaten | agreeing
                break
            weight = evidence.weigh(others)
            if most_agree and weight >= _FEWEST_RIVALS:
                named = named | others
                if weight >= _RIVAL_SHARE * evidence.weigh(agreeing) and not _speaks(*counts):
                    in_doubt |= between
            if _speaks(counts[0], 0):
                break
    return _Rivals(named, in_doubt, evidence.rows[beaten])


def _speaks(first: int, second: int) -> bool:
    """Return whether so many coinciding points speak for the first of two joins."""
    return first >= _FEWEST_POINTS + _CLEARLY * second


def _rivals_among(evidence: _Evidence) -> Iterator[tuple[_JoinedWorld, bool]]:
    """Yield other joins of two pieces: first that with which most pairs agree, then those by single pairs."""
    alone = np.argsort(-evidence.votes.soundness, kind="stable")[:_MOST_ALONE]
    with suppress(UnsolvableError):
        yield _search(evidence, _FEWEST_RIVALS), True
    for pair in alone.tolist():
        try:
            rival = _place(evidence.part(evidence.numbers, np.arange(len(evidence.rows)) == pair))
        except UnsolvableError:
            continue
        agrees = _agreeing(evidence, rival.standing)
        if agrees.any():
            yield rival._replace(evidence=evidence, agrees=agrees), False


def _join_of(joint: _JoinedWorld, k: int, rivals: BoolArray) -> PieceJoin:
    """Return the join of one piece, refused if it is uncertain."""
    evidence, standing = joint.evidence, joint.standing
    middles, size = evidence.cameras.middles(), evidence.cameras.sizes()[k]
    touching = (evidence.pieces == k).any(axis=1)
    sigmas = np.sqrt(np.diagonal(joint.covariances[k]))
    scale_sigma, center_sigma = float(sigmas[3]), float(np.linalg.norm(sigmas[4:]))
    turn_sigma_deg = float(np.degrees(np.linalg.norm(sigmas[:3])))
    agreeing, against = touching & joint.agrees, touching & ~joint.agrees
    shared = int(np.sum(evidence.ties.is_shared & agreeing))
    pairs = f"{int(agreeing.sum())} of {counted(int(touching.sum()), 'pair')} of images between them"
    same = f", {shared} by {'an image' if shared == 1 else 'images'} that both have" if shared else ""
    return PieceJoin(
        piece=int(evidence.numbers[k]),
        to=int(evidence.numbers[0]),
        to_from_piece=compose(invert(standing.similarity(0, middles)), standing.similarity(k, middles)),
        scale_sigma=scale_sigma,
        turn_sigma_deg=turn_sigma_deg,
        center_sigma=float(standing.scales[k] * size * center_sigma),
        agreeing=evidence.rows[agreeing],
        contradicting=evidence.rows[against],
        rivals=evidence.rows[touching & rivals],
        solved=joint.solved,
        evidence=pairs + same,
        reason=uncertainty(scale_sigma, turn_sigma_deg, center_sigma),
    )


def _reason_of_few(join: PieceJoin, *, has_rival: bool) -> str:
    """Say why the pairs do not suffice for a join."""
    agreeing, total = len(join.agreeing), len(join.agreeing) + len(join.contradicting)
    if has_rival:
        return (
            f"two joins are possible: {counted(agreeing, 'pair')} of images between them agree on one, "
            f"{len(join.rivals)} on another"
        )
    if agreeing >= FEWEST_PAIRS:
        return (
            f"the {agreeing} of {counted(total, 'pair')} of images between them that agree are all of one "
            "image, which may be taken for another; match others"
        )
    return (
        f"{agreeing or 'none'} of {counted(total, 'pair')} of images between them agree on one join, and it "
        f"needs {FEWEST_PAIRS}: match more of their images, unless they show different scenes"
    )
