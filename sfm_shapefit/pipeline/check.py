"""`check MODEL`: the verdict on a COLMAP model as it stands, with a second opinion of our own."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.facts.map_result import MapResult
from sfm_shapefit.facts.options import MapOptions
from sfm_shapefit.files.colmap.database import DatabaseMatches
from sfm_shapefit.files.colmap.listed_poses import read_by_itself, read_source
from sfm_shapefit.files.colmap.model import ColmapModel, ModelSource
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.judgement.pair_fits import fit_pairs
from sfm_shapefit.pairs.options import DirectionOptions
from sfm_shapefit.pipeline.checked import CheckResult, OtherModel, check_source
from sfm_shapefit.pipeline.clock import Clock, Progress
from sfm_shapefit.pipeline.inputs import choose_inputs, open_source
from sfm_shapefit.pipeline.map import map_opened
from sfm_shapefit.pipeline.pictures import AskedPictures, match_pictures
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.same_images import same_images
from sfm_shapefit.solver.options import SolverOptions


def check(
    model: ModelSource,
    database: Path | str | None = None,
    *,
    images: Path | str | None = None,
    max_minutes: float | None = None,
    second_opinion: bool | MapResult = True,
    progress: Progress | None = None,
) -> CheckResult:
    """Judge a COLMAP model as it stands, whatever program made it; the model is not changed.

    Args:
        model: a reconstruction, a result, a model folder or a list of poses, as for `locate`.
        database: as for `locate`; without one, the pairs are those that share points of the model, which
            agree with it more easily.
        images: folder of the model's pictures, from which features and matches of chosen pairs are made if
            there is no database.
        max_minutes: minutes after which no more of these are matched, so that the answer depends on the
            speed of the computer; 0: none is matched, and None: all are.
        second_opinion: whether `map_database` places the images of the database anew, to compare with; or
            what it made of that database already. The result has it under the same name; None without a
            database or pictures.
        progress: called as stages advance.

    Raises:
        InputError: if the model or the database cannot be used.
    """
    if max_minutes is not None and not max_minutes >= 0.0:
        raise InputError(f"max_minutes must be >= 0, got {max_minutes}")
    clock = Clock.of(progress, SolverOptions())
    with clock("read"):
        inputs = choose_inputs(model, database)
        asked = None
        if images is not None and inputs.database is None and max_minutes != 0.0:
            asked = AskedPictures(folder=Path(images), max_minutes=max_minutes)
        posed = read_by_itself(model, with_lenses=True) if asked else read_source(model, database)[0]
    other = None
    with ExitStack() as stack:
        if asked is not None:
            inputs = replace(stack.enter_context(match_pictures(posed, asked, clock)), folder=inputs.folder)
        source = stack.enter_context(open_source(posed, inputs))
        if second_opinion and isinstance(source.matches, DatabaseMatches):
            file = source.matches.file
            try:
                with clock("second opinion"):
                    other = _map_anew(file, posed, second_opinion, clock.anew())
            except InputError as error:
                if not inputs.is_found:
                    raise
                file.notes.append(f"there is no second opinion: {error}")
        return check_source(posed, source, DirectionOptions(), clock, other)


def _map_anew(
    file: DatabaseFile, posed: ColmapModel, found: bool | MapResult, clock: Clock
) -> OtherModel | None:
    """Return the model of the database that has most images in common; None if nothing can be placed."""
    if not isinstance(found, MapResult):
        try:
            found = map_opened(file, MapOptions(), clock)
        except UnsolvableError:
            return None
    models = [model.located for model in found.models]
    number = max(range(len(models)), key=lambda k: _num_common(posed.images, models[k].placed))
    best = models[number]
    doubted = np.zeros(best.placed.num_images, dtype=np.bool_)
    doubted[best.placement.cameras] = best.placement.assessment.ambiguous
    doubted |= best.placed.are_named([place.image for place in best.evidence.places])
    fits = fit_pairs(best.placed.centers, best.directions)
    return OtherModel(best.placed, fits, doubted, found, number)


def _num_common(images: Images, others: Images) -> int:
    return int(np.sum(same_images(images.names, others.names).places >= 0))
