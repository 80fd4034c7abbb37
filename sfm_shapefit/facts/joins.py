"""What `map` says of models beside the largest: joined to another, how and how surely, or why not."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sfm_shapefit.facts.json_types import Join, JoinedSummary
from sfm_shapefit.facts.tables import CameraRow, PairRow
from sfm_shapefit.placement.join import ModelJoin

if TYPE_CHECKING:
    import pycolmap


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

    def summary(self, folder: str | None) -> Join:
        """Return what stands in map.json and in the model's locate.json."""
        join = self.join
        return {
            "model": str(self.model),
            "to": str(self.to),
            "joined": join is not None,
            "folder": folder,
            "statement": self.statement,
            "scale_sigma": None if join is None else join.scale_sigma,
            "turn_sigma_deg": None if join is None else join.turn_sigma_deg,
            "center_sigma": None if join is None else join.center_sigma,
            "similarity": None
            if join is None
            else {
                "scale": join.first_from_second.scale,
                "rotation": join.first_from_second.rotation.tolist(),
                "translation": join.first_from_second.translation.tolist(),
            },
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JoinedModel:
    """Models in one world, and what can be said of them together."""

    reconstruction: "pycolmap.Reconstruction"
    models: tuple[int, ...]
    """Their numbers; the world is that of the first, scaled if known distances between them tell."""
    cameras: Sequence[CameraRow]
    """One row per image of these models."""
    pairs: Sequence[PairRow]
    """One row per pair of these that was looked at."""
    facts: JoinedSummary
    """What stands in its locate.json."""

    def summary(self) -> dict[str, Any]:
        """Return what stands in its locate.json."""
        return dict(self.facts)

    @property
    def folder(self) -> str:
        """Where it stands in OUT."""
        return f"joined_{self.models[0]}"
