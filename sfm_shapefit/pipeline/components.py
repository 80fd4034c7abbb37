"""The components of the view graph, each with averaged rotations.

Frames that the averaging of a component drops are grouped anew by the pairs among themselves.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.base.wording import counted
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.rotations.arrangements import choose_arrangement, evidence_of
from sfm_shapefit.rotations.average import average_relative_rotations, check_pairs
from sfm_shapefit.rotations.averaged import AveragedRotations
from sfm_shapefit.rotations.options import AveragingOptions
from sfm_shapefit.scene.given import Gravity
from sfm_shapefit.scene.matches import rows_of_pairs

# What only unsound pairs, or pairs below `min_matches`, tie to the rest.
_UNTIED = (
    "no pair that can be believed ties it to the others: their matches are few, fit no one relative pose, or "
    "contradict the rest"
)


class PairScores(NamedTuple):
    """Scores of pairs with a relative rotation, by which those of repeated structure are told."""

    pairs: IntArray = np.zeros((0, 2), dtype=np.int64)
    """(m, 2)"""
    values: FloatArray = np.zeros((0, 2))
    """(m, 2) by triangles, and the matched share of their overlap; NaN where unknown."""

    def of(self, pairs: IntArray) -> FloatArray:
        """Return those of some pairs (k, 2), (k, 2)."""
        return np.vstack([self.values, [np.nan, np.nan]])[rows_of_pairs(pairs, self.pairs)]


class ComponentAveraging(NamedTuple):
    """How the rotations of components are averaged."""

    options: AveragingOptions
    clock: Clock
    gravity: Gravity | None
    """Gravity in the axes of frames."""
    scores: PairScores = PairScores()
    """Scores of pairs of frames, as far as they are known."""

    def average(
        self, num_frames: int, relative: RelativeRotations, reasons: dict[int, str]
    ) -> Iterator[tuple[IntArray, AveragedRotations]]:
        """Yield the frames of each component that got rotations, ascending, and those rotations.

        Why a frame belongs to none is written to `reasons`.
        """
        waiting, least = _group_frames(num_frames, relative.pairs), self.options.min_model_size
        while waiting:
            members = waiting.pop(0)
            if len(members) < least:
                if len(members) > 1:
                    few = f"matched with only {_others(len(members) - 1)}; a model needs {least}"
                    reasons |= dict.fromkeys(members.tolist(), few)
                continue
            inside, local = pairs_among(relative, members)
            try:
                with self.clock("rotation averaging"):
                    answer = self._average_component(members, inside, local)
            except UnsolvableError as error:
                reasons |= dict.fromkeys(members.tolist(), str(error))
                continue
            kept, left = members[answer.registered], members[~answer.registered]
            reasons |= dict.fromkeys(left.tolist(), _UNTIED)
            if len(left) < len(members):
                rest = inside.pairs[np.isin(inside.pairs, left).all(axis=1)]
                waiting = [*waiting, *(group for group in _group_frames(num_frames, rest) if len(group) > 1)]
            if len(kept) >= least:
                yield kept, answer.subset(answer.registered)
            else:
                tied = f"pairs that can be believed tie it to only {_others(len(kept) - 1)}"
                reasons |= dict.fromkeys(kept.tolist(), f"{tied}; a model needs {least}")

    def _average_component(
        self, members: IntArray, inside: RelativeRotations, local: RelativeRotations
    ) -> AveragedRotations:
        """Average rotations, by the arrangement of the frames that the matches speak for, and by gravity.

        The pairs among them are `inside`, and `local` by their place among the members.
        """

        def average(some: RelativeRotations) -> AveragedRotations:
            used = some.num_matches >= self.options.min_matches
            if not used.any():
                raise UnsolvableError(
                    f"none of {counted(len(used), 'pair')} has {self.options.min_matches} inlier matches; "
                    "lower min_matches"
                )
            return average_relative_rotations(len(members), some.subset(used), self.clock.threads)

        answer = average(local)
        evidence = evidence_of(inside, self.scores.of(inside.pairs)[:, 1])
        if evidence.any():
            chosen = choose_arrangement(local, evidence, answer, average)
            repeated, rivals = int(chosen.refused.sum()), int(chosen.rival.sum())
            answer = replace(chosen.averaged, num_repeated=repeated, num_rivals=rivals)
        if self.gravity is None:
            return answer
        return refine_with_gravity(answer, local, self.gravity.of(members))


def pairs_among(
    relative: RelativeRotations, members: IntArray
) -> tuple[RelativeRotations, RelativeRotations]:
    """Return the pairs among some images or frames, ascending, and the same by their place among these."""
    inside = relative.subset(np.asarray(np.isin(relative.pairs, members).all(axis=1)))
    return inside, replace(inside, pairs=np.searchsorted(members, inside.pairs))


def _others(count: int) -> str:
    """Count other frames, which are images where no rig is."""
    return f"{counted(count, 'other image')} (or frame of a rig)"


def _group_frames(num_frames: int, pairs: IntArray) -> list[IntArray]:
    """Return the connected components, ascending, the largest first; single frames are components too."""
    labels = connected_components(num_frames, pairs)
    groups = np.split(np.argsort(labels, kind="stable"), np.cumsum(np.bincount(labels))[:-1])
    return sorted(groups, key=lambda group: (-len(group), int(group[0])))


def refine_with_gravity(
    averaged: AveragedRotations, relative: RelativeRotations, gravity: Gravity
) -> AveragedRotations:
    """Return averaged rotations of frames refined on their pairs and gravities together."""
    from sfm_shapefit.rotations.gravity import with_gravity  # it loads long

    supports = relative.weight_shares * relative.num_matches
    count = len(averaged.registered)
    given, _ = check_pairs(relative.pairs, relative.rotations, relative.information, supports, count)
    return with_gravity(averaged, given, gravity)
