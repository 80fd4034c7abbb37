"""What evidence that the fit did not use says against a model: lenses, places and seams, by name."""

from typing import Annotated, Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import counted, first_of, rounded
from sfm_shapefit.facts.intrinsics import label_lens
from sfm_shapefit.judgement.evidence import ModelEvidence, OpenShape, SecondOpinion, how_far
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.judgement.seams import Seam
from sfm_shapefit.judgement.ties import Untied
from sfm_shapefit.judgement.wrong_lenses import WrongLens
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import ADJUSTED_ELSEWHERE

_UNLIKE = 2.0  # scatters of what images ask for; a mean that is nearer names no other focal length
_LEAST_TOLD = 1e-5  # share of the spread; a smaller difference is not told as a number


class ContradictedLens(Record):
    """A lens whose images, left out one by one, ask for another focal length."""

    camera: Annotated[int, "Its id in the model."]
    image: Annotated[str, "The first of its images."]
    num_images: Annotated[int, "Images that were asked."]
    focal_px: Annotated[float, "Mean focal length of the model."]
    asked_focal_px: Annotated[float, "Focal length that its images ask for, the median one."]
    asked_sigma_px: Annotated[
        float, "Standard deviation of it: by the noise for one image or two, by the scatter over more."
    ]
    remedy: Annotated[str, "What to do about it, or what has been done."]

    @property
    def label(self) -> str:
        """Its id, and the images by which a user knows it."""
        return label_lens(self.camera, self.image, self.num_images)

    @property
    def statement(self) -> str:
        """The same in a sentence."""
        asked = f"{self.asked_focal_px:,.0f} ± {self.asked_sigma_px:,.0f} px"
        if abs(self.asked_focal_px - self.focal_px) < _UNLIKE * self.asked_sigma_px:
            return (
                f"the focal length of {self.label}, {self.focal_px:,.0f} px, is doubtful: its "
                f"{self.num_images} images ask for unlike ones by the points that the others make ({asked}), "
                "so that the lens or the places of images are wrong"
            )
        who = "its image asks" if self.num_images == 1 else f"its {self.num_images} images ask"
        return (
            f"the focal length of {self.label} is wrong: {who} for {asked}, not {self.focal_px:,.0f} "
            f"px, by the points that the others make; its images stand wrong by that: {self.remedy}"
        )


class AmbiguousPlace(Record):
    """A camera that two sets of pairs put at two places."""

    image: Annotated[str, "Its name."]
    num_here: Annotated[int, "Pairs that put it where it is."]
    num_there: Annotated[int, "Pairs that agree on the other place."]
    offset: Annotated[tuple[float, ...], "The other place minus this one, in axes and units of the output."]

    @property
    def statement(self) -> str:
        """The same in a sentence."""
        away = f"{self.num_there} put it {np.linalg.norm(self.offset):.3g} units away"
        if not self.num_here:
            return f"no pair puts {self.image} where it is, {away}"
        here = f"{counted(self.num_here, 'pair')} put{'s' if self.num_here == 1 else ''}"
        return (
            f"{here} {self.image} where it is, {away}: the scene repeats itself, or one of the sets is wrong"
        )


class OddImages(Record):
    """Images that hardly can be as the model has them: through such a lens, or at such a place."""

    images: Annotated[tuple[str, ...], "Their names."]
    what: Annotated[str, "What each of them has: a lens or a place, and what is odd about it."]
    cannot_be: Annotated[bool, "Whether that is impossible, and not only unusual."]

    @property
    def statement(self) -> str:
        """The same in a sentence."""
        has = "has" if len(self.images) == 1 else "have"
        return f"{counted(len(self.images), 'image')} ({first_of(self.images)}) {has} {self.what}"


class _Group(Record):
    """A group of cameras, and the pairs between it and the rest."""

    images: Annotated[tuple[str, ...], "Names of its members."]
    num_agreeing: Annotated[int, "Pairs between it and the rest that agree."]
    num_contradicting: Annotated[int, "Pairs between it and the rest that contradict."]


class GroupApart(_Group):
    """A group of cameras that agree with one another, and stand apart from the rest."""

    num_turned: Annotated[int, "Contradicting pairs that agree on one turn of the group."]
    turn_deg: Annotated[float | None, "Angle of that turn; null without any."]

    @property
    def statement(self) -> str:
        """The same in a sentence."""
        turn = f"; {self.num_turned} agree on a turn by {self.turn_deg:.0f} deg" if self.num_turned else ""
        return (
            f"{len(self.images)} cameras stand apart from the rest ({first_of(list(self.images))}): "
            f"{counted(self.num_agreeing, 'pair')} between them and the rest agree, {self.num_contradicting} "
            f"contradict{turn}; either side may be the wrong one"
        )


class UntiedGroup(_Group):
    """A group of cameras that so little ties to the rest that nothing checks how it stands to it."""

    num_points: Annotated[int, "Points of three images or more that both see, and that fit."]
    is_loose: Annotated[bool, "Whether these do not even say how it stands to the rest."]

    @property
    def statement(self) -> str:
        """The same in a sentence."""
        does = "says" if self.is_loose else "checks"
        agree = f"{counted(self.num_agreeing, 'pair')} and {counted(self.num_points, 'point')}"
        against = f"{counted(self.num_contradicting, 'pair')} contradict"
        return (
            f"nothing {does} how {_cameras(self.images)} to the rest: {agree} between them agree, {against}; "
            "match more images across"
        )


class ToldOpinion(Record):
    """How the model compares with another one of the same matches, which took nothing of it."""

    num_common: Annotated[int, "Cameras of both."]
    usual: Annotated[float, "Median distance between both, over the median one of cameras from their middle."]
    wrong: Annotated[tuple[str, ...], "Images that stand elsewhere there, which pairs support."]
    undecided: Annotated[tuple[str, ...], "Images that stand elsewhere there, where pairs support neither."]
    num_for: Annotated[int, "Pairs that support this model against the other, of wrong images."]
    num_against: Annotated[int, "Pairs of these that support the other."]
    ambiguous: Annotated[
        tuple[str, ...], "Images that stand there too, though matches suit another place or rotation."
    ]
    has_nothing_in_common: Annotated[
        bool, "Whether the two have different shapes, and nothing says whose is right."
    ]
    grade: Annotated[Grade, "What the other model is worth by itself."] = Grade.LOOK
    folder: Annotated[str, "Where it stands among the models that map makes of the database."] = "0"

    @property
    def is_alike(self) -> bool:
        """Whether all its cameras stand where the model has them."""
        return not (self.wrong or self.undecided or self.has_nothing_in_common)

    @property
    def statement(self) -> str:
        """The same in a sentence."""
        by = "in the model that map made of the same matches"
        parts = []
        if self.wrong:
            parts.append(
                f"{_cameras(self.wrong)} elsewhere {by}: "
                f"{counted(self.num_against, 'pair')} support that, {self.num_for} this model"
            )
        if self.undecided:
            parts.append(f"{_cameras(self.undecided)} elsewhere {by}, and pairs support neither")
        if self.ambiguous:
            where = f"{_cameras(self.ambiguous)} in the same place {by}"
            parts.append(f"{where}, but at least half as much speaks for another place or rotation")
        percent = rounded(100.0 * self.usual, digits=2) if self.usual > _LEAST_TOLD else "less than 0.001"
        usual = f"positions differ by {percent} % of their spread, median"
        if self.has_nothing_in_common:
            return f"{self.num_common} cameras have nothing in common with where they stand {by} ({usual})"
        told = "; ".join(parts) or f"{self.num_common} cameras stand in the same place {by}"
        return f"{told} ({usual})"


class ToldShape(Record):
    """How far a model goes at equal fit once lenses, which nothing measured, and rotations are free."""

    images: Annotated[tuple[str, ...], "Images whose centers it leaves open by more than 5 % of the extent."]
    largest: Annotated[float, "Largest standard deviation of a center by that, as a share of the extent."]

    @property
    def statement(self) -> str:
        """The same in a sentence."""
        return (
            f"the points leave open where {counted(len(self.images), 'camera')} "
            f"stand{'s' * (len(self.images) == 1)} ({first_of(self.images)}): with lenses and rotations free "
            f"they fit as well {how_far(self.largest)} away; calibrate the cameras, or add images that turn "
            "and cross"
        )


class ToldEvidence(Record):
    """Evidence that the fit did not use, against lenses, cameras and groups by name."""

    lenses: Annotated[tuple[ContradictedLens, ...], "Lenses whose images ask for another focal length."] = ()
    odd: Annotated[
        tuple[OddImages, ...], "Images with lenses that hardly can be, or that stand far from all others."
    ] = ()
    places: Annotated[tuple[AmbiguousPlace, ...], "Cameras that two sets of pairs put at two places."] = ()
    seams: Annotated[tuple[GroupApart, ...], "Groups of cameras that stand apart from the rest."] = ()
    untied: Annotated[tuple[UntiedGroup, ...], "Groups of cameras that little ties to the rest."] = ()
    contradicted: Annotated[tuple[str, ...], "Images that many pairs contradict, and no points confirm."] = ()
    second: Annotated[ToldOpinion | None, "How another model of the same matches compares."] = None
    shape: Annotated[
        ToldShape | None, "How far the points leave the shape open; null where lenses are measured."
    ] = None

    @property
    def apart(self) -> list[tuple[str, ...]]:
        """The members of each group that stands apart, or that little ties to the rest."""
        return [*(seam.images for seam in self.seams), *(group.images for group in self.untied)]

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
        second = self.second
        if second is not None and (second.wrong or second.undecided or second.ambiguous):
            told.append(second.statement)
        if self.shape is not None and self.shape.images:
            told.append(self.shape.statement)
        if self.contradicted:
            told.append(
                f"{_cameras(self.contradicted)} where many pairs contradict, and no points confirm it"
            )
        return told


def tell_evidence(
    evidence: ModelEvidence, images: Images, scale: float = 1.0, axes: FloatArray | None = None
) -> ToldEvidence:
    """Return what evidence says, by name of the images and of the lenses that they were asked for.

    Args:
        evidence, images: in one order.
        scale: from the units of the evidence to those of the output.
        axes: (3, 3) rotation from the axes of the evidence to those of the output; the same if None.
    """
    return ToldEvidence(
        lenses=tuple(_tell_lens(wrong, images) for wrong in evidence.lenses),
        odd=tuple(
            OddImages.taken_from(one, images=tuple(images.names[k] for k in one.cameras.tolist()))
            for one in evidence.oddities
        ),
        places=tuple(
            AmbiguousPlace.taken_from(
                found,
                image=images.names[found.camera],
                offset=tuple((scale * (found.offset if axes is None else axes @ found.offset)).tolist()),
            )
            for found in evidence.places
        ),
        seams=tuple(GroupApart(**_tell_group(seam, images)) for seam in evidence.seams),
        untied=tuple(UntiedGroup(**_tell_group(group, images)) for group in evidence.untied),
        contradicted=tuple(images.names[one.camera] for one in evidence.contradicted),
        second=None if evidence.second is None else _tell_opinion(evidence.second, images),
        shape=None if evidence.shape is None else _tell_shape(evidence.shape, images),
    )


def _tell_shape(shape: OpenShape, images: Images) -> ToldShape:
    return ToldShape(images=tuple(images.names[k] for k in shape.cameras.tolist()), largest=shape.largest)


def _tell_group(group: Seam | Untied, images: Images) -> dict[str, Any]:
    """Return all that is known of a group, its members by name."""
    told = group._asdict()
    return {"images": tuple(images.names[k] for k in told.pop("cameras").tolist()), **told}


def _tell_opinion(second: SecondOpinion, images: Images) -> ToldOpinion:
    told = second._asdict()
    del told["confirmed"]
    named = {
        key: tuple(images.names[k] for k in told[key].tolist()) for key in ("wrong", "undecided", "ambiguous")
    }
    return ToldOpinion(**told | named, has_nothing_in_common=second.has_nothing_in_common)


def _cameras(names: tuple[str, ...]) -> str:
    stand = "stands" if len(names) == 1 else "stand"
    return f"{counted(len(names), 'camera')} ({first_of(names)}) {stand}"


def _tell_lens(wrong: WrongLens, images: Images) -> ContradictedLens:
    lens = images.lenses[wrong.lens]
    asked_px, remedy = (
        wrong.factor * lens.focal_px,
        "intrinsics=focal lets it change, or calibrate that camera",
    )
    if not lens.is_adjustable:
        remedy = f"{ADJUSTED_ELSEWHERE}; or calibrate that camera"
    elif lens.origin is not None and lens.parameters != lens.given:
        remedy = "it was adjusted already, so calibrate that camera"
    return ContradictedLens(
        camera=lens.id,
        image=images.names[int(np.argmax(images.lens_of == wrong.lens))],
        num_images=wrong.num_images,
        focal_px=lens.focal_px,
        asked_focal_px=asked_px,
        asked_sigma_px=wrong.sigma * asked_px,
        remedy=remedy,
    )
