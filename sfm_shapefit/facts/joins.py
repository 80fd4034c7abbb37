"""What is said of a model beside another: joined to it, how and how surely, or why not."""

from dataclasses import dataclass
from typing import Annotated

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
    folder: Annotated[str | None, "Where both stand in one world; null if they are not joined."]
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JoinOutcome:
    """A model beside another, and what came of joining it to that."""

    model: int
    to: int
    """The number of the model that it was joined to, or to be joined to."""
    found: PieceJoin | None
    """The join, refused or not; None if there was none to judge."""
    reason: str = ""
    """Why it was not joined, a clause."""
    labels: tuple[str, str]
    """What the two are called."""
    rivals: tuple[tuple[str, str], ...] = ()
    """Pairs of images that agree on another join."""

    @property
    def join(self) -> PieceJoin | None:
        """The join, if it was accepted."""
        return None if self.reason else self.found

    @property
    def statement(self) -> str:
        """Say it in one sentence."""
        (own, other), join = self.labels, self.join
        named = first_of([f"{a} and {b}" for a, b in self.rivals])
        if join is None:
            return f"{own} is not joined to {other}: {self.reason}" + (f" ({named})" if named else "")
        rival = f"; {counted(len(self.rivals), 'pair')} put it elsewhere ({named})" if named else ""
        return (
            f"{own} is joined to {other} by {join.evidence}: scale known to "
            f"{100.0 * join.scale_sigma:.2g} %, turn to {join.turn_sigma_deg:.2g} deg, its cameras to "
            f"{join.center_sigma:.2g} units of {other}{rival}"
        )

    def facts(self, folder: str | None) -> JoinFacts:
        """Return what stands in the files of the result; `folder` is where both stand in one world."""
        found = self.found
        solved = found and found.solved
        return JoinFacts.taken_from(
            found,
            model=self.labels[0].removeprefix("model "),
            to=self.labels[1].removeprefix("model "),
            joined=self.join is not None,
            folder=folder,
            statement=self.statement,
            similarity=found and found.to_from_piece.facts,
            solve=solved and solved.facts,
            agreeing_pairs=0 if found is None else len(found.agreeing),
            contradicting_pairs=0 if found is None else len(found.contradicting),
            rival_pairs=list(self.rivals),
        )
