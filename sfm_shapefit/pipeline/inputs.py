"""Where matches come from: a database, or the model's own tracks. One place decides, and opens it."""

from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.facts.options import PlacingOptions, Source
from sfm_shapefit.facts.result import Inputs
from sfm_shapefit.files.colmap.database import DatabaseMatches, find_database, open_database
from sfm_shapefit.files.colmap.model import PosedModel
from sfm_shapefit.files.colmap.point_colors import PointColors, read_colors
from sfm_shapefit.files.colmap.seed import copy_without_keypoints
from sfm_shapefit.files.colmap.track_matches import TrackMatches
from sfm_shapefit.files.pair_list import read_pair_list
from sfm_shapefit.pipeline.memory import ECONOMIES, Economy, Workload, choose_economy
from sfm_shapefit.scene.matches import Matches, View

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchSource:
    """The matches of a model's images, and what is given up of all that could be done with them."""

    matches: Matches
    view: View[PosedModel]
    """Of these, but for the pairs that are left out."""
    inputs: Inputs
    """Where they come from."""
    economy: Economy = ECONOMIES[0]

    @property
    def model(self) -> PosedModel:
        """The model."""
        return self.view.images

    @property
    def has_database(self) -> bool:
        """Whether the matches are those of a database; else the model's own tracks serve."""
        return self.inputs.database is not None

    def at(self, model: PosedModel, economy: Economy | None = None) -> "MatchSource":
        """Return the same matches as another model's images see them, or with more that is given up."""
        economy = economy or self.economy
        if model is self.model and economy is self.economy:
            return self
        view = self.matches.at(model, self.inputs.left_out, economy.reading)
        return replace(self, view=view, economy=economy)

    def workload(self) -> Workload:
        """Return what is known of the work before any direction is measured."""
        model, view = self.model, self.view
        images = [model.reconstruction.image(i) for i in model.image_ids.tolist()]
        return Workload(
            num_images=model.num_images,
            num_keypoints=max(sum(image.num_points2D() for image in images), self.matches.total_keypoints),
            num_pairs=view.num_pairs,
            num_matches=view.num_matches,
            num_edges=view.num_pairs,
            num_nodes=model.num_images,
        )


def open_matches(model: PosedModel, inputs: Inputs) -> DatabaseMatches | TrackMatches:
    """Open the matches that were chosen.

    Raises:
        InputError: if they cannot be read.
    """
    return TrackMatches(model) if inputs.database is None else open_database(inputs.database, model.names)


def see_matches(
    matches: Matches, model: PosedModel, inputs: Inputs, options: PlacingOptions | None = None
) -> MatchSource:
    """Return the matches as a model's images see them; without options memory has no limit.

    Raises:
        InputError: if there is no way to stay below the limit.
    """
    source = MatchSource(matches=matches, view=matches.at(model, inputs.left_out), inputs=inputs)
    if options is None or not options.memory.max_memory_mb or not source.has_database:
        return source
    bare = replace(
        source.workload(),
        adjusts=options.placement.refines and options.freedom.adjusts_cameras(model.num_images),
        adjusts_bundle=options.freedom.adjust == "full",
    )
    work = replace(bare, has_points=options.nodes.uses_points(model.num_images))
    return source.at(model, choose_economy(work, bare, options.memory.max_memory_mb))


@contextmanager
def open_source(
    model: PosedModel, inputs: Inputs, options: PlacingOptions | None = None
) -> Iterator[MatchSource]:
    """Open the matches that were chosen, as `see_matches` sees them, and close them in the end."""
    with closing(open_matches(model, inputs)) as matches:
        yield see_matches(matches, model, inputs, options)


def without_structure(
    model: PosedModel, matches: DatabaseMatches | TrackMatches
) -> tuple[PosedModel, PointColors | None]:
    """Return a model without the points and keypoints that its matches make up for, and the points' colors.

    With matches of a database nothing else of the points serves, and its keypoints replace the model's. Of
    10,000 images both take 0.5 GB, which would be held to the end. Where tracks serve the model stays whole.
    """
    if matches.file is None:
        return model, None
    bare = copy_without_keypoints(model.reconstruction, model.image_ids[matches.num_keypoints > 0].tolist())
    return replace(model, reconstruction=bare), read_colors(model.reconstruction)


def read_left_out(inputs: Inputs, names: Collection[str], without: str) -> Inputs:
    """Return the inputs without the pairs that the user wants to be left out.

    Raises:
        InputError: if the list cannot be read, names an unknown image, or there is no database.
    """
    if not without:
        return inputs
    if inputs.database is None:
        raise InputError("pairs can be left out of the matches of a database only; give one with --database")
    return replace(inputs, left_out=read_pair_list(Path(without), names))


def choose_inputs(
    reconstruction: "pycolmap.Reconstruction | Path | str",
    database: Path | str | None,
    source: Source = "auto",
) -> Inputs:
    """Decide where directions come from, and say how."""
    folder = Path(reconstruction) if isinstance(reconstruction, Path | str) else None
    if source == "tracks":
        if database is not None:
            raise InputError("directions from tracks use no database; leave out one of the two")
        return Inputs(folder=folder, database=None, statement="the model's own tracks, as asked")
    # The pixels of other programs' model files may differ from those of a database beside them.
    is_folder = folder is not None and not folder.is_file()
    found = find_database(folder) if folder is not None and is_folder else None
    path = Path(database) if database is not None else found
    if path is None:
        if source != "auto":
            raise InputError(f"directions from {source} need a database; give one with --database")
        statement = "the model's own tracks; no database.db was given or found beside the model"
        return Inputs(folder=folder, database=None, statement=statement)
    statement = f"inlier matches of {path}" + (" (found beside the model)" if database is None else "")
    return Inputs(folder=folder, database=path, statement=statement)
