"""What a model's points say of its images: which see too few, and what share of the matches agrees."""

from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, IntArray
from sfm_shapefit.base.executors import in_threads
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.base.record import Record
from sfm_shapefit.judgement.limits import CHANCE_SHARE, CHECKED_BY, FEWEST_POINTS, OUTNUMBERED, SMALLEST_SHAPE
from sfm_shapefit.scene.epipolar import sampson_px, write_ray
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.links import CameraPoses, MatchedKeypoints

_MATCHES_A_SLICE = 250_000  # matches that are looked at by one thread, and then counted: about 10 ms
_HAS_NO_PART, _FITS, _MISSES = range(3)  # what is found of a match


def images_of_few_points(points: Points, images: Images, least: IntArray, fixed: BoolArray) -> IntArray:
    """Return how many points images see that are to leave, -1 for those that stay, (i,).

    A frame leaves if each of its posed images sees less than `least` (f,) points, and it is not `fixed` (f,).
    It takes its observations along, which may leave others with too few; three frames stay.
    """
    gone, frame_of = np.full(images.num_images, -1), images.frame_of
    while True:
        there = images.is_posed & (gone < 0)
        seen = points.taken(points.paired(there[points.images])).count_seen(images.num_images)
        most = np.full(len(images.frames.ids), -1)
        np.maximum.at(most, frame_of[there], seen[there])
        poor = (most >= 0) & (most < least) & ~fixed
        if not poor.any() or np.sum((most >= 0) & ~poor) < SMALLEST_SHAPE:
            return gone
        leaving = there & poor[frame_of]
        gone[leaving] = seen[leaving]


class EvidenceShares(Record):
    """What share of the evidence agrees with the cameras and points of the output."""

    pairs: Annotated[
        float | None,
        "Share of the pairs of its cameras that say anything of a direction; null where none does.",
    ] = None
    observations: Annotated[
        float | None,
        "Share that sees a 3D point, of the keypoints matched in two or more of its other images; null "
        "without a database.",
    ] = None
    contradicting: Annotated[
        float | None,
        "Share that sees none and most of whose matches miss the epipolar lines of the cameras, of the "
        "same keypoints.",
    ] = None


class Support(NamedTuple):
    """How the points that their matches make support images."""

    num_seen: IntArray
    """(i,) number of points that an image saw, where it was left out because these were too few; -1 for
    images that were not left out for that."""
    unsupported: BoolArray
    """(i,) images whose matches hardly make points; they are left out unless the option min_trust is 0."""
    observations: EvidenceShares
    """Shares of keypoints matched in two other images that see a point, and that contradict the cameras."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObservationCounts:
    """Numbers of keypoints that are matched in two or more other posed images, by image; 0 without a pose."""

    checked: IntArray
    """(i,) their number."""
    agreeing: IntArray
    """(i,) number that sees a 3D point."""
    contradicting: IntArray
    """(i,) number that sees none, and most of whose matches miss the epipolar lines of the cameras."""

    def shares(self, chosen: BoolArray) -> EvidenceShares:
        """Return the shares of some of the images (i,) together."""
        total = int(self.checked[chosen].sum())
        if not total:
            return EvidenceShares()
        agreeing, contradicting = (int(part[chosen].sum()) for part in (self.agreeing, self.contradicting))
        return EvidenceShares(observations=agreeing / total, contradicting=contradicting / total)


class PartnerCounts:
    """For each keypoint of posed images, in how many others it is matched, and how often that contradicts."""

    def __init__(
        self, images: Images, num_keypoints: IntArray, max_error_px: float, fixed: BoolArray | None = None
    ) -> None:
        """Begin to count.

        Args:
            images: some of them posed.
            num_keypoints: (i,)
            max_error_px: distance from the epipolar line (of both images together, to first order) from
                which a match contradicts.
            fixed: (i,) images whose matches among themselves have no part; none if None.
        """
        self._num_keypoints, self._max_error_px, self._fixed = num_keypoints, max_error_px, fixed
        self._posed = images.is_posed
        self._free = np.ones_like(self._posed) if fixed is None else ~fixed
        self._sizes = np.where(self._posed, num_keypoints, 0)
        self._begins = offsets_of(self._sizes)
        # A keypoint is counted once with each image.
        self._counts = np.zeros((self._begins[-1], 2), dtype=np.min_scalar_type(max(len(self._sizes), 256)))

    def anew(self, images: Images) -> "PartnerCounts":
        """Return counts of nothing yet for images others of which are posed."""
        return PartnerCounts(images, self._num_keypoints, self._max_error_px, self._fixed)

    def add(self, matched: MatchedKeypoints, poses: CameraPoses, threads: int = 1) -> None:
        """Count the matches of further pairs; `poses` are of their cameras, with the rows of all images.

        Threads look which matches miss; one counts these in their order.
        """
        last = np.full(len(matched.cameras), -1, dtype=np.int32)
        given = (
            matched.on_plane, matched.cameras, poses.rotations, poses.centers, poses.focal_lengths_px,
            poses.images, self._posed, self._free, self._max_error_px,
        )  # fmt: skip
        for some in matched.slices():
            slices = [
                some[first : first + _MATCHES_A_SLICE] for first in range(0, len(some), _MATCHES_A_SLICE)
            ]
            found = in_threads(threads, lambda matches: _find_misses(matches, *given), slices)
            for matches, kinds in zip(slices, found, strict=True):
                _count_misses(
                    matches, kinds, matched.cameras, matched.keypoints, poses.images, self._begins, last,
                    self._counts,
                )  # fmt: skip

    def compare(self, points: Points) -> ObservationCounts:
        """Return how many observations of each image agree with the cameras, and how many contradict them.

        The others are merely without a point: seen under too small an angle, in too short a track, or along
        an epipolar line and yet not where another image has them. The `points` are made of the matches.
        """
        partners, misses = self._counts.T
        checked, sees = partners >= CHECKED_BY, np.zeros(len(partners), dtype=np.bool_)
        sees[self._begins[points.images] + points.keypoints] = True
        parts = (checked, checked & sees, checked & ~sees & (misses > partners - misses))
        image_of = np.repeat(np.arange(len(self._sizes)), self._sizes)
        columns = (np.bincount(image_of[part], minlength=len(self._sizes)).astype(np.int64) for part in parts)
        return ObservationCounts(**dict(zip(("checked", "agreeing", "contradicting"), columns, strict=True)))


def images_without_support(counts: ObservationCounts, images: Images, fixed: BoolArray) -> BoolArray:
    """Return the images (i,) of frames whose matches could make points with those of others, and hardly do.

    Directions can agree with a wrong pose, of an image on a repeated structure for one: points, which need
    three images, do not. If fewer than three frames have points, none is returned; `fixed` ones (f,) are not
    asked.
    """
    could = counts.checked >= OUTNUMBERED * FEWEST_POINTS
    does = could & (
        counts.agreeing >= CHANCE_SHARE * counts.checked
    )  # right images have .26 or more, a wrong one 0
    posed, lost, support = np.zeros((3, len(images.frames.ids)), dtype=np.bool_)
    posed[images.frame_of[images.is_posed]] = True
    lost[images.frame_of[could]], support[images.frame_of[does]] = True, True
    lost &= ~support & ~fixed
    return images.is_posed & (lost & (np.sum(posed & ~lost) >= SMALLEST_SHAPE))[images.frame_of]


@kernel
def _find_misses(
    matches: Any, on_plane: Any, cameras: Any, rotations: Any, centers: Any, focal_lengths_px: Any,
    images: Any, posed: Any, free: Any, max_error_px: float,
) -> Any:  # fmt: skip
    """Return whether each match misses its epipolar line, fits, or has no part, (m,).

    Two images in one place, whose baseline is 0, contradict nothing.
    """
    u, v, d = np.empty((3, 3))
    found = np.empty(len(matches), np.int8)
    for m in range(len(matches)):
        i, j = cameras[matches[m, 0]], cameras[matches[m, 1]]
        first, second = images[i], images[j]
        if not (posed[first] and posed[second] and (free[first] or free[second])):
            found[m] = _HAS_NO_PART
            continue
        square = 0.0
        for c in range(3):
            d[c] = centers[j, c] - centers[i, c]
            square += d[c] * d[c]
        length = max(np.sqrt(square), 1e-300)
        for c in range(3):
            d[c] /= length
        write_ray(on_plane[matches[m, 0]], rotations[i], u)
        write_ray(on_plane[matches[m, 1]], rotations[j], v)
        misses = sampson_px(u, v, d, 1.0 / min(focal_lengths_px[i], focal_lengths_px[j])) > max_error_px
        found[m] = _MISSES if misses else _FITS
    return found


@kernel
def _count_misses(
    matches: Any, found: Any, cameras: Any, keypoints: Any, images: Any, begins: Any, last: Any, counts: Any
) -> None:
    """Count the partners of each keypoint in other images, and those of them that miss their epipolar lines.

    `last` has the image that was counted last for each matched keypoint, `begins` where the keypoints of each
    image begin in `counts`.
    """
    for m in range(len(matches)):
        if found[m] == _HAS_NO_PART:
            continue
        for side in range(2):
            row = matches[m, side]
            image, other = images[cameras[row]], images[cameras[matches[m, 1 - side]]]
            if last[row] != other:  # a keypoint may be matched twice with one image
                own = counts[begins[image] + keypoints[row]]
                own[0] += 1
                own[1] += found[m] == _MISSES
                last[row] = other
