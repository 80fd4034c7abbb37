"""Grades of a model, and the reasons for them: each finding is a `Reason`, and the worst decides."""

import enum
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Annotated, Self

from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import counted, counted_are, first_of

IS_ITS_DATABASE = "is this the model's database?"  # ends a sentence that doubts the matches, not the model
ARE_ITS_PICTURES = "are these the model's pictures?"  # likewise, of matches of its pictures


class Grade(enum.StrEnum):
    """What to do with a model; each is worse than the one before."""

    GOOD = "good"
    LOOK = "look"
    CANNOT_BE_JUDGED = "cannot be judged"
    DO_NOT_USE = "do not use"

    def is_better_than(self, other: "Grade") -> bool:
        """Return whether a model of this grade is worth more than one of another."""
        return list(Grade).index(self) < list(Grade).index(other)


class Kind(enum.StrEnum):
    """What a reason is about."""

    APART = "apart"  # a group stands apart from the rest
    PLACE = "place"  # a camera may stand elsewhere
    LENS = "lens"  # a lens is wrong, or cannot be
    UNCHECKED = "unchecked"  # nothing says, or checks, how cameras stand to one another
    UNCERTAIN = "uncertain"  # a position, or the shape, is not determined well
    TRUST = "trust"  # pairs speak against a camera, or leave it loose
    POINTS = "points"  # the points that a camera sees are few, or do not fit, or there are none
    SECOND_OPINION = "second opinion"  # the model of `map` has a camera elsewhere, or doubts it too
    PAIRS = "pairs"  # pairs or observations contradict a camera, or the model as a whole
    REPEATED = "repeated structure"  # the scene may repeat itself
    LEFT_OUT = "left out"  # images are not in the model
    INPUT = "input"  # its database, convention, resolution, rotations or priors are not what they seem
    FAILED = "failed"  # a step failed


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
    reasons: Annotated[
        tuple[str, ...],
        "Why the model as a whole has no better grade; findings have the reasons of single images too.",
    ]
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
        others = (one for one in self.findings if one != reason)
        return self.weigh((replace(reason, grade=grade), *others))

    def fault_of_input(self, num_images: int) -> Reason | None:
        """Return the finding that half of some images have keypoints, or a rig, which explain the others."""
        of_input = (one for one in self.findings if one.kind is Kind.INPUT)
        return next((one for one in of_input if 2 * len(one.images) >= num_images), None)

    def _sentence(self) -> str:
        if self.grade is Grade.GOOD:
            return "good"
        if self.grade is not Grade.LOOK:
            return f"{self.grade.value}: {'; '.join(self.reasons)}"
        left_out = [name for one in self.findings if one.kind is Kind.LEFT_OUT for name in one.images]
        there = [name for name in self.cameras if name not in left_out]
        what = f"look at {counted(len(there), 'camera')} ({first_of(there)})" if there else ""
        gone = f"{counted_are(len(left_out), 'image')} left out ({first_of(left_out)})" if left_out else ""
        said = "; ".join(filter(None, [what, gone, *self.reasons]))
        return said if there else f"{self.grade.value}: {said}"


def of_model(kind: Kind, sentence: str, grade: Grade = Grade.LOOK, images: Sequence[str] = ()) -> Reason:
    """Return a reason about the model as a whole."""
    return Reason(kind=kind, sentence=sentence, images=tuple(images), grade=grade)


def of_each(kind: Kind, images: Sequence[str], sentence: str) -> tuple[Reason, ...]:
    """Return a reason to look at each of some images, none if there are none."""
    return (Reason(kind=kind, sentence=sentence, images=tuple(images), of_each=True),) if images else ()
