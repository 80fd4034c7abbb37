"""What `map` returns, and its files: COLMAP's layout of several models, each with the files of `locate`.

OUT/0, OUT/1, ...   models, largest first: each a folder as `locate` writes it
OUT/joined_0        models that were joined, in the world of the first, where that was safe; the same files
OUT/map.json        the averaging behind each, and the images in no model with the reason
"""

import html
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from sfm_shapefit.base.display import Displayed
from sfm_shapefit.base.settings import flat_values
from sfm_shapefit.base.wording import counted
from sfm_shapefit.facts.joins import Joined, JoinedModel
from sfm_shapefit.facts.json_types import Averaging, LocateSummary, MapSummary
from sfm_shapefit.facts.options import MapOptions
from sfm_shapefit.facts.result import LocateResult
from sfm_shapefit.facts.tables import SCHEMA_VERSION
from sfm_shapefit.rotations.averaged import AveragedRotations


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MappedModel:
    """One component of the images."""

    located: LocateResult
    averaging: AveragedRotations
    """The rotations it started from, of the images in `names`."""
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class MapResult(Displayed):
    """The models of a database, and how they came about."""

    database: Path
    options: MapOptions
    models: tuple[MappedModel, ...]
    """Those with most placed cameras first."""
    num_images: int
    num_pairs: int
    """Pairs with a relative rotation."""
    num_video_frames: int
    """Images that are frames of a video."""
    left_out: dict[str, str]
    """Name and reason of each image in no model."""
    timings_s: dict[str, float]
    joins: tuple[Joined, ...] = ()
    """What came of joining each model but the largest to a larger one."""
    joined: tuple[JoinedModel, ...] = ()
    """Models that were joined, in one world; each stands in `models` by itself too."""
    warnings: tuple[str, ...]
    """What the user should know beyond the warnings of each model."""

    @property
    def num_placed(self) -> int:
        """Number of cameras in all models."""
        return sum(int(model.located.kept.sum()) for model in self.models)

    def summary(self) -> dict[str, Any]:
        """Return what stands in map.json."""
        facts: MapSummary = {
            "schema_version": SCHEMA_VERSION,
            "inputs": {"database": str(self.database)},
            "options": flat_values(self.options),
            "num_images": self.num_images,
            "num_placed": self.num_placed,
            "num_video_frames": self.num_video_frames,
            "num_pairs": self.num_pairs,
            "models": [
                {
                    "folder": str(number),
                    "num_images": len(model.names),
                    "num_placed": int(model.located.kept.sum()),
                    "averaging": cast("Averaging", model.averaging.summary()),
                    "located": cast("LocateSummary", model.located.summary()),
                }
                for number, model in enumerate(self.models)
            ],
            "joins": [join.summary(self.folder_of_join(join)) for join in self.joins],
            "left_out": self.left_out,
            "timings_s": self.timings_s,
            "warnings": list(self.warnings),
        }
        return dict(facts)

    def folder_of_join(self, join: Joined) -> str | None:
        """Return where the models of a join stand in one world; None if they were not joined."""
        return next((one.folder for one in self.joined if join.join and join.model in one.models), None)

    def _repr_html_(self) -> str:
        """Return what matters of all models, and what the largest shows of itself."""
        return f"<p>{html.escape(self._headline())}</p>{self.models[0].located._repr_html_()}"

    def _headline(self) -> str:
        models = counted(len(self.models), "model")
        return f"{self.num_placed} of {self.num_images} images placed in {models}"


def tell_joins(result: MapResult) -> MapResult:
    """Return the result whose models know what came of joining them."""
    models = list(result.models)
    for join in result.joins:
        facts = join.summary(result.folder_of_join(join))
        models[join.model] = replace(
            models[join.model], located=replace(models[join.model].located, join=facts)
        )
    return replace(result, models=tuple(models))
