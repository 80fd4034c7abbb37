"""How names and numbers are said: the first of many, counts with their noun, figures."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

_NAMED = 3  # names; a longer list is counted, so that a sentence stays one
_MOST_PX = 10_000  # pixels; a larger error says that the pose is wrong, and no more
_FEWEST = 3  # images of a folder or clip; fewer are named one by one


def first_of(names: Sequence[str]) -> str:
    """Return the first three names and how many more there are."""
    more = f" and {len(names) - _NAMED:,} more" if len(names) > _NAMED else ""
    return f"{', '.join(names[:_NAMED])}{more}"


def reasons_by_place(reasons: Mapping[str, str], names: Sequence[str]) -> list[str]:
    """Return a line for each image and its reason, or for each folder or clip whose images all have one.

    Args:
        reasons: why, by the names of some images.
        names: all images. A clip has the images of a folder whose names differ by the last number alone.
    """
    sizes = Counter(place for name in names for place in _places(name))
    there = Counter(place for name in reasons for place in _places(name))
    whole = {place for place, n in there.items() if _FEWEST <= n == sizes[place] < len(names)}
    lines: dict[str, str] = {}
    for name, reason in reasons.items():
        place = next((place for place in _places(name) if place in whole), "")
        every = f"all {there[place]:,} images of {place}, {name} for one: {reason}"
        lines.setdefault(place or name, every if place else f"{name}: {reason}")
    return list(lines.values())


def _places(name: str) -> Iterator[str]:
    """Yield the folders that an image is in, the outermost first, and its clip."""
    yield from (name[: slash.end()] for slash in re.finditer("/", name))
    yield re.sub(r"\d+(?=\D*$)", "*", name)


def make_printable(text: str) -> str:
    """Return text without control characters: names come from strangers, and may move the cursor.

    Bytes of names that are no UTF-8, read as lone surrogates, are shown as \\xXX.
    """
    hidden = {c for c in text if not c.isprintable()}
    shown = {c: f"\\x{ord(c) - 0xDC00:02x}" for c in hidden if "\udc80" <= c <= "\udcff"}
    return text.translate({ord(c): shown.get(c, "\N{REPLACEMENT CHARACTER}") for c in hidden})


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the singular for one."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def counted_are(number: int, noun: str) -> str:
    """Return a number with its noun and the verb that follows: is for one, else are."""
    return f"{counted(number, noun)} {'is' if number == 1 else 'are'}"


def are(names: Sequence[str]) -> str:
    """Return the number of cameras, the names of the first, and is for one, else are."""
    return f"{counted(len(names), 'camera')} ({first_of(names)}) {'is' if len(names) == 1 else 'are'}"


def rounded(value: float, smallest: float = 1e-9, digits: int = 4) -> str:
    """Return a number in so many digits; one that is smaller than `smallest` is 0."""
    if 10.0**digits <= abs(value) < 1e6:
        return f"{value:.0f}"  # no power of ten
    return "0" if abs(value) < smallest else f"{value:.{digits}g}"


def in_unit(length: float, unit: str, digits: int = 3) -> str:
    """Return a length with its unit, of meters in the one that suits it."""
    if unit != "m":
        return f"{length:.{digits}g} {unit}".rstrip()
    factor, unit = next((x for x in ((1e3, "mm"), (1e2, "cm")) if abs(length) * x[0] < 100.0), (1.0, "m"))
    return f"{rounded(factor * length, digits=digits)} {unit}"


def in_pixels(error_px: float, digits: int) -> str:
    """Return an error with so many decimals and its unit; points beside or behind a camera have huge ones."""
    return f"{error_px:.{digits}f} px" if error_px <= _MOST_PX else f"above {_MOST_PX:,} px"


def label_lens(camera: int, image: str, num_images: int) -> str:
    """Return a camera in COLMAP's sense by its id and one of its images, and how many others it took."""
    return f"camera {camera} ({image}{f' and {num_images - 1:,} more' if num_images > 1 else ''})"
