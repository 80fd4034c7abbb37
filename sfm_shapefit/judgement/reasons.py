"""Grades of a model, and the reasons for them: each finding is a `Reason`, and the worst decides."""

import enum
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Annotated, Self

from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import counted, first_of

IS_ITS_DATABASE = "is this the model's database?"  # ends a sentence that doubts the matches, not the model


class Grade(enum.StrEnum):
    """What to do with a model; each is worse than the one before."""

    GOOD = "good"
    LOOK = "look"
    CANNOT_BE_JUDGED = "cannot be judged"
    DO_NOT_USE = "do not use"


class Kind(enum.StrEnum):
    """What a reason is about."""

    APART = "apart"
    """A group stands apart from the rest."""
    PLACE = "place"
    """A camera may stand elsewhere."""
    LENS = "lens"
    """A lens is wrong, or cannot be."""
    UNCHECKED = "unchecked"
    """Nothing says, or checks, how cameras stand to one another."""
    UNCERTAIN = "uncertain"
    """A position, or the shape, is not determined well."""
    TRUST = "trust"
    """Pairs speak against a camera, or leave it loose."""
    POINTS = "points"
    """The points that a camera sees are few, or do not fit, or there are none."""
    SECOND_OPINION = "second opinion"
    """A model that `map` made of the same database has a camera elsewhere, or doubts it too."""
    PAIRS = "pairs"
    """Pairs or observations contradict a camera, or the model as a whole."""
    REPEATED = "repeated structure"
    """The scene may repeat itself."""
    LEFT_OUT = "left out"
    """Images are not in the model."""
    INPUT = "input"
    """The input is not what it was taken for: its database, convention, resolution, rotations or priors."""
    FAILED = "failed"
    """A step failed."""


class Reason(Record):
    """One thing that speaks against a model, or against some of its images."""

    kind: Annotated[Kind, "What it is about."]
    sentence: Annotated[str, "A clause; about the model, or about each of the images as `it`."]
    images: Annotated[tuple[str, ...], "Names of the images to be looked at because of it."] = ()
    of_each: Annotated[bool, "Whether the sentence is about each image by itself, not about the model."] = (
        False
    )
    grade: Annotated[Grade, "What it makes of the model by itself."] = Grade.LOOK


class ModelVerdict(Record):
    """Whether the model can be used; the rules are in `judgement.grade`."""

    grade: Annotated[Grade, "What to do with it."]
    statement: Annotated[str, "The same in a sentence."] = ""
    cameras: Annotated[tuple[str, ...], "To be looked at, the least trusted first."]
    reasons: Annotated[tuple[str, ...], "Why the grade is not better; none if it is good."]
    findings: Annotated[tuple[Reason, ...], "All that speaks against it; each of the cameras is in one."] = ()

    @classmethod
    def weigh(cls, findings: Iterable[Reason]) -> Self:
        """Return the verdict: as bad as the worst reason makes it; what is less bad only names cameras."""
        findings = tuple(findings)
        grade = max((one.grade for one in findings), key=list(Grade).index, default=Grade.GOOD)
        of_model = (one.sentence for one in findings if one.grade is grade and not one.of_each)
        cameras = dict.fromkeys(name for one in findings for name in one.images)
        return cls(
            grade=grade, cameras=tuple(cameras), reasons=tuple(dict.fromkeys(of_model)), findings=findings
        )

    def __post_init__(self) -> None:
        object.__setattr__(self, "statement", self._sentence())

    @property
    def is_bad(self) -> bool:
        """Whether the model should not be used."""
        return self.grade is Grade.DO_NOT_USE

    @property
    def is_usable(self) -> bool:
        """Whether the model passes `--strict`: it was judged, and can be used, perhaps after a look."""
        return self.grade in (Grade.GOOD, Grade.LOOK)

    @property
    def doubts_database(self) -> bool:
        """Whether the matches are those of other images, as it seems."""
        return any(reason.endswith(IS_ITS_DATABASE) for reason in self.reasons)

    def led_by(self, reason: Reason | None) -> "ModelVerdict":
        """Return the verdict with a first reason, if any, which explains the others."""
        if reason is None:
            return self
        grade = Grade.LOOK if self.grade is Grade.GOOD else self.grade
        return self.weigh((replace(reason, grade=grade), *self.findings))

    def _sentence(self) -> str:
        if self.grade is Grade.GOOD:
            return "good"
        if self.grade is Grade.LOOK and self.cameras:
            what = f"look at {counted(len(self.cameras), 'camera')} ({first_of(self.cameras)})"
            return "; ".join([what, *self.reasons])
        return f"{self.grade.value}: {'; '.join(self.reasons)}"


def of_each(kind: Kind, images: Sequence[str], sentence: str) -> tuple[Reason, ...]:
    """Return a reason to look at each of some images, none if there are none."""
    return (Reason(kind=kind, sentence=sentence, images=tuple(images), of_each=True),) if images else ()
