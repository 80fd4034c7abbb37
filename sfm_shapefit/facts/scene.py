"""What is told of a scene: loops of videos, straight drives, repeated structure, and known distances."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import numpy as np

from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import counted
from sfm_shapefit.scene.images import Images

if TYPE_CHECKING:
    from sfm_shapefit.placement.options import KnownDistance


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
        stretches = [_stretch(self.first), _stretch(self.second)]
        return [*stretches, str(total), str(self.num_matches), angle, fate]


class DistanceFacts(Record):
    """A distance that the user gave."""

    first: Annotated[str, "Name of an image."]
    second: Annotated[str, "Name of another."]
    known: Annotated[float, "Distance that the user gave."]
    found: Annotated[float | None, "Distance in the output; null if one of them is not in it."]


def told_distances(known: "Sequence[KnownDistance]", images: Images) -> tuple[DistanceFacts, ...]:
    """Return the distances that were told, each with what a model has."""
    posed = np.flatnonzero(images.is_posed).tolist() if known else []
    centers = {images.names[k]: images.centers[k] for k in posed}
    return tuple(
        DistanceFacts(
            first=first,
            second=second,
            known=float(distance),
            found=float(np.linalg.norm(centers[first] - centers[second]))
            if {first, second} <= centers.keys()
            else None,
        )
        for first, second, distance in known
    )


def describe_loops(loops: Sequence[Loop]) -> str:
    """Say how many pairs of numbered images far apart were taken and refused; empty where there are none."""
    if not loops:
        return ""
    pairs = sum(loop.num_pairs for loop in loops)
    lost = sum(loop.num_refused for loop in loops)
    said = f"{counted(pairs, 'pair')} far apart in their order"
    if not lost:
        return f"{said}, used as the images between say the same"
    worst = max(loops, key=lambda loop: (loop.num_refused, loop.num_matches))
    are, them = ("is", "it") if lost == 1 else ("are", "them")
    return (
        f"{said}, of which {lost} {are} not used, as the images between contradict {them} "
        f"(sequence=none uses all), above all from {_stretch(worst.first)} to {_stretch(worst.second)}"
    )


def describe_line(sigma: float | None) -> str:
    """Say how well lengths along a straight drive are known; empty where cameras do not stand on a line."""
    if sigma is None:
        return ""
    return (
        "the cameras stand on one line, along which only points determine lengths: positions along it are "
        f"known to {100.0 * sigma:.2g}% of its length (standard deviation)"
    )


def describe_repeated_pairs(count: int) -> str:
    """Say that pairs of a folded arrangement were not followed."""
    return (
        "the scene repeats itself: pairs that would fold the images together were not followed "
        f"({counted(count, 'pair')}), as they lack matches that such pairs should share"
    )


def describe_rival_pairs(count: int) -> str:
    """Say that another arrangement of the images is as likely."""
    return (
        f"the images can be arranged in another way that {counted(count, 'other pair')} speak for, with as "
        "much evidence: the scene repeats itself; look whether parts of it are folded together"
    )


def _stretch(frames: Sequence[str]) -> str:
    """Name a stretch of a video by its first and last frame."""
    first, last = frames
    return first if first == last else f"{first} \N{EN DASH} {last}"
