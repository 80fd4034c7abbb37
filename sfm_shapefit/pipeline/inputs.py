"""Where matches come from: a database, or the model's own tracks. One place decides, and opens it."""

from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.facts.options import PlacingOptions, Source
from sfm_shapefit.facts.result import Inputs
from sfm_shapefit.files.colmap.database import (
    MatchDatabase,
    find_database,
    images_with_keypoints,
    open_database,
)
from sfm_shapefit.files.colmap.model import PosedModel, track_matches
from sfm_shapefit.files.colmap.point_colors import PointColors, read_colors
from sfm_shapefit.files.colmap.seed import copy_without_keypoints
from sfm_shapefit.files.pair_list import read_pair_list
from sfm_shapefit.pipeline.memory import ECONOMIES, Economy, Workload, choose_economy
from sfm_shapefit.scene.matches import KeypointMatches, MatchBatch

if TYPE_CHECKING:
    import pycolmap

Batch = TypeVar("Batch", MatchBatch, KeypointMatches)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchSource:
    """A model with the matches of its images, which can be read again and again."""

    model: PosedModel
    database: MatchDatabase | None
    """The open database; None where the model's own tracks serve."""
    economy: Economy = ECONOMIES[0]
    """What is given up for memory."""

    def batches(self, among: IntArray | None = None) -> Iterator[MatchBatch]:
        """Yield the matches of all pairs, or of those among some images, in the order of pairs."""
        if self.database is None:
            return track_matches(self.model)
        return self.database.iter_matches(1, self.economy.batch, among)

    def counted(self, batches: Iterator[Batch], advance: Callable[[int, int], None]) -> Iterator[Batch]:
        """Report progress while batches are consumed: pairs of a database, or images of a model."""
        total = self.model.num_images if self.database is None else self.database.num_pairs
        done = 0
        for batch in batches:
            yield batch
            if len(batch.pairs):
                done = int(batch.pairs[-1, 0]) + 1 if self.database is None else done + len(batch.pairs)
            advance(min(done, total), total)
        advance(total, total)

    def num_keypoints(self) -> IntArray:
        """Return the number of keypoints of each image, (n,), to which matches refer."""
        model, database = self.model, self.database
        if database is not None:
            return np.array([database.count_keypoints(k) for k in range(model.num_images)])
        images = map(model.reconstruction.image, model.image_ids.tolist())
        return np.array([image.num_points2D() for image in images])

    def workload(self) -> Workload:
        """Return what is known of the work before any direction is measured."""
        database, model = self.database, self.model
        images = [model.reconstruction.image(i) for i in model.image_ids.tolist()]
        seen = sum(image.num_points2D() for image in images)
        num_pairs = 0 if database is None else database.num_pairs
        return Workload(
            num_images=model.num_images,
            num_keypoints=seen if database is None else max(seen, database.num_keypoints()),
            num_pairs=num_pairs,
            num_matches=0 if database is None else database.num_matches,
            num_edges=num_pairs,
            num_nodes=model.num_images,
        )

    def turned(self, model: PosedModel) -> "MatchSource":
        """Return the same matches for a model of the same images with other rotations."""
        database = None if self.database is None else self.database.turned(model)
        return replace(self, model=model, database=database)

    def with_economy(self, economy: Economy) -> "MatchSource":
        """Return the same source, which gives up so much for memory."""
        if self.database is not None:
            self.database.limit_rays(economy.rays_bytes)
            if economy.statement:
                self.database.forget_matches()
        return replace(self, economy=economy)


@contextmanager
def open_source(
    model: PosedModel,
    inputs: Inputs,
    options: PlacingOptions | None = None,
    opened: MatchDatabase | None = None,
) -> Iterator[MatchSource]:
    """Open the matches that were chosen, and close them in the end; without options memory has no limit.

    A database that is `opened` already stays open, and what was read of it is not read again.

    Raises:
        InputError: if the matches cannot be read, or there is no way to stay below the limit.
    """
    if inputs.database is None:
        yield MatchSource(model=model, database=None)
        return
    with ExitStack() as stack:
        if opened is None:
            database = stack.enter_context(open_database(inputs.database, model, inputs.left_out))
        else:
            database = opened.among(model, inputs.left_out)
        source = MatchSource(model=model, database=database)
        if options is not None and options.memory.max_memory_mb:
            bare = replace(
                source.workload(),
                adjusts=options.placement.refines and options.freedom.adjusts_cameras(model.num_images),
                adjusts_bundle=options.freedom.adjust == "full",
            )
            work = replace(bare, has_points=options.nodes.uses_points(model.num_images))
            source = source.with_economy(choose_economy(work, bare, options.memory.max_memory_mb))
        yield source


def without_structure(model: PosedModel, inputs: Inputs) -> tuple[PosedModel, PointColors | None]:
    """Return a model without the points and keypoints that its matches make up for, and the points' colors.

    With matches of a database nothing else of the points serves, and its keypoints replace the model's. Of
    10,000 images both take 0.5 GB, which would be held to the end. Where tracks serve the model stays whole.
    """
    if inputs.database is None:
        return model, None
    names = images_with_keypoints(inputs.database)
    replaced = [i for i, name in zip(model.image_ids.tolist(), model.names, strict=True) if name in names]
    bare = copy_without_keypoints(model.reconstruction, replaced)
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
