"""What `map` returns, and its files: COLMAP's layout of several models, each with the files of `locate`.

OUT/0, OUT/1, ...   models, largest first: each a folder as `locate` writes it
OUT/joined_0        models that were joined, in the world of the first, where that was safe; the same files
OUT/map.json        the averaging behind each, and the images in no model with the reason
"""

import html
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from sfm_shapefit.base.display import Row, Telling, Written, row
from sfm_shapefit.base.settings import flat_values
from sfm_shapefit.base.wording import counted, reasons_by_place
from sfm_shapefit.facts.command_options import MapOptions
from sfm_shapefit.facts.control_points import ControlPoint
from sfm_shapefit.facts.joins import JoinFacts
from sfm_shapefit.facts.model import Component, DatabaseInputs, JoinedFacts, MapFacts, next_of_model
from sfm_shapefit.facts.result import LocateResult
from sfm_shapefit.facts.tables import CameraRow, PairRow, Stated, Table, Tabled
from sfm_shapefit.judgement.grade import FEW_PLACED, in_another_model
from sfm_shapefit.judgement.reasons import Grade, ModelVerdict
from sfm_shapefit.rotations.averaged import AveragedRotations

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class JoinedModel(Written, Stated):
    """Models in one world, and the evidence for them together."""

    _PUBLIC = ("reconstruction", "models", "joins", "cameras", "pairs", "table", "warnings", "timings_s")
    reconstruction: "pycolmap.Reconstruction"
    models: tuple[int, ...]
    """Their numbers; the world is that of the first, scaled if known distances between them give a scale."""
    joins: tuple[JoinFacts, ...]
    """What came of joining each model to another, those included that are not in this one."""
    cameras: Table[CameraRow]
    """One row per image of these models."""
    pairs: Table[PairRow]
    """One row per pair of these that was looked at."""
    facts: JoinedFacts
    """What stands in its locate.json."""

    @property
    def folder(self) -> str:
        """Where it stands in OUT."""
        return f"joined_{self.models[0]}"

    @property
    def image_names(self) -> tuple[str, ...]:
        """Names of its images."""
        return tuple(self.cameras.columns["name"])

    @property
    def told(self) -> Telling:
        """What the terminal says: how the models were joined, or why not, and what `check` says of them."""
        told = self.facts.told(self.cameras, self.pairs)
        return told._replace(rows=[*self.facts.scene_rows(), *told.rows], elsewhere="see cameras.csv")

    def _headline(self) -> str:
        models = counted(len(self.models), "model")
        return f"{self.facts.num_placed} images of {models}, {self.verdict.statement}"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class MapResult(Written, Tabled):
    """The models of a database, and how they came about; cameras, pairs and report are of the largest."""

    _PUBLIC = (
        *("models", "reconstruction", "cameras", "pairs", "table", "num_images", "num_placed", "left_out"),
        *("joins", "joined", "warnings", "database", "options", "timings_s"),
    )
    database: Path
    options: MapOptions
    models: tuple[LocateResult, ...]
    """Models of the database, most placed cameras first, as `locate` returns them."""
    num_images: int
    num_pairs: int
    """Pairs with a relative rotation."""
    num_video_frames: int
    """Images that are frames of a video."""
    left_out: dict[str, str]
    """Name and reason of each image in no model."""
    timings_s: dict[str, float]
    joins: tuple[JoinFacts, ...] = ()
    """What came of joining each model but the largest to a larger one."""
    joined: tuple[JoinedModel, ...] = ()
    """Models that were joined, in one world; each stands in `models` by itself too."""
    warnings: tuple[str, ...]
    """What the user should know of the run; each of the `models` has warnings of its own."""
    images: Path | None = None
    """Folder of the photographs of which the database was made, in the folder of the result."""

    @property
    def num_placed(self) -> int:
        """Number of cameras in all models."""
        return sum(int(model.kept.sum()) for model in self.models)

    @property
    def reconstruction(self) -> "pycolmap.Reconstruction":
        """The largest model."""
        return self.models[0].reconstruction

    @property
    def cameras(self) -> Sequence[CameraRow]:
        """One row per image of the largest model."""
        return self.models[0].cameras

    @property
    def pairs(self) -> Sequence[PairRow]:
        """One row per pair of the largest model that was looked at."""
        return self.models[0].pairs

    @property
    def control_points(self) -> Sequence[ControlPoint]:
        """Ground control points as the largest model has them."""
        return self.models[0].control_points

    @property
    def verdict(self) -> ModelVerdict:
        """Whether the largest model can be used, and why; look at one that leaves many images to others."""
        verdict = self.models[0].verdict
        sizes = int(self.models[0].kept.sum()), *(one.facts.num_placed for one in self.joined)
        here = max(sizes) / self.num_placed
        if verdict.grade is not Grade.GOOD or here >= FEW_PLACED:
            return verdict
        return ModelVerdict.weigh([*verdict.findings, in_another_model(here)])

    @property
    def facts(self) -> MapFacts:
        """What is told of the run: each figure of map.json."""
        return MapFacts.taken_from(
            self,
            inputs=DatabaseInputs(database=str(self.database.absolute())),
            options=flat_values(self.options),
            models=[
                Component(
                    folder=str(number),
                    num_images=len(model.averaged_names),
                    num_placed=int(model.kept.sum()),
                    averaging=_averaging_of(model).facts,
                    located=model.facts,
                )
                for number, model in enumerate(self.models)
            ],
            joins=list(self.joins),
        )

    @property
    def told(self) -> Telling:
        """What the terminal says: of each model, of joins, and of what was left out."""
        largest, several = self.models[0].facts, len(self.models) > 1
        lines, rows = list[str](), list[Row]()
        details = [row("pairs", f"{counted(self.num_pairs, 'pair')} with a relative rotation")]
        for number, model in enumerate(self.models):
            title = f"model {number}: {model.verdict.statement}" if several else ""
            told = model.told
            lines += [title, *told.lines] if several else told.lines
            whose = f" of model {number}" if several else ""
            rows += [one._replace(label=f"{one.label}{whose}") for one in told.rows]
            rotations = row("rotations", _averaging_of(model).statement)
            details += [row("model", title), rotations, *told.details]
        rows += [row("join", one.statement) for one in self.joins]
        rows += [row(one.folder, one.facts.verdict.statement) for one in self.joined]
        names = [*self.image_names, *self.left_out]
        rows += [Row("in no model", reasons_by_place(self.left_out, names))]
        rows += [Row("warning", self.warnings)]
        usable = [one for one in self.joined if 0 in one.models and not one.verdict.is_bad]
        step = next_of_model(usable[0].verdict.grade, largest) if usable else largest.next_step
        folders = (*(one.folder for one in usable), *map(str, range(len(self.models))))
        return Telling(lines, rows, details, elsewhere="see map.json", step=step, folders=folders)

    @property
    def image_names(self) -> tuple[str, ...]:
        """Names of all images of the models."""
        return tuple(name for model in self.models for name in model.image_names)

    def _repr_html_(self) -> str:
        """Return what matters of all models, and what the largest shows of itself."""
        return f"<p>{html.escape(self._headline())}</p>{self.models[0]._repr_html_()}"

    def _headline(self) -> str:
        models = counted(len(self.models), "model")
        images = f"{self.num_placed} of {self.num_images} images placed in {models}"
        return f"{self.verdict.grade.value}: {images}"


def _averaging_of(model: LocateResult) -> AveragedRotations:
    """Return the rotations that a model of `map` started from."""
    assert model.averaging is not None
    return model.averaging


def tell_joins(result: MapResult) -> MapResult:
    """Return the result whose joins tell the folder of both models, and whose models what came of theirs."""
    folders = {number: one.folder for one in result.joined for number in one.models}
    joins = tuple(replace(one, folder=folders[one.number]) if one.joined else one for one in result.joins)
    of_model = {one.number: one for one in joins}
    models = (replace(one, join=of_model.get(number)) for number, one in enumerate(result.models))
    return replace(result, joins=joins, models=tuple(models))
