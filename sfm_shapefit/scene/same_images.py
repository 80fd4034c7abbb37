r"""Which names of two programs are the same image.

One program writes `0001.jpg`, another `./images/0001.jpg` or `D:\data\0001.JPG`; one composes the letters of
`Zoë.jpg`, another does not.
"""

import re
import unicodedata
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import IntArray

_SLASH = re.compile(r"[/\\]")
_ABSOLUTE = re.compile(r"[/\\]|[A-Za-z]:[/\\]")
_MOST_FOLDERS = 64  # leading folders that are passed over; each costs a copy of the name
_MOST_SAID = 3  # names; a sentence with more is not read


class SameImages(NamedTuple):
    """Which of some other images each name is."""

    places: IntArray
    """(n,) place among the others; -1 where it is none of them, or may be several."""
    ambiguity: str
    """A clause about names that may be several images; empty if none is."""


def same_images(names: Sequence[str], others: Sequence[str]) -> SameImages:
    r"""Return which of the images `others` each of `names` is.

    Equal names are the same image. What is left over is the same where, with `\` as `/`, without `./` and in
    composed letters, both are equal or one is the other with further leading folders; then where that holds
    without regard to capital letters. The longest common part counts; where that is not one alone on both
    sides, the name is none of them. The folders of absolute paths are passed over where nothing else is
    common.
    """
    place_of = {name: place for place, name in enumerate(others)}
    places = np.array([place_of.get(name, -1) for name in names], dtype=np.int64)
    ambiguity, rules = "", [_plain, _folded]
    if all(map(_ABSOLUTE.match, names)) or all(map(_ABSOLUTE.match, others)):
        rules.append(_last_part)
    for rule in rules:
        is_open = not (places >= 0).all() and len(set(places.tolist()) - {-1}) < len(others)
        if is_open and (rule is not _last_part or (places < 0).all()):
            ambiguity = _match(places, names, others, rule) or ambiguity
    return SameImages(places, ambiguity)


def names_among(names: Iterable[str], others: Sequence[str]) -> tuple[dict[str, str], str]:
    """Return what each of some names is called among others, as far as it is there; and `ambiguity`."""
    listed = list(names)
    matched = same_images(listed, others)
    places = zip(listed, matched.places.tolist(), strict=True)
    return {name: others[place] for name, place in places if place >= 0}, matched.ambiguity


def _match(places: IntArray, names: Sequence[str], others: Sequence[str], rule: Callable[[str], str]) -> str:
    """Fill in the places of names that are one image alone by a rule; return a clause about the rest."""
    ours, theirs = (_grouped(map(rule, images)) for images in (names, others))
    chosen, chosen_back = _choices(ours, theirs), _choices(theirs, ours)
    taken, unclear = set(places.tolist()), []
    for key, images in ours.items():
        mutual = [one for one in chosen[key] if key in chosen_back[one]]
        found = [place for one in mutual for place in theirs[one]]
        if taken.issuperset(found) or (places[images] >= 0).all():
            continue
        rivals = chosen_back[mutual[0]]
        if len(images) == len(found) == len(rivals) == 1:
            places[images] = found
        else:
            unclear.append((rivals, mutual))
    if not unclear:
        return ""
    sides = zip(unclear[0], (ours, theirs), (names, others), strict=True)
    said = (sorted(images[k] for key in keys for k in places_of[key]) for keys, places_of, images in sides)
    more = f" (and {len(unclear) - 1} more)" if len(unclear) > 1 else ""
    return f"{' may be '.join(' or '.join(some[:_MOST_SAID]) for some in said)}{more}; give whole names"


def _choices(own: Collection[str], others: Collection[str]) -> dict[str, dict[str, None]]:
    """Return for each of some names the others that have most in common with it.

    That is its equal, else all that are it with leading folders, else the longest that it is with folders.
    """
    longer: dict[str | None, dict[str, None]] = {}
    for other in others:
        longer.setdefault(_first_tail(other, own), {})[other] = None
    chosen = {}
    for name in own:
        shorter = _first_tail(name, others)
        known = longer.get(name, {})
        if shorter == name or not known:
            known = {} if shorter is None else {shorter: None}
        chosen[name] = known
    return chosen


def _first_tail(name: str, names: Collection[str]) -> str | None:
    """Return the longest of some names that a name is with leading folders, or itself; None if none."""
    for _ in range(_MOST_FOLDERS):
        if name in names:
            return name
        _, slash, name = name.partition("/")
        if not slash:
            break
    return None


def _grouped(keys: Iterable[str]) -> dict[str, list[int]]:
    places: dict[str, list[int]] = {}
    for place, key in enumerate(keys):
        places.setdefault(key, []).append(place)
    return places


def _plain(name: str) -> str:
    r"""Return a name with `\` as `/`, without empty steps, in composed letters."""
    parts = _SLASH.split(unicodedata.normalize("NFC", name))
    return "/".join(part for part in parts if part not in ("", "."))


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", _plain(name).casefold())


def _last_part(name: str) -> str:
    return _folded(name).rpartition("/")[2]
