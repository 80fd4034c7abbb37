"""Loops of videos, straight drives and doubtful pairs, in words that terminal and report share."""

from collections.abc import Sequence

from sfm_shapefit.base.wording import counted
from sfm_shapefit.facts.json_types import LoopOfVideo


def describe_loops(loops: Sequence[LoopOfVideo]) -> str:
    """Say how many pairs far apart in time were taken and refused; empty where there are none."""
    if not loops:
        return ""
    pairs = sum(loop["num_pairs"] for loop in loops)
    lost = sum(loop["num_refused"] for loop in loops)
    said = f"{counted(pairs, 'pair')} of frames far apart in time"
    if not lost:
        return f"{said}, taken as the frames between say the same"
    worst = max(loops, key=lambda loop: (loop["num_refused"], loop["num_matches"]))
    return (
        f"{said}, {lost} refused as the frames between contradict {'it' if lost == 1 else 'them'}: above all "
        f"from {_stretch(worst['first'])} to {_stretch(worst['second'])}"
    )


def describe_line(sigma: float | None) -> str:
    """Say how well lengths along a straight drive are known; empty where cameras do not stand on a line."""
    if sigma is None:
        return ""
    return (
        "the cameras stand on one line, along which points alone tell lengths: positions along it are known "
        f"to {100.0 * sigma:.2g}% of its length (standard deviation)"
    )


def describe_doubtful_pairs(count: int) -> str:
    """Say what to do with pairs that look like repeated structure; empty where there are none."""
    if not count:
        return ""
    if count == 1:
        return (
            "1 pair in use looks like repeated structure, though no position contradicts it; --without "
            "doubtful_pairs.csv leaves it out"
        )
    return (
        f"{count} pairs in use look like repeated structure, though no position contradicts them; --without "
        "doubtful_pairs.csv leaves them out"
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


def loop_cells(loop: LoopOfVideo) -> list[str]:
    """Return the cells of a loop's row: its two stretches, pairs, matches, angle, what became of it."""
    refused, total = loop["num_refused"], loop["num_pairs"]
    fate = "taken" if refused == 0 else "refused" if refused == total else f"taken but for {refused}"
    angle = f"{loop['angle_deg']:.2g} deg (up to {loop['tolerance_deg']:.2g} agree)"
    return [
        _stretch(loop["first"]),
        _stretch(loop["second"]),
        str(total),
        str(loop["num_matches"]),
        angle,
        fate,
    ]


def _stretch(frames: Sequence[str]) -> str:
    """Name a stretch of a video by its first and last frame."""
    first, last = frames
    return first if first == last else f"{first} \N{EN DASH} {last}"
