"""Matches for a model without a database: features of its pictures, and matches of chosen pairs of them.

The matches are in a database of their own in a temporary folder, which is gone in the end; nothing is written
to the folders of the user.
"""

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.paths import refuse_no_folder
from sfm_shapefit.base.wording import counted
from sfm_shapefit.facts.result import Inputs
from sfm_shapefit.files.colmap.model import ColmapModel
from sfm_shapefit.files.colmap.picture_matches import PictureMatches, read_descriptors
from sfm_shapefit.files.colmap.track_matches import TrackMatches
from sfm_shapefit.judgement.chosen_pairs import NUM_DESCRIBED, Shared, choose_pairs

_FOR_FEATURES = 0.6  # share of the minutes; features take half of the time where there is no limit
_WHY_ASKED = {
    "neighbors": "near in pose",
    "shared": "with many common points",
    "unshared": "near without common points",
    "alike": "that look alike",
    "seams": "across a weak link",
    "others": "further",
}
"""What is said of a pair by why it was chosen."""


@contextmanager
def match_pictures(
    model: ColmapModel, folder: Path, max_minutes: float | None, clock: Clock
) -> Iterator[Inputs]:
    """Yield the inputs that a model's pictures in a folder make: a database, which is gone afterwards.

    Raises:
        InputError: if fewer than two pictures can be read.
    """
    refuse_no_folder(folder)
    began, minutes = time.monotonic(), np.inf if max_minutes is None else max_minutes
    with TemporaryDirectory(prefix="shapefit-") as scratch:
        path = Path(scratch) / "database.db"
        pictures = PictureMatches(model=model, database=path, threads=clock.threads)
        with clock("features"):
            states = pictures.detect(
                folder, lambda: time.monotonic() > began + 60.0 * _FOR_FEATURES * minutes, clock.advance
            )
        _refuse_no_pictures(folder, model.images.names, states)
        tracks = TrackMatches(model)
        shared = Shared(tracks.pairs, tracks.num_matches)
        chosen = choose_pairs(
            model.images, shared, read_descriptors(path, NUM_DESCRIBED, model.images.ids.tolist())
        )
        with clock("matches"):
            count = pictures.match(
                chosen.pairs, lambda: time.monotonic() > began + 60.0 * minutes, clock.advance
            )
        pictures.name_images()
        statement = _state(folder, states, chosen.reasons, count)
        rows, names = chosen.pairs[~chosen.is_near].tolist(), model.images.names
        far = frozenset((min(names[i], names[j]), max(names[i], names[j])) for i, j in rows)
        yield Inputs(folder=None, database=path, statement=statement, images=folder, far=far)


def _refuse_no_pictures(folder: Path, names: Sequence[str], states: Sequence[str]) -> None:
    """Raise InputError if hardly a picture can be asked."""
    if states.count("asked") >= 2:
        return
    raise InputError(
        f"{folder} has no two pictures of this model ({_whys(states)}); give the folder in which the names "
        f"of its images begin, such as {names[0]}"
    )


def _state(folder: Path, states: Sequence[str], reasons: Sequence[str], count: int) -> str:
    """Say what was asked, why, and what was not."""
    others = _whys(states)
    without = f" ({others})" if others else ""
    pairs = counted(count, "pair") if count == len(reasons) else f"{count:,} of {len(reasons):,} chosen pairs"
    num_asked = states.count("asked")
    pictures = f"{num_asked:,} of {counted(len(states), 'picture')}{without} in {folder}"
    return f"{pictures}, {pairs}: {_whys([_WHY_ASKED[why] for why in reasons[:count]])}"


def _whys(whys: Sequence[str]) -> str:
    """Say how often each reason is given, but for that of pictures which were asked."""
    return ", ".join(f"{num:,} {why}" for why, num in Counter(whys).items() if why != "asked")
