"""What is told of a scene: loops of videos, straight drives, repeated structure, and known distances."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import numpy as np

from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import counted
from sfm_shapefit.rotations.sequences import Loop
from sfm_shapefit.scene.images import Images

if TYPE_CHECKING:
    from sfm_shapefit.placement.gauge_options import KnownDistance


class DistanceFacts(Record):
    """A distance that the user gave."""

    first: Annotated[str, "Name of an image."]
    second: Annotated[str, "Name of another."]
    known: Annotated[float, "Distance that the user gave."]
    found: Annotated[float | None, "Distance in the output; null if one of them is not in it."]


def told_distances(known: "Sequence[KnownDistance]", images: Images) -> tuple[DistanceFacts, ...]:
    """Return the distances that were told, each with what a model has."""
    posed = np.flatnonzero(images.is_posed) if known else np.zeros(0, dtype=np.int64)
    centers = dict(zip(images.names_of(posed), images.centers[posed], strict=True))
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
    said = f"{counted(pairs, 'pair')} of images far apart in their order"
    if not lost:
        return f"{said}, all used: the images between agree with them"
    worst = max(loops, key=lambda loop: (loop.num_refused, loop.num_matches))
    are, them = ("is", "it") if lost == 1 else ("are", "them")
    return (
        f"{said}, of which {lost} {are} not used, as the images between contradict {them} "
        f"(sequence=none uses all), above all from {worst.stretches[0]} to {worst.stretches[1]}"
    )


def describe_line(sigma: float | None) -> str:
    """Say how well lengths along a straight drive are known; empty where cameras do not stand on a line."""
    if sigma is None:
        return ""
    return (
        "the cameras are on one line, along which only points determine lengths: positions along it are "
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
