"""`check FOLDER` of several models of one set of images, as COLMAP's mapper leaves them: one table."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.wording import counted
from sfm_shapefit.facts.checked_pieces import CheckedPiece, CheckedPieces
from sfm_shapefit.facts.map_result import MapResult
from sfm_shapefit.files.colmap.database import find_database
from sfm_shapefit.files.model_folder import model_folders
from sfm_shapefit.judgement.limits import FEW, HALF
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.pipeline.check import check
from sfm_shapefit.pipeline.clock import Progress
from sfm_shapefit.pipeline.map import map_database
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.sequences import find_sequences


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
    source = database if database is not None else find_database(models[0])
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
            found = check(path, database, second_opinion=second_opinion, progress=progress)
        except InputError as error:
            pieces.append(CheckedPiece(folder=name, error=str(error)))
            continue
        images[name] = found.model.images
        widths = images[name].focal_widths
        lenses = (float(widths.min()), float(widths.max()))
        pieces.append(CheckedPiece(folder=name, focal_widths=lenses, facts=found.facts))
    if not images:
        raise InputError(f"{folder} holds no COLMAP model that can be read; {pieces[0].error}")
    keep = set(_choose(pieces, images))
    pieces = [replace(one, keep=one.folder in keep) for one in pieces]
    return CheckedPieces(pieces=tuple(pieces), contradictions=(*_compare_lenses(images), *_shared(images)))


def _choose(pieces: Sequence[CheckedPiece], images: Mapping[str, Images]) -> Iterator[str]:
    """Yield the folders of the models to keep."""
    usable = [p for p in pieces if p.facts and p.facts.verdict.grade in (Grade.GOOD, Grade.LOOK)]
    taken = set[str]()
    for one in sorted(usable, key=lambda one: -images[one.folder].num_images):
        names = set(images[one.folder].names)
        if len(names - taken) >= HALF * len(names):
            taken |= names
            yield one.folder


def _compare_lenses(images: Mapping[str, Images]) -> Iterator[str]:
    """Yield where models disagree on the focal length of one device."""
    names = [name for one in images.values() for name in one.names]
    widths = np.concatenate([one.focal_widths for one in images.values()])
    model = np.repeat(np.arange(len(images)), [one.num_images for one in images.values()])
    for rows, _ in find_sequences(names):
        there = np.unique(model[rows])
        typical = np.array([np.median(widths[rows][model[rows] == k]) for k in there])
        if np.ptp(np.log(typical)) > FEW:
            least, most = (Path([*images][there[k]]).name for k in (typical.argmin(), typical.argmax()))
            yield (
                f"one device, as {names[rows[0]]} and others say, has a focal length of {typical.min():.3g} "
                f"picture widths in {least} and of {typical.max():.3g} in {most}: give its images one camera "
                "(--ImageReader.single_camera 1), and reconstruct again"
            )


def _shared(images: Mapping[str, Images]) -> Iterator[str]:
    """Yield which models have images in common."""
    for (one, mine), (other, others) in combinations(images.items(), 2):
        if common := len(set(mine.names) & set(others.names)):
            both = f"{Path(one).name} and {Path(other).name} have {counted(common, 'image')} in common"
            yield f"{both}; sfm-shapefit join puts them into one world"
