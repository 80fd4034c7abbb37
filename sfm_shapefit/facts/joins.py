"""What `map` says of models beside the largest: joined to another, how and how surely, or why not."""

from dataclasses import dataclass
from typing import Annotated

from sfm_shapefit.base.geometry import Alignment
from sfm_shapefit.base.record import Record
from sfm_shapefit.placement.join import ModelJoin


class JoinFacts(Record):
    """A model of `map` beside the largest, and what came of joining it to a larger one."""

    model: Annotated[str, "Its folder."]
    to: Annotated[str, "The folder of the model that it was to be joined to."]
    joined: Annotated[bool, "Whether it was."]
    folder: Annotated[str | None, "Where both stand in one world; null if they are not joined."]
    statement: Annotated[str, "How and how surely, or why not, in words."]
    scale_sigma: Annotated[float | None, "Relative standard deviation of the scale between them."]
    turn_sigma_deg: Annotated[float | None, "Standard deviation of the turn between them."]
    center_sigma: Annotated[
        float | None,
        "Standard deviation of where its cameras come to lie, median, in units of the model that it is "
        "joined to.",
    ]
    similarity: Annotated[Alignment | None, "From its world to that of the model that it is joined to."]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Joined:
    """A model beside the largest, and what came of joining it to a larger one."""

    model: int
    """Its number."""
    to: int
    """The number of the model that it was joined to, or to be joined to."""
    join: ModelJoin | None
    """None if it was not joined."""
    reason: str = ""
    """Why it was not, a clause."""

    @property
    def statement(self) -> str:
        """Say it in one sentence."""
        join = self.join
        if join is None:
            return f"model {self.model} is not joined to model {self.to}: {self.reason}"
        return (
            f"model {self.model} is joined to model {self.to} by {join.evidence}: scale known to "
            f"{100.0 * join.scale_sigma:.2g} %, turn to {join.turn_sigma_deg:.2g} deg, its cameras to "
            f"{join.center_sigma:.2g} units of model {self.to}"
        )

    def facts(self, folder: str | None) -> JoinFacts:
        """Return what stands in map.json and in the model's locate.json."""
        join = self.join
        return JoinFacts(
            model=str(self.model),
            to=str(self.to),
            joined=join is not None,
            folder=folder,
            statement=self.statement,
            scale_sigma=None if join is None else join.scale_sigma,
            turn_sigma_deg=None if join is None else join.turn_sigma_deg,
            center_sigma=None if join is None else join.center_sigma,
            similarity=None if join is None else join.first_from_second.facts,
        )
