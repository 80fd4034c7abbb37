"""Rotations averaged component by component; frames that the averaging of one drops are grouped anew."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.base.lists import RowLists
from sfm_shapefit.base.wording import counted
from sfm_shapefit.pairs.pair_scores import PairScores
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.rotations.arrangements import choose_arrangement, evidence_of
from sfm_shapefit.rotations.average import average_relative_rotations
from sfm_shapefit.rotations.averaged import AveragedRotations
from sfm_shapefit.rotations.averaging_options import AveragingOptions
from sfm_shapefit.scene.given import Gravity

# What only unsound pairs, or pairs below `min_matches`, tie to the rest.
_UNTIED = (
    "no pair that can be believed ties it to the others: their matches are few, fit no one relative pose, or "
    "contradict the rest"
)


class ComponentAveraging(NamedTuple):
    """How the rotations of components are averaged."""

    options: AveragingOptions
    threads: int
    gravity: Gravity | None
    """Gravity in the axes of frames."""
    scores: PairScores = PairScores()
    """Scores of pairs of frames, as far as they are known."""
    timed: Callable[[], AbstractContextManager[object]] = nullcontext
    """What each averaging takes place in."""

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
                    few = f"matches tie it only into {_group(len(members))}; a model needs {least}"
                    reasons |= dict.fromkeys(members.tolist(), few)
                continue
            inside, local = pairs_among(relative, members)
            try:
                with self.timed():
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
                tied = f"pairs that can be believed tie it only into {_group(len(kept))}"
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
            return average_relative_rotations(len(members), some.subset(used), self.threads)

        answer = average(local)
        evidence = evidence_of(inside, self.scores.of(inside.pairs)[:, 1])
        if evidence.any():
            chosen = choose_arrangement(local, evidence, answer, average)
            repeated, rivals = int(chosen.refused.sum()), int(chosen.rival.sum())
            answer = replace(chosen.averaged, num_repeated=repeated, num_rivals=rivals)
        if self.gravity is None:
            return answer
        from sfm_shapefit.rotations.gravity import refine_with_gravity  # it loads long

        return refine_with_gravity(answer, local, self.gravity.of(members))


def pairs_among(
    relative: RelativeRotations, members: IntArray
) -> tuple[RelativeRotations, RelativeRotations]:
    """Return the pairs among some images or frames, ascending, and the same by their place among these."""
    inside = relative.subset(np.asarray(np.isin(relative.pairs, members).all(axis=1)))
    return inside, replace(inside, pairs=np.searchsorted(members, inside.pairs))


def _group(count: int) -> str:
    """Count the frames of a group; without rigs, each is an image."""
    return f"a group of {counted(count, 'image')} (a frame of a rig counts as one)"


def _group_frames(num_frames: int, pairs: IntArray) -> list[IntArray]:
    """Return the connected components, ascending, the largest first; single frames are components too."""
    groups = RowLists.by_label(connected_components(num_frames, pairs))
    return sorted(groups, key=lambda group: (-len(group), int(group[0])))
