"""Evidence that the fit did not use, at the levels of the image, the camera and the group."""

from collections.abc import Sequence
from dataclasses import field, replace
from typing import Annotated, NamedTuple, Self

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.geometry import extent_of
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import are, counted, first_of
from sfm_shapefit.judgement.limits import CHANCE_SHARE, RIVAL_SHARE
from sfm_shapefit.judgement.places import AmbiguousPlace
from sfm_shapefit.judgement.reasons import Grade, Kind
from sfm_shapefit.judgement.seams import CameraGroup, GroupApart
from sfm_shapefit.judgement.second_opinion import SecondOpinion
from sfm_shapefit.judgement.ties import UntiedGroup
from sfm_shapefit.judgement.uncertainty import standard_deviations
from sfm_shapefit.judgement.wrong_lenses import ContradictedLens
from sfm_shapefit.scene.images import Images

_NO_OPINION = SecondOpinion(num_common=0, usual=0.0, num_for=0, num_against=0)


class OddImages(Record):
    """Images that hardly can be as the model has them: through such a lens, or at such a place."""

    images: Annotated[tuple[str, ...], "Their names."]
    what: Annotated[str, "What each of them has: a lens or a place, and what is odd about it."]
    cannot_be: Annotated[bool, "Whether that is impossible, and not only unusual."]
    kind: Kind
    """Whether it is the lens of each, or its place."""
    of_each: tuple[str, ...]
    """What each of them has by itself."""

    @classmethod
    def of_values(
        cls, kind: Kind, names: tuple[str, ...], values: FloatArray, sentence: str, *, cannot_be: bool = False
    ) -> Self:
        """Return what is odd about images of k names: a sentence with {} for the value of each, (k,)."""
        told = [f"{value:,.{0 if value >= 10.0 else 2}f}" for value in values.tolist()]
        ends = told[int(values.argmin())], told[int(values.argmax())]
        return cls(
            images=names,
            what=sentence.format(" to ".join(dict.fromkeys(ends))),
            cannot_be=cannot_be,
            kind=kind,
            of_each=tuple(map(sentence.format, told)),
        )

    @property
    def statement(self) -> str:
        """The same in a sentence."""
        has = "has" if len(self.images) == 1 else "have"
        return f"{counted(len(self.images), 'image')} ({first_of(self.images)}) {has} {self.what}"


class LensField(NamedTuple):
    """Mean residuals of a lens in c cells of its picture."""

    label: str
    aspect: float
    """Width of the picture over its height."""
    places: FloatArray
    """(c, 2) middles of the cells, as shares of width and height."""
    means_px: FloatArray
    """(c, 2)"""
    statement: str
    """What they say of the lens, in a sentence."""
    images: IntArray
    """(k,) rows of the images that it took."""
    outward_px: float = 0.0
    """Mean part along the radius in the ring where that is largest; 0 where it is no pattern of note."""


class OpenShape(Record):
    """How far a model goes at equal fit once lenses, which nothing measured, and rotations are free."""

    images: Annotated[tuple[str, ...], "Images whose centers it leaves open by more than 5 % of the extent."]
    largest: Annotated[float, "Largest standard deviation of a center by that, as a share of the extent."]
    covariances: FloatArray
    """Covariances (n, 3, 3) of the centers by that, in squared units; 0 without a pose."""

    @classmethod
    def of_images(cls, images: Images, rows: IntArray, left_open: FloatArray) -> Self:
        """Return what is left open of the posed images, covariances (r, 3, 3) by their rows (r,)."""
        covariances = np.zeros((images.num_images, 3, 3))
        covariances[rows] = left_open
        sigmas = standard_deviations(left_open).max(axis=1) / extent_of(images.centers[rows])
        names = images.names_of(np.sort(rows[sigmas > CHANCE_SHARE]))
        return cls(images=names, largest=float(sigmas.max()), covariances=covariances)

    @property
    def statement(self) -> str:
        """The same in a sentence."""
        return (
            f"the points leave open where {are(self.images)}: with lenses and rotations free "
            f"they fit as well {how_far(self.largest)} away; calibrate the cameras, or add images that turn "
            "and cross"
        )


def how_far(share: float) -> str:
    """Say a share of the extent."""
    return f"by {share:.0%} of the extent" if share <= 1.0 else "by more than the extent"


class ModelEvidence(Record):
    """Evidence that the fit did not use, against lenses, cameras and groups by name."""

    lenses: Annotated[tuple[ContradictedLens, ...], "Lenses whose images ask for another focal length."] = ()
    odd: Annotated[
        tuple[OddImages, ...], "Images with lenses that hardly can be, or that stand far from all others."
    ] = ()
    places: Annotated[tuple[AmbiguousPlace, ...], "Cameras that two sets of pairs put at two places."] = ()
    seams: Annotated[tuple[GroupApart, ...], "Groups of cameras that stand apart from the rest."] = ()
    untied: Annotated[tuple[UntiedGroup, ...], "Groups of cameras that little ties to the rest."] = ()
    contradicted: Annotated[tuple[str, ...], "Images that many pairs contradict, and no points confirm."] = ()
    second: Annotated[SecondOpinion | None, "How another model of the same matches compares."] = None
    shape: Annotated[
        OpenShape | None, "How far the points leave the shape open; null where lenses are measured."
    ] = None
    contradictions: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Pairs of each contradicted image that have a direction, and those of these that contradict it."""
    num_held: int | None = None
    """Cameras of the largest group that agreeing pairs, or points that fit, hold; None without pairs."""
    sides: tuple[int, int] = (0, 0)
    """Pairs that agree, and that contradict."""
    fields: tuple[LensField, ...] = ()
    """Mean residuals of the lenses with most images, which the report draws."""

    def beside(self, second: SecondOpinion, contradicting: Sequence[tuple[str, str]]) -> "ModelEvidence":
        """Return the same with a second opinion, without what that clears, by the pairs that contradict.

        A group most of which is alike in both is right if the other model is good, or if most pairs that
        contradict it are of cameras that stand elsewhere, in it or not; these are named by themselves.
        """
        elsewhere = {*second.wrong, *second.undecided}

        def may_be_wrong(group: CameraGroup) -> bool:
            inside = frozenset(group.images)
            across = [pair for pair in contradicting if (pair[0] in inside) != (pair[1] in inside)]
            of_these = sum(not elsewhere.isdisjoint(pair) for pair in across)
            is_cleared = second.grade is Grade.GOOD or of_these > RIVAL_SHARE * len(across)
            return not (second.has_most_alike(group.images) and is_cleared)

        return replace(
            self,
            places=tuple(one for one in self.places if one.image not in second.confirmed),
            contradicted=tuple(name for name in self.contradicted if name not in second.confirmed),
            seams=tuple(filter(may_be_wrong, self.seams)),
            untied=tuple(filter(may_be_wrong, self.untied)),
            second=second,
        )

    @property
    def opinion(self) -> SecondOpinion:
        """The second opinion, or one that says nothing."""
        return self.second or _NO_OPINION

    @property
    def apart(self) -> list[tuple[str, ...]]:
        """The members of each group that stands apart, or that little ties to the rest."""
        return [group.images for group in (*self.seams, *self.untied)]

    @property
    def statements(self) -> list[str]:
        """A sentence for each."""
        more = [lens.label for lens in self.lenses[1:]]
        others = f"; likewise that of {first_of(more)}" if more else ""
        told = [
            *(one.statement for one in self.odd),
            *(one.statement for one in self.seams),
            *(one.statement for one in self.untied),
            *(one.statement for one in self.places),
            *([self.lenses[0].statement + others] if self.lenses else []),
        ]
        second = self.opinion
        if second.wrong or second.undecided or second.ambiguous:
            told.append(second.statement)
        if self.shape is not None and self.shape.images:
            told.append(self.shape.statement)
        if self.contradicted:
            told.append(
                f"{are(self.contradicted)} contradicted by many pairs, and no points confirm the place"
            )
        return told
