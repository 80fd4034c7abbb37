"""What `check` says of several models of one set of images: each one's grade, and which to keep."""

from pathlib import Path
from typing import Annotated

from sfm_shapefit.base.display import Displayed, NextStep, Row, Telling, row
from sfm_shapefit.base.record import Record
from sfm_shapefit.facts.model import CheckedFacts

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

    @property
    def kept(self) -> list[tuple[str, CheckedFacts]]:
        """The folders of the models to go on with, and what is said of them, most images first."""
        kept = [(one.folder, one.facts) for one in self.pieces if one.keep and one.facts]
        return sorted(kept, key=lambda one: -one[1].num_placed)

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
