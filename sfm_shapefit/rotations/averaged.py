"""Rotations averaged from relative ones, and how far they can be believed."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.display import Displayed
from sfm_shapefit.base.record import Record
from sfm_shapefit.pairs.relative_rotations import AGREEMENT_DEG


class Averaging(Record):
    """How rotations were averaged, and how well they agree with the pairs."""

    statement: Annotated[str, "How the rotations were found, in words."]
    num_registered: Annotated[int, "Images that have a rotation."]
    num_pairs: Annotated[int, "Pairs whose residuals count."]
    agreeing_share: Annotated[float, "Share of the pairs, by the square root of their matches, that agree."]
    num_unsettled: Annotated[int, "Images that most of their pairs contradict, in every answer tried."]
    median_sigma_deg: Annotated[float | None, "Median standard deviation of a rotation; null if not known."]
    num_tried: Annotated[int, "Averagings of which this one is the most consistent."]
    certified: Annotated[
        bool | None, "Whether no rotations fit the kept pairs better; null if that was not checked."
    ]
    num_repeated_pairs: Annotated[
        int,
        "Pairs set aside since they would fold the images together, and lack matches that they should share.",
    ]
    num_rival_pairs: Annotated[int, "Pairs of another arrangement of the images that is as likely."]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class AveragedRotations(Displayed):
    """One answer of rotation averaging, and how far the pairs agree with it."""

    rotations: FloatArray
    """(n, 3, 3) cam_from_world, up to a common rotation of the world; the identity where there is none."""
    registered: BoolArray
    """(n,) which images have a rotation: those of the largest component of the pairs."""
    sigmas_deg: FloatArray
    """(n,) standard deviation of each rotation per axis, relative to the mean turn of all. It counts errors
    of pairs as independent; what they share, as errors of the calibration, comes on top. Infinite where the
    pairs that agree do not tie the image to the largest part of the others, NaN without rotation."""
    agreements: FloatArray
    """(n,) share of the weight of each image's pairs that agrees within 5 degrees; NaN without pairs."""
    best_agreements: FloatArray
    """(n,) the largest such share in any answer that was tried."""
    share: float
    """Share of the weight of all pairs of registered images that agrees within 5 degrees."""
    num_pairs: int
    """Pairs whose residuals count in the answer."""
    num_tried: int = 1
    """How many answers it was chosen from."""
    counts_mislead: bool = False
    """Whether numbers of matches were set aside, with which fewer pairs agree; see `rotations.average`."""
    num_repeated: int = 0
    """Pairs that most matches speak for, and that are set aside as repeated structure, see `arrangements`."""
    num_rivals: int = 0
    """Pairs of another arrangement that the matches speak for as much as for this one."""
    certified: bool | None = None
    """Whether no rotations fit the kept pairs, with their final weights, better than those next to these, see
    `rotations.dual_certificate`. It does not say that these are the right pairs. None if not checked."""
    certainty_estimated: bool = False
    """Whether `certified` rests on an estimated eigenvalue, as on expanders, and is thus no proof."""

    @property
    def unsettled(self) -> BoolArray:
        """Which images have a rotation that most of their pairs contradict, in every answer tried, (n,)."""
        return np.asarray(self.registered & (self.best_agreements < 0.5))

    def subset(self, images: BoolArray | IntArray) -> "AveragedRotations":
        """Return the answer for some of the images, in their order."""
        return replace(
            self,
            rotations=self.rotations[images],
            registered=self.registered[images],
            sigmas_deg=self.sigmas_deg[images],
            agreements=self.agreements[images],
            best_agreements=self.best_agreements[images],
        )

    def turned(self, frames: IntArray, sensor_rotations: FloatArray) -> "AveragedRotations":
        """Return the answer for images by their frames (m,) and the rotations of their sensors (m, 3, 3)."""
        chosen = self.subset(frames)
        return replace(chosen, rotations=sensor_rotations @ chosen.rotations)

    @property
    def statement(self) -> str:
        """How the rotations were found, for the user."""
        tried = f", the most consistent of {self.num_tried} tried" if self.num_tried > 1 else ""
        if self.counts_mislead:
            tried += ", without numbers of matches, with which fewer pairs agree"
        text = (
            f"averaged over {self.num_pairs} pairs{tried}; {self.share:.0%} of the pairs' weight agrees "
            f"within {AGREEMENT_DEG:g} deg"
        )
        if self.certified is None:
            return text
        if self.certified and self.certainty_estimated:
            return (
                f"{text}; by an estimated eigenvalue, which is no proof, the best for the pairs that are kept"
            )
        proof = "proved to be the best for" if self.certified else "not proved to be the best for"
        return f"{text}; {proof} the pairs that are kept"

    @property
    def facts(self) -> Averaging:
        """What is told of the answer."""
        known = self.sigmas_deg[np.isfinite(self.sigmas_deg)]
        return Averaging.taken_from(
            self,
            num_registered=int(self.registered.sum()),
            agreeing_share=self.share,
            num_unsettled=int(self.unsettled.sum()),
            median_sigma_deg=float(np.median(known)) if len(known) else None,
            num_repeated_pairs=self.num_repeated,
            num_rival_pairs=self.num_rivals,
        )

    def _headline(self) -> str:
        return (
            f"rotations of {int(self.registered.sum())} of {len(self.registered)} images, "
            f"{self.share:.0%} of the pairs' weight agrees"
        )
