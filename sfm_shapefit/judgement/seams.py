"""Seams: groups of cameras that agree in themselves, and that the pairs across do not tie to the rest.

No test of single cameras sees a group that is shifted, scaled or turned as a whole: each of its cameras has
many pairs that agree with it. So the cameras are cut where contradictions across outnumber agreement, by
correlation clustering with a weight of 1 for each pair that agrees, and of -1 for each that contradicts
(`bodies`), and then by moves of single cameras while these gain.

Pairs of repeated structure contradict in numbers, too. A cut is a seam

    untied   if neither pairs nor points tie most of the group to what most of the rest is in (`ties`)
    turned   else, if more than a tenth of the contradictions, and three, agree on one turn of the group, by
             the relative rotations that their matches have by themselves: Q = R_j^T R_ij R_i, i outside, j in
             the group. Where they agree on none, the rotations are right and the group is shifted or scaled,
             but moving things make pairs say so, too

A contradiction whose matches fit no pose of their own says nothing of how the group stands. Where those with
a sound pose are fewer than the pairs that agree, the model is the better explanation: houses that look alike
make both kinds between cameras that are right. The turn is a rival then, and is to be looked at.

castle-P19 and P30 have a cut from repeated walls, with 48 and 103 contradictions of which hardly any agree
on a turn; at lego100, five cameras whose contradictions do are wrong. `scripts/results/verdict.md` has groups
that were moved: most are named, but those that are merely scaled by a tenth, which few pairs contradict.
"""

from typing import Annotated, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.geometry import rotation_angles_deg
from sfm_shapefit.base.lists import RowLists
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import counted, first_of
from sfm_shapefit.judgement.bodies import find_bodies
from sfm_shapefit.judgement.limits import ALIKE_DEG, FEWEST_ALIKE, LOCAL_SHARE, MOST_COMPARED, OUTNUMBERED
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import is_among

_MOST_ROUNDS = 10  # passes of moves; two or three are usual


class Cut(NamedTuple):
    """A group of cameras whose contradictions with the rest outnumber the agreement."""

    cameras: IntArray
    """Their rows, ascending."""
    num_agreeing: int
    """Pairs across that agree."""
    contradicting: IntArray
    """(m, 2) pairs across that contradict."""
    is_tied: bool
    """Whether pairs or points tie most of the group to what most of the rest is in."""


class CameraGroup(Record):
    """A group of cameras, and the pairs between it and the rest."""

    images: Annotated[tuple[str, ...], "Names of its members."]
    num_agreeing: Annotated[int, "Pairs between it and the rest that agree."]
    num_contradicting: Annotated[int, "Pairs between it and the rest that contradict."]


class GroupApart(CameraGroup):
    """A group of cameras that agree with one another, and stand apart from the rest."""

    num_turned: Annotated[int, "Contradicting pairs that agree on one turn of the group."]
    turn_deg: Annotated[float | None, "Angle of that turn; null without any."]
    is_rival: bool = False
    """Whether contradicting pairs with a sound pose are fewer than those that agree, and that tie it."""

    @property
    def statement(self) -> str:
        """The same in a sentence."""
        turns = self.num_turned if (self.turn_deg or 0.0) >= 0.5 else 0
        turn = f"; {turns} agree on a turn by {self.turn_deg:.0f} deg" if turns else ""
        stand, or_else = ("may stand", ", or look alike from there") if self.is_rival else ("stand", "")
        return (
            f"{len(self.images)} cameras {stand} apart from the rest ({first_of(self.images)}): "
            f"{counted(self.num_agreeing, 'pair')} between them and the rest agree, {self.num_contradicting} "
            f"contradict or are rejected{turn}; either side may be the wrong one{or_else}"
        )


def find_cuts(agreeing: IntArray, contradicting: IntArray, group: IntArray) -> tuple[Cut, ...]:
    """Return the groups of cameras that contradictions cut off, the largest first.

    Args:
        agreeing: (k, 2) pairs of cameras that agree with the model.
        contradicting: (m, 2) pairs that contradict it, by their direction or by their rotation.
        group: (n,) what cameras are tied to, by pairs and points; those without a pair are in no cut.
    """
    count = len(group)
    pairs = np.concatenate([agreeing, contradicting])
    weights = np.repeat([1.0, -1.0], [len(agreeing), len(contradicting)])
    bodies = _moved(find_bodies(count, pairs, weights), pairs, weights)
    sizes = np.bincount(bodies, minlength=count)
    main = int(np.argmax(sizes))
    across = [side[bodies[side[:, 0]] != bodies[side[:, 1]]] for side in (agreeing, contradicting)]
    num_agreeing, num_against = (np.bincount(bodies[side].ravel(), minlength=count) for side in across)
    is_cut = (num_against >= FEWEST_ALIKE) & (num_against > OUTNUMBERED * num_agreeing)
    cuts = []
    for body in np.argsort(-sizes, kind="stable").tolist():
        if not is_cut[body] or body == main or sizes[body] == 1:
            continue  # a single camera is no group, and has tests of its own
        inside = bodies == body
        contradicted = across[1][inside[across[1]].any(axis=1)]
        mostly, rest = (int(np.bincount(group[bodies == one]).argmax()) for one in (body, main))
        cuts.append(Cut(np.flatnonzero(inside), int(num_agreeing[body]), contradicted, mostly == rest))
    return tuple(cuts)


def find_seams(cuts: tuple[Cut, ...], relative: RelativeRotations, images: Images) -> tuple[GroupApart, ...]:
    """Return the cuts that are seams, by what pairs across them say relative to the images' rotations.

    A pair across may have no relative rotation.
    """
    sound = relative.subset(relative.are_sound())
    seams = []
    for cut in cuts:
        rows = np.flatnonzero(is_among(sound.pairs, cut.contradicting))
        num_sound = len(rows)
        taken = min(num_sound, MOST_COMPARED)
        rows = rows[np.arange(taken) * num_sound // max(taken, 1)]
        turns = _turns(sound.subset(rows), images.rotations, cut.cameras)
        num_turned, turn_deg = _most_alike(turns)
        is_turned = num_turned >= FEWEST_ALIKE and num_turned > LOCAL_SHARE * len(rows)
        if (is_turned and turn_deg > ALIKE_DEG) or not cut.is_tied:
            seams.append(
                GroupApart(
                    images=images.names_of(cut.cameras),
                    num_agreeing=cut.num_agreeing,
                    num_contradicting=len(cut.contradicting),
                    num_turned=num_turned,
                    turn_deg=turn_deg,
                    is_rival=cut.is_tied and num_sound < cut.num_agreeing,
                )
            )
    return tuple(seams)


def _moved(bodies: IntArray, pairs: IntArray, weights: FloatArray) -> IntArray:
    """Return the bodies (n,) after moves of single cameras to where their pairs agree most."""
    bodies, count = bodies.copy(), len(bodies)
    ends, others = pairs.T.ravel(), pairs[:, ::-1].T.ravel()
    doubled, ends_of = np.tile(weights, 2), list(RowLists.by_label(ends, count))
    for _ in range(_MOST_ROUNDS):
        moved = False
        for camera, own in enumerate(ends_of):
            gains = np.bincount(bodies[others[own]], doubled[own], count)
            best = int(np.argmax(gains))
            if gains[best] > gains[bodies[camera]]:
                bodies[camera], moved = best, True
        if not moved:
            break
    return bodies


def _turns(pairs: RelativeRotations, rotations: FloatArray, group: IntArray) -> FloatArray:
    """Return the turn of the group in the world that each pair across asks for, (k, 3, 3)."""
    i, j = pairs.pairs.T
    asked = rotations[j].transpose(0, 2, 1) @ pairs.rotations @ rotations[i]
    return np.asarray(np.where(np.isin(j, group)[:, None, None], asked, asked.transpose(0, 2, 1)))


def _most_alike(turns: FloatArray) -> tuple[int, float]:
    """Return how many of some turns (k, 3, 3) agree on one of them, and its angle in degrees."""
    if not len(turns):
        return 0, float("nan")
    between = np.swapaxes(turns, 1, 2)[:, None] @ turns[None]
    counts = np.sum(rotation_angles_deg(between) <= ALIKE_DEG, axis=1)
    best = int(np.argmax(counts))
    return int(counts[best]), float(rotation_angles_deg(turns[best : best + 1])[0])
