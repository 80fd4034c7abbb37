"""What `check` says of several models of one set of images: each one's grade, and which to keep."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Annotated, Self

import numpy as np

from sfm_shapefit.base.arrays import distinct
from sfm_shapefit.base.display import Displayed, NextStep, Row, Telling, row
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import counted
from sfm_shapefit.facts.model import CheckedFacts
from sfm_shapefit.judgement.limits import LOCAL_SHARE, RIVAL_SHARE
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.sequences import find_sequences

_HEADS = ("model", "images", "points", "picture widths", "verdict")


class CheckedPiece(Record):
    """One of several models of a folder."""

    folder: Annotated[str, "Its folder."]
    focal_widths: Annotated[
        tuple[float, ...], "Least and largest focal length, over the longer side of the picture."
    ] = ()
    keep: Annotated[bool, "Whether to go on with it."] = False
    error: Annotated[str, "Why it cannot be read; empty if it can."] = ""
    facts: Annotated[CheckedFacts | None, "What check says of it alone; null if it cannot be read."] = None

    @classmethod
    def of_model(cls, folder: str, images: Images, facts: CheckedFacts) -> Self:
        """Return a model in a folder, of some images, with what `check` says of it."""
        widths = images.focal_widths
        return cls(folder=folder, focal_widths=(float(widths.min()), float(widths.max())), facts=facts)

    @property
    def cells(self) -> tuple[str, ...]:
        """What the table says of it."""
        facts = self.facts
        if facts is None:
            return (Path(self.folder).name, "", "", "", f"cannot be read: {self.error}")
        least, most = (f"{value:.3g}" for value in self.focal_widths)
        lens = least if least == most else f"{least} to {most}"
        verdict = ": ".join([facts.verdict.grade.value, *facts.verdict.reasons[:1]])
        return (Path(self.folder).name, f"{facts.num_placed:,}", f"{facts.num_points:,}", lens, verdict)


class CheckedPieces(Record, Displayed, repr=False):
    """What `sfm-shapefit check --json` prints of a folder of several models."""

    pieces: Annotated[tuple[CheckedPiece, ...], "The models, in the order of their numbers."]
    contradictions: Annotated[tuple[str, ...], "What of them contradicts, or says the same, a sentence each."]

    @classmethod
    def compare(cls, pieces: Sequence[CheckedPiece], images: Mapping[str, Images]) -> Self:
        """Return which models to keep, and where they contradict one another; `images` are by the folder."""
        keep = set(_choose_kept(pieces, images))
        kept = tuple(replace(one, keep=one.folder in keep) for one in pieces)
        return cls(pieces=kept, contradictions=(*_compare_lenses(images), *_shared_images(images)))

    @property
    def kept(self) -> list[tuple[str, CheckedFacts]]:
        """The folders of the models to go on with, and what is said of them, most images first."""
        kept = [(one.folder, one.facts) for one in self.pieces if one.keep and one.facts]
        return sorted(kept, key=lambda one: -one[1].num_placed)

    @property
    def has_matches(self) -> bool:
        """Whether those to be kept were compared with matches, and not with their own tracks alone."""
        return all(facts.has_matches for _, facts in self.kept)

    def _headline(self) -> str:
        return f"{len(self.kept)} of {len(self.pieces)} models to keep"

    @property
    def told(self) -> Telling:
        """What the terminal says."""
        table = [_HEADS, *(one.cells for one in self.pieces)]
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        lines = ["  ".join(map(str.ljust, cells, widths)).rstrip() for cells in table]
        names = ", ".join(folder for folder, _ in self.kept) or "none; look at each by itself"
        rows = [Row("warning", self.contradictions), row("keep", names)]
        first = self.kept[0][1].next_step if self.kept else NextStep("", "")
        return Telling(lines, rows, elsewhere="see --json", step=first)


def _choose_kept(pieces: Sequence[CheckedPiece], images: Mapping[str, Images]) -> Iterator[str]:
    usable = [p for p in pieces if p.facts and p.facts.verdict.grade in (Grade.GOOD, Grade.LOOK)]
    taken = set[str]()
    for one in sorted(usable, key=lambda one: -images[one.folder].num_images):
        names = set(images[one.folder].names)
        if len(names - taken) >= RIVAL_SHARE * len(names):
            taken |= names
            yield one.folder


def _compare_lenses(images: Mapping[str, Images]) -> Iterator[str]:
    """Yield where models disagree on the focal length of one device."""
    names = [name for one in images.values() for name in one.names]
    widths = np.concatenate([one.focal_widths for one in images.values()])
    model = np.repeat(np.arange(len(images)), [one.num_images for one in images.values()])
    for rows, _ in find_sequences(names):
        members = distinct(model[rows])
        typical = np.array([np.median(widths[rows][model[rows] == k]) for k in members])
        if np.ptp(np.log(typical)) > LOCAL_SHARE:
            least, most = (Path([*images][members[k]]).name for k in (typical.argmin(), typical.argmax()))
            yield (
                f"one device, as {names[rows[0]]} and others say, has a focal length of {typical.min():.3g} "
                f"picture widths in {least} and of {typical.max():.3g} in {most}: give its images one camera "
                "(--ImageReader.single_camera 1), and reconstruct again"
            )


def _shared_images(images: Mapping[str, Images]) -> Iterator[str]:
    for (one, mine), (other, others) in combinations(images.items(), 2):
        if common := len(set(mine.names) & set(others.names)):
            both = f"{Path(one).name} and {Path(other).name} have {counted(common, 'image')} in common"
            yield f"{both}; sfm-shapefit join puts them into one world"
