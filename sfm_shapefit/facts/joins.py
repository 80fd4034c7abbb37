"""What is said of a model beside another: joined to it, how and how surely, or why not."""

from collections.abc import Sequence
from typing import Annotated, Self

from sfm_shapefit.base.geometry import Alignment
from sfm_shapefit.base.record import Record
from sfm_shapefit.base.wording import counted, first_of
from sfm_shapefit.placement.join import PieceJoin
from sfm_shapefit.solver.solver_options import Solve


class JoinFacts(Record):
    """A model beside another, and what came of joining it to that."""

    model: Annotated[str, "Its folder."]
    to: Annotated[str, "The folder of the model that it was to be joined to."]
    joined: Annotated[bool, "Whether it was."]
    folder: Annotated[str | None, "Where both stand in one world; null if they are not joined."] = None
    statement: Annotated[str, "How and how surely, or why not, in words."]
    scale_sigma: Annotated[float | None, "Relative standard deviation of the scale between them."] = None
    turn_sigma_deg: Annotated[float | None, "Standard deviation of the turn between them."] = None
    center_sigma: Annotated[
        float | None,
        "Standard deviation of where its cameras come to lie, in units of the model that it is joined to.",
    ] = None
    similarity: Annotated[
        Alignment | None,
        "From its world to that of the model that it is joined to; of a refused join what most pairs want.",
    ]
    solve: Annotated[
        Solve | None,
        "Last solve of the convex program over the pieces, from which the refinement started; null without.",
    ]
    agreeing_pairs: Annotated[int, "Pairs of images between it and the models joined with it that agree."]
    contradicting_pairs: Annotated[int, "Those that do not."]
    rival_pairs: Annotated[list[tuple[str, str]], "Those among them that agree on another join, by names."]
    number: int
    to_number: int
    """The numbers of the two models."""
    found: PieceJoin | None
    """The join, refused or not; None if there was none to judge."""
    reason: str
    """Why it was not joined, a clause."""

    @classmethod
    def of_models(
        cls, labels: Sequence[str], number: int, found: PieceJoin | str, rivals: list[tuple[str, str]]
    ) -> Self:
        """Return what came of joining a model to another.

        Args:
            labels: what all models are called.
            number: that of the model.
            found: the join, refused or not; or why there is none, to the first model.
            rivals: pairs of images that agree on another join, by their names.
        """
        join, to = (None, 0) if isinstance(found, str) else (found, found.to)
        reason = found if isinstance(found, str) else found.reason
        solved = join and join.solved
        return cls.taken_from(
            join,
            model=labels[number].removeprefix("model "),
            to=labels[to].removeprefix("model "),
            joined=not reason,
            statement=_tell_join((labels[number], labels[to]), found, rivals),
            similarity=join and join.to_from_piece.facts,
            solve=solved and solved.facts,
            agreeing_pairs=0 if join is None else len(join.agreeing),
            contradicting_pairs=0 if join is None else len(join.contradicting),
            rival_pairs=rivals,
            number=number,
            to_number=to,
            found=join,
            reason=reason,
        )

    @property
    def join(self) -> PieceJoin | None:
        """The join, if it was accepted."""
        return None if self.reason else self.found


def _tell_join(labels: tuple[str, str], found: PieceJoin | str, rivals: list[tuple[str, str]]) -> str:
    """Say in one sentence what came of a join of two models."""
    own, other = labels
    named = first_of([f"{a} and {b}" for a, b in rivals])
    if isinstance(found, str) or found.reason:
        why = found if isinstance(found, str) else found.reason
        return f"{own} is not joined to {other}: {why}" + (f" ({named})" if named else "")
    rival = f"; {counted(len(rivals), 'pair')} put it elsewhere ({named})" if named else ""
    return (
        f"{own} is joined to {other} by {found.evidence}: scale known to "
        f"{100.0 * found.scale_sigma:.2g} %, turn to {found.turn_sigma_deg:.2g} deg, its cameras to "
        f"{found.center_sigma:.2g} units of {other}{rival}"
    )
