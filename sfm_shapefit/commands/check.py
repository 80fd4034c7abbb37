"""`check MODEL`: the verdict on a COLMAP model as it stands, with a second opinion of our own."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from sfm_shapefit.base.clock import Clock, Progress
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.commands.map import map_database, map_opened
from sfm_shapefit.commands.pictures import match_pictures
from sfm_shapefit.facts.check_result import CheckResult, OtherModel
from sfm_shapefit.facts.checked_pieces import CheckedPiece, CheckedPieces
from sfm_shapefit.facts.command_options import MapOptions
from sfm_shapefit.facts.map_result import MapResult
from sfm_shapefit.files.colmap.database import DatabaseMatches
from sfm_shapefit.files.colmap.listed_poses import read_by_itself, read_source
from sfm_shapefit.files.colmap.model import ColmapModel, ModelSource
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.files.model_folder import model_folders
from sfm_shapefit.judgement.pair_fits import fit_pairs
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.pipeline.inputs import inputs_to_check, open_source
from sfm_shapefit.pipeline.referee import check_source
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.same_images import same_images


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
        database: as for `locate`, else the one that an output was made of; without one, the pairs are those
            that share points of the model, which agree with it more easily.
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
    clock = Clock.of(progress)
    with clock("read"):
        inputs = inputs_to_check(model, database)
        has_pictures = images is not None and inputs.database is None and max_minutes != 0.0
        posed = read_by_itself(model, with_lenses=True) if has_pictures else read_source(model, database)[0]
    other = None
    with ExitStack() as stack:
        if images is not None and has_pictures:
            made = stack.enter_context(match_pictures(posed, Path(images), max_minutes, clock))
            inputs = replace(made, folder=inputs.folder)
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
    file: DatabaseFile, posed: ColmapModel, mapped: bool | MapResult, clock: Clock
) -> OtherModel | None:
    """Return the model of the database that has most images in common; None if nothing can be placed."""
    if not isinstance(mapped, MapResult):
        try:
            mapped = map_opened(file, MapOptions(), clock)
        except UnsolvableError:
            return None
    models = mapped.models
    number = max(range(len(models)), key=lambda k: _num_common(posed.images, models[k].placed))
    best = models[number]
    doubted = np.zeros(best.placed.num_images, dtype=np.bool_)
    doubted[best.placement.cameras] = best.placement.assessment.ambiguous
    doubted |= best.placed.are_named([place.image for place in best.evidence.places])
    fits = fit_pairs(best.placed.centers, best.directions)
    return OtherModel(best.placed, fits, doubted, mapped, number)


def _num_common(images: Images, others: Images) -> int:
    return int(np.sum(same_images(images.names, others.names).places >= 0))


def check_pieces(
    folder: Path | str,
    database: Path | str | None = None,
    *,
    second_opinion: bool | MapResult = True,
    progress: Progress | None = None,
) -> CheckedPieces:
    """Judge each of several models in a folder, and say which to keep and what of them contradicts.

    A model is to be kept if it is good or to be looked at, and if half of its images or more are in no larger
    one that is kept. Models contradict one another if the focal lengths of one device differ by a tenth.

    Args:
        folder: has the models in folders that are called by numbers, as sparse has 0 and 1.
        database, second_opinion, progress: as for `check`; the database is mapped once.

    Raises:
        InputError: if the folder has no two models, or the database cannot be used.
    """
    models = model_folders(Path(folder))
    if len(models) < 2:
        raise InputError(f"{folder} has no models 0, 1, ...; give a folder of several, or `check` one")
    source = inputs_to_check(models[0], database).database
    if second_opinion is True and source is not None:
        try:
            second_opinion = map_database(source, progress=progress)
        except UnsolvableError:
            second_opinion = False  # nor could `check` map it, for any of the models
        except InputError:
            pass  # `check` says why
    pieces, images = [], dict[str, Images]()
    for path in models:
        name = str(path)
        try:
            checked = check(path, database, second_opinion=second_opinion, progress=progress)
        except InputError as error:
            pieces.append(CheckedPiece(folder=name, error=str(error)))
            continue
        images[name] = checked.model.images
        pieces.append(CheckedPiece.of_model(name, images[name], checked.facts))
    if not images:
        raise InputError(f"{folder} holds no COLMAP model that can be read; {pieces[0].error}")
    return CheckedPieces.compare(pieces, images)
