"""Videos among the images of a database, and whether their loops are to be believed.

Frames of a video are named by a running number. Neighbors share most of what they see, and are hardly ever
false pairs. A pair of frames far apart in time is a loop where the camera came back, or repeated structure
where it did not.

    reach     of a frame: the last one that strong pairs of it lead to without a gap in time
    neighbor  a pair within the reach of one of its frames; a loop pair otherwise
    chain     the rotations averaged over neighbors alone
    visit     loop pairs whose first frames are near one another in time, and whose second frames are

A loop pair agrees with the chain if its relative rotation is that of the chain within its uncertainty. A
visit is taken if most of its matches are of pairs that agree, and then only these pairs are: what agrees with
the chain agrees with one another. Checked on `scripts/results/notes.md#loops-of-videos`.
"""

import re
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.base.record import Record
from sfm_shapefit.pairs.relative_rotations import AGREEMENT_DEG, RelativeRotations
from sfm_shapefit.rotations.averaged import AveragedRotations

# A running number and what surrounds it; at most 255 digits, as Python reads no integer of more than 4,300.
_LAST_NUMBER = re.compile(r"^(.*?)(\d{1,255})(\D*)$", re.DOTALL)
_FEWEST_FRAMES = 10  # images with running numbers; fewer are no video
# Share of successive frames that must be matched, and how many times more matches these pairs have than pairs
# that are farther apart: a folder of numbered photographs is no video.
_MATCHED_SHARE, _MORE_MATCHES = 0.8, 2.0
_STEP, _DOUBLING = 10, 2.0  # frames, and ratio of distances; matching takes the next, then some that double
_STRONG_SHARE = 0.1  # share of the matches of successive frames; false pairs have fewer, at every distance
_NEAR = 10  # frames; so near in time they are of one visit
_MOST_SIGMAS, _DRIFT_DEG = 5.0, 0.02  # deviations of a loop from the chain, degrees a frame; it drifts


class Videos(NamedTuple):
    """Which images are frames of a video, and when."""

    video_of: IntArray
    """(n,) its number; -1 for images of none."""
    time_of: IntArray
    """(n,) place in its video, from 0; -1 for images of none."""

    @property
    def num_videos(self) -> int:
        """Number of videos."""
        return int(self.video_of.max(initial=-1)) + 1

    @property
    def num_frames(self) -> int:
        """Number of images in videos."""
        return int(np.sum(self.video_of >= 0))

    def subset(self, chosen: BoolArray) -> "Videos":
        """Return the same with some of the videos only, renumbered."""
        number = np.where(chosen, np.cumsum(chosen) - 1, -1)
        video_of = np.where(self.video_of >= 0, number[self.video_of], -1) if len(chosen) else self.video_of
        return Videos(video_of, np.where(video_of >= 0, self.time_of, -1))


class Loop(Record):
    """Pairs between two stretches of a video that are far apart in time, by the names of their frames."""

    first: Annotated[tuple[str, ...], "First and last frame of the earlier stretch."]
    second: Annotated[tuple[str, ...], "First and last frame of the later stretch."]
    num_pairs: Annotated[int, "Pairs between the two."]
    num_matches: Annotated[int, "Their inlier matches."]
    num_refused: Annotated[int, "Pairs left out, as they do not agree with the chain of pairs near in time."]
    angle_deg: Annotated[float, "Median angle between their relative rotations and the chain's."]
    tolerance_deg: Annotated[float, "Largest angle that counts as agreeing."]

    @property
    def cells(self) -> list[str]:
        """Its two stretches, pairs, matches, angle and fate, as the report has them in a row."""
        refused, total = self.num_refused, self.num_pairs
        fate = "taken" if refused == 0 else "refused" if refused == total else f"taken but for {refused}"
        angle = f"{self.angle_deg:.2g} (up to {self.tolerance_deg:.2g} agree)"
        return [*self.stretches, str(total), str(self.num_matches), angle, fate]

    @property
    def stretches(self) -> list[str]:
        """Its two stretches, each by its first and last frame."""
        return [" \N{EN DASH} ".join(dict.fromkeys(frames)) for frames in (self.first, self.second)]


class Loops(NamedTuple):
    """What became of the loops of all videos."""

    loops: tuple[Loop, ...]
    """Video by video, by the time of their first frames."""
    refused: IntArray
    """Rows of the pairs that are not to be used."""


def find_videos(names: Sequence[str]) -> Videos:
    """Return the videos among names: ten images or more that only differ by their last number."""
    groups: dict[tuple[str, str], list[tuple[int, int]]] = {}
    for image, name in enumerate(names):
        match = _LAST_NUMBER.match(name)
        if match:
            groups.setdefault((match[1], match[3]), []).append((int(match[2]), image))
    video_of, time_of = np.full(len(names), -1), np.full(len(names), -1)
    frames = [sorted(group) for group in groups.values() if len(group) >= _FEWEST_FRAMES]
    for video, group in enumerate(frames):
        rows = [image for _, image in group]
        video_of[rows], time_of[rows] = video, np.arange(len(rows))
    return Videos(video_of, time_of)


def confirm_videos(videos: Videos, relative: RelativeRotations) -> Videos:
    """Return those whose successive frames are matched, and better than frames that are farther apart."""
    confirmed = np.zeros(videos.num_videos, dtype=np.bool_)
    inside, lags = _lags(videos, relative.pairs)
    for video in range(videos.num_videos):
        of_video = inside & (videos.video_of[relative.pairs[:, 0]] == video)
        counts, lag = relative.num_matches[of_video], lags[of_video]
        n = int(np.sum(videos.video_of == video))
        near, num_far = counts[lag == 1], max((n - _NEAR) * (n - _NEAR - 1) // 2, 1)
        matched = len(near) >= _MATCHED_SHARE * (n - 1)
        # Frames that are not matched at all count, too: they have no matches.
        far = float(counts[lag > _NEAR].sum()) / num_far
        confirmed[video] = matched and float(near.sum()) / (n - 1) >= _MORE_MATCHES * far
    return videos.subset(confirmed)


def judge_loops(videos: Videos, names: Sequence[str], relative: RelativeRotations, threads: int = 1) -> Loops:
    """Return which loops of videos, of images `names` (n,), agree with the chain of neighbors.

    Other pairs are not judged.
    """
    from sfm_shapefit.rotations.average import average_relative_rotations  # here: few models are videos

    is_loop = loop_pairs(videos, relative)
    judged: list[Loop] = []
    refused = [np.zeros(0, dtype=np.int64)]
    for video in range(videos.num_videos):
        rows = np.flatnonzero(videos.video_of[relative.pairs[:, 0]] == video)
        rows = rows[videos.video_of[relative.pairs[rows, 1]] == video]
        chain = relative.subset(rows[~is_loop[rows]])
        loops = rows[is_loop[rows]]
        if len(loops) == 0 or len(chain.pairs) == 0:
            continue
        try:
            averaged = average_relative_rotations(len(videos.video_of), chain, threads)
        except UnsolvableError:
            continue
        angles, tolerances = _compare(videos, averaged, relative.subset(loops))
        finite = np.isfinite(angles)
        loops, angles, tolerances = loops[finite], angles[finite], tolerances[finite]
        verdict = _judge_visits(videos, names, relative.subset(loops), angles, tolerances)
        judged += verdict[0]
        refused.append(loops[verdict[1]])
    return Loops(tuple(judged), np.sort(np.concatenate(refused)))


def loop_pairs(videos: Videos, relative: RelativeRotations) -> BoolArray:
    """Return which of k pairs join frames of one video beyond the reach of both, (k,)."""
    pairs = relative.pairs
    inside, lags = _lags(videos, pairs)
    strong = relative.are_sound() & (relative.num_matches >= _least_matches(videos, relative))
    beyond = np.zeros(len(pairs), dtype=np.bool_)
    beyond[inside] = True
    for forward in (True, False):
        # In time, the frame whose reach is looked at comes first or last.
        order = np.where((videos.time_of[pairs[:, 0]] < videos.time_of[pairs[:, 1]]) == forward, 0, 1)
        frames = pairs[np.arange(len(pairs)), order]
        rows = np.flatnonzero(inside)
        rows = rows[np.lexsort((lags[rows], frames[rows]))]
        reach = frame = -1
        for row, lag in zip(rows.tolist(), lags[rows].tolist(), strict=True):
            if frames[row] != frame:
                frame, reach = int(frames[row]), 0
            if lag <= max(_DOUBLING * reach, reach + _STEP):
                reach = lag if strong[row] else reach
                beyond[row] = False
    return beyond


def _least_matches(videos: Videos, relative: RelativeRotations) -> FloatArray:
    """Return how many matches make a pair of a video strong, (k,): a share of those of successive frames."""
    inside, lags = _lags(videos, relative.pairs)
    video = videos.video_of[relative.pairs[:, 0]]
    least = np.zeros(len(video))
    for k in range(videos.num_videos):
        near = inside & (video == k) & (lags == 1)
        if near.any():
            least[video == k] = _STRONG_SHARE * float(np.median(relative.num_matches[near]))
    return least


def _lags(videos: Videos, pairs: IntArray) -> tuple[BoolArray, IntArray]:
    """Return which pairs are of one video, and how many frames they are apart, (k,) each."""
    i, j = pairs.T
    inside = (videos.video_of[i] == videos.video_of[j]) & (videos.video_of[i] >= 0)
    return np.asarray(inside), np.abs(videos.time_of[i] - videos.time_of[j])


def _compare(
    videos: Videos, averaged: AveragedRotations, loops: RelativeRotations
) -> tuple[FloatArray, FloatArray]:
    """Return by how many degrees loops are off the chain, NaN where it ends, and by how many they may be."""
    i, j = loops.pairs.T
    angles = loops.residuals_deg(averaged.rotations)
    variances = averaged.sigmas_deg[i] ** 2 + averaged.sigmas_deg[j] ** 2
    _, lags = _lags(videos, loops.pairs)
    tolerances = np.maximum(AGREEMENT_DEG, _MOST_SIGMAS * np.sqrt(variances)) + _DRIFT_DEG * lags
    known = averaged.registered[i] & averaged.registered[j] & np.isfinite(tolerances)
    return np.where(known, angles, np.nan), tolerances


def _judge_visits(
    videos: Videos, names: Sequence[str], loops: RelativeRotations, angles: FloatArray, tolerances: FloatArray
) -> tuple[list[Loop], BoolArray]:
    """Return the visits of a video by their time, and which of its loop pairs are refused."""
    refused, visits = angles > tolerances, list[tuple[list[int], Loop]]()
    if len(loops.pairs) == 0:
        return [], refused
    times = np.sort(videos.time_of[loops.pairs], axis=1)
    label, frames = _group(times), loops.pairs.ravel()
    image_at = dict(zip(videos.time_of[frames].tolist(), frames.tolist(), strict=True))
    for visit in range(int(label.max()) + 1):
        rows = np.flatnonzero(label == visit)
        counts = loops.num_matches[rows]
        if 2 * counts[~refused[rows]].sum() <= counts.sum():
            refused[rows] = True
        ends = np.sort(times[rows], axis=0)[[0, -1]]
        first, second = (tuple(names[image_at[time]] for time in side) for side in ends.T.tolist())
        loop = Loop(
            first=first,
            second=second,
            num_pairs=len(rows),
            num_matches=int(counts.sum()),
            num_refused=int(refused[rows].sum()),
            angle_deg=float(np.median(angles[rows])),
            tolerance_deg=float(np.mean(tolerances[rows])),
        )
        visits.append((ends[:, 0].tolist(), loop))
    return [loop for _, loop in sorted(visits, key=lambda visit: visit[0])], refused


def _group(times: IntArray) -> IntArray:
    """Return the visit of each loop pair by the times (k, 2) of its frames, (k,)."""
    order = np.lexsort((times[:, 1], times[:, 0]))
    links, first = [], 0
    for place, row in enumerate(order.tolist()):
        while times[row, 0] - times[order[first], 0] > _NEAR:
            first += 1
        near = order[first:place]
        links += [(other, row) for other in near[np.abs(times[near, 1] - times[row, 1]) <= _NEAR].tolist()]
    joined = np.array(links, dtype=np.int64).reshape(-1, 2)
    return connected_components(len(times), joined)
