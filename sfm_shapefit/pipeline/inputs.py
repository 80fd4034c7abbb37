"""What a run works from: matches, of a database or of the model's own tracks, and what is known of images.

The view graph tells focal lengths that were only guessed before anything is placed.
"""

import os
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, IntArray
from sfm_shapefit.base.errors import InputError, ShapeFitError, UnsolvableError
from sfm_shapefit.facts.command_options import PlacingOptions, Source
from sfm_shapefit.facts.intrinsics import RefinedIntrinsics
from sfm_shapefit.facts.result import Inputs
from sfm_shapefit.facts.tables import read_trust, told_of
from sfm_shapefit.files.colmap.database import DatabaseMatches, find_database, open_database
from sfm_shapefit.files.colmap.database_cameras import read_cameras
from sfm_shapefit.files.colmap.database_pairs import explain_no_pairs, match_names, refuse_no_features
from sfm_shapefit.files.colmap.model import ColmapModel, ModelSource
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.files.colmap.template import Template
from sfm_shapefit.files.colmap.track_matches import TrackMatches
from sfm_shapefit.files.pair_list import read_pair_list
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.placement.gauge_options import KnownDistance, Scale
from sfm_shapefit.placement.memory_plan import MEMORY_PLANS, MemoryPlan
from sfm_shapefit.scene.given import NOTHING_KNOWN, Known
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import Matches, PairNames, View


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchSource:
    """The matches of images, and what is given up of all that could be done with them."""

    matches: Matches
    view: View
    """How the images see them, but for the pairs that are left out."""
    inputs: Inputs
    memory_plan: MemoryPlan = MEMORY_PLANS[0]
    fixed: BoolArray | None = None
    """(i,) images that stay where they are; None if none does."""
    tied: IntArray | None = None
    """(k, 2) images that stand rightly to one another by joins of models or position priors; None without."""
    alone: RelativeRotations | None = None
    """Relative rotations of pairs, ascending, by their matches alone; None where they were not measured."""

    @property
    def images(self) -> Images:
        """The images as they see the matches."""
        return self.view.images

    @property
    def has_database(self) -> bool:
        """Whether the matches are those of a database; else the model's own tracks serve."""
        return self.inputs.database is not None

    @property
    def pairs_of_fixed(self) -> IntArray | None:
        """Pairs (k, 2) of two fixed images, which say nothing of where others are; None if none is fixed."""
        if self.fixed is None:
            return None
        return np.asarray(self.view.pairs[self.fixed[self.view.pairs].all(axis=1)])

    def at(self, images: Images, memory_plan: MemoryPlan | None = None) -> "MatchSource":
        """Return the same matches as other images see them, or with more that is given up."""
        memory_plan = memory_plan or self.memory_plan
        if images is self.images and memory_plan is self.memory_plan:
            return self
        view = self.matches.at(images, self.inputs.left_out, memory_plan.reading)
        return replace(self, view=view, memory_plan=memory_plan)

    def without(self, pairs: PairNames) -> "MatchSource":
        """Return the same matches without those of some pairs."""
        inputs = replace(self.inputs, left_out=self.inputs.left_out | pairs, far=self.inputs.far - pairs)
        view = self.matches.at(self.images, inputs.left_out, self.memory_plan.reading)
        return replace(self, inputs=inputs, view=view)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunInputs:
    """What a model is made by beside its matches: images as they were read, options, and what the user knows.

    It stays what it is from the first stage to the last.
    """

    options: PlacingOptions
    template: Template
    """What the images were read from."""
    images: Images
    """The images as they were read: what pulls, what is compared with, whose centers may set a scale."""
    intrinsics: RefinedIntrinsics
    """What may change of lenses in doubt."""
    fixed: BoolArray
    """(i,) images that keep their poses to the last bit."""
    pull_rad: float | None
    """Standard deviation by which an adjustment pulls rotations, see `Freedom`; None: the matches decide."""
    rough_rad: float | None = None
    """Standard deviation of rotations so rough that pairs correct them first; None if they are not."""
    is_component: bool = False
    """Whether the images are a component of `map`: a first placement makes their averaged rotations finer,
    and position priors that set no scale are set aside."""
    scale: Scale = "unit"
    """The scale where nothing that is known sets it."""
    distances: tuple[KnownDistance, ...] = ()
    known: Known = NOTHING_KNOWN
    """What the user knows of the images beside the matches."""

    @property
    def knows_rotations(self) -> bool:
        """Whether the user knows rotations, so that an adjustment holds them or pulls them back."""
        return self.pull_rad is not None and self.pull_rad < np.inf

    @property
    def fixed_frames(self) -> BoolArray:
        """Frames that keep their poses to the last bit, (f,)."""
        fixed = np.zeros(len(self.images.frames.ids), dtype=np.bool_)
        fixed[self.images.frame_of[self.fixed]] = True
        return fixed

    def without_positions(self) -> "RunInputs":
        """Return the same where nothing is known of positions but what rigs say."""
        return replace(self, scale="unit", distances=(), known=NOTHING_KNOWN)


def open_matches(model: ColmapModel, inputs: Inputs) -> tuple[DatabaseMatches | TrackMatches, Inputs]:
    """Open the matches that were chosen, and return what is used then.

    A database that was found, and cannot be used, is left aside; the model's own tracks serve.

    Raises:
        InputError, UnsolvableError: if one that was named cannot be used, or has no verified matches.
    """
    if inputs.database is None:
        return TrackMatches(model), inputs
    try:
        return open_verified(inputs.database, model.images.names), inputs
    except ShapeFitError as error:
        if not inputs.is_found or inputs.left_out:
            raise
        statement = f"the model's own tracks; the database that was found cannot be used: {error}"
        return TrackMatches(model), replace(inputs, database=None, statement=statement)


def open_verified(database: Path, names: Sequence[str]) -> DatabaseMatches:
    """Open a database that has verified matches of some images, or of others, and cameras.

    Raises:
        InputError, UnsolvableError: if it cannot be used; the message says what is to be done first.
    """
    matches = open_database(database, names)
    try:
        read_cameras(matches.file)  # which are asked for guesses when it is too late for other matches
        if not len(matches.pairs):
            refuse_no_features(matches.file)
            if explained := explain_no_pairs(matches.file):
                raise UnsolvableError(explained)
    except ShapeFitError:
        matches.close()
        raise
    return matches


def see_matches(matches: Matches, images: Images, inputs: Inputs) -> MatchSource:
    """Return the matches as images see them, with no limit of memory."""
    return MatchSource(matches=matches, view=matches.at(images, inputs.left_out), inputs=inputs)


@contextmanager
def open_source(model: ColmapModel, inputs: Inputs) -> Iterator[MatchSource]:
    """Open the matches that were chosen, as `see_matches` sees them, and close them in the end."""
    opened, inputs = open_matches(model, inputs)
    with closing(opened) as matches:
        yield see_matches(matches, model.images, inputs)


def read_left_out(inputs: Inputs, names: Collection[str], without: str) -> Inputs:
    """Return the inputs without the pairs that the user wants to be left out.

    Raises:
        InputError: if the list cannot be read, names an unknown image, or there is no database.
    """
    if not without:
        return inputs
    if inputs.database is None:
        raise InputError("pairs can be left out of the matches of a database only; give one (database=FILE)")
    return replace(inputs, left_out=read_pair_list(Path(without), names))


def choose_inputs(
    reconstruction: ModelSource, database: Path | str | None, source: Source = "auto"
) -> Inputs:
    """Decide where directions come from, and say how; those of a result from the database that it is of."""
    database = database or getattr(reconstruction, "database", None)
    folder = Path(reconstruction) if isinstance(reconstruction, Path | str) else None
    if source == "tracks":
        if database is not None:
            raise InputError("directions from tracks use no database; leave out one of the two")
        return Inputs(folder=folder, database=None, statement="the model's own tracks, as asked")
    # The pixels of other programs' model files may differ from those of a database beside them.
    is_folder = folder is not None and not folder.is_file()
    nearby = find_database(folder) if folder is not None and is_folder else None
    if nearby is not None and folder is not None and not folder.is_absolute():
        nearby = Path(os.path.relpath(nearby))  # as the folder was typed
    path = Path(database) if database is not None else nearby
    if path is None:
        if source != "auto":
            raise InputError(f"directions from {source} need a database; give one (database=FILE)")
        statement = "the model's own tracks, which cannot show a fold; no database.db was found beside it"
        return Inputs(folder=folder, database=None, statement=statement)
    beside = " (found beside the model)" if database is None else ""
    statement = f"inlier matches of {path}{beside}"
    is_found = database is None and source == "auto"
    return Inputs(folder=folder, database=path, statement=statement, is_found=is_found)


def inputs_to_check(model: ModelSource, database: Path | str | None) -> Inputs:
    """Return the same for `check`: without a database, an output is judged by the one that it was made of."""
    inputs = choose_inputs(model, database)
    own = _database_of_output(inputs.folder) if inputs.folder and inputs.database is None else None
    if own is None:
        return inputs
    statement = f"inlier matches of {own} (which the model's locate.json names)"
    return replace(inputs, database=own, statement=statement, is_found=True)


def _database_of_output(folder: Path) -> Path | None:
    """Return the database that an output names, if it is there and has all images of it; else None."""
    with suppress(InputError):
        path = told_of(folder, "inputs", lambda found: Path(found.get("database")))
        if path is not None and path.is_absolute() and path.is_file():
            names = sorted(read_trust(folder / "cameras.csv"))
            with closing(DatabaseFile(path)) as file:
                return path if {*range(len(names))} <= {*match_names(file, names).values()} else None
    return None


def inputs_from(database: Path) -> Inputs:
    """Return the inputs of images of a database without a model."""
    return Inputs(folder=None, database=database, statement=f"inlier matches of {database}")
