"""Ask whether an input is in another program's convention, or resolution, where its matches contradict it."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from sfm_shapefit.base.arrays import rank_within
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import rotation_angles_deg
from sfm_shapefit.facts.result import LocateResult
from sfm_shapefit.files.colmap.database import DatabaseMatches
from sfm_shapefit.files.colmap.points import ModelKeypoints
from sfm_shapefit.files.colmap.track_matches import TrackMatches
from sfm_shapefit.judgement.conventions import PoseFile, Recognized, recognize_convention
from sfm_shapefit.judgement.reasons import IS_ITS_DATABASE, Grade, Kind, of_model
from sfm_shapefit.judgement.resolutions import recognize_resolution, recognize_sizes
from sfm_shapefit.pipeline.doubts import ask_rotations
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.scene.structure import Structure

_FIRST_PAIRS = 3  # pairs of each image; those with most matches are asked
_MOST_PAIRS = 200  # pairs that are asked at all; a second
_LEAST_AGREEING = 0.75  # share of the pairs; in another convention nearly all contradict
_MOST_TURNED_DEG = 5.0  # degrees; other conventions are off by tens


def ask_resolution(source: MatchSource) -> Recognized | None:
    """Return in what resolution pixels are, of a database or of points; None if in that of the cameras."""
    matches, view = source.matches, source.view
    if isinstance(matches, DatabaseMatches):
        return recognize_sizes(source.images.sizes_px, matches.sizes_px())
    if isinstance(matches, TrackMatches):
        pictures = ModelKeypoints(view.images, view.keypoints, view.num_keypoints)
        return recognize_resolution(Structure(matches.points_of(view.images), view.images, pictures))
    return None


def ask_convention(source: MatchSource, threads: int) -> Recognized | None:
    """Return the convention that the poses of a source look like; None if it is the one they are read by.

    Another resolution comes first. In rigs of several cameras, whose poses are of frames, no convention is
    recognized.
    """
    view, folder = source.view, source.inputs.folder
    resolution = ask_resolution(source)
    if resolution is not None:
        return resolution
    if source.images.has_rigs or not view.num_pairs:
        return None
    written: PoseFile = "model"
    if folder is not None and not folder.is_dir():
        written = "transforms" if folder.suffix.lower() == ".json" else "trajectory"
    counts = np.repeat(-view.matches.num_matches[view.rows].astype(np.int64), 2)
    rank = rank_within(view.pairs.ravel(), counts).reshape(-1, 2).min(axis=1)
    chosen = np.lexsort((counts[::2], rank))[:_MOST_PAIRS]
    pairs = view.pairs[np.sort(chosen[rank[chosen] < _FIRST_PAIRS])]
    return recognize_convention(source.images.rotations, ask_rotations(source, pairs, threads), written)


@contextmanager
def naming_convention(source: MatchSource, threads: int) -> Iterator[None]:
    """Say in what convention the input seems to be, where its cameras cannot be placed.

    Raises:
        UnsolvableError: that says so, or as before.
    """
    try:
        yield
    except UnsolvableError as error:
        if recognized := ask_convention(source, threads):
            raise UnsolvableError(recognized.sentence) from error
        raise


def _are_rotations_doubtful(result: LocateResult, source: MatchSource) -> bool:
    """Return whether matches turned most of the given rotations, or many pairs contradict the result."""
    if isinstance(source.matches, TrackMatches) or not result.agreeing_pairs >= _LEAST_AGREEING:
        return True
    turned = result.images.rotations @ source.images.rotations.transpose(0, 2, 1)
    return not float(np.nanmedian(rotation_angles_deg(turned))) <= _MOST_TURNED_DEG


def tell_convention(result: LocateResult, source: MatchSource, threads: int) -> LocateResult:
    """Return a result that is not good with the convention that its input is in, if that can be told."""
    is_asked = result.verdict.grade is not Grade.GOOD and _are_rotations_doubtful(result, source)
    recognized = ask_convention(source, threads) if is_asked else None
    if recognized is None:
        return result
    others = tuple(one for one in result.suspicions if not one.sentence.endswith(IS_ITS_DATABASE))
    first = recognized.sentence + ("; other warnings may come of that" if result.warnings else "")
    warnings = (first, *result.warnings)
    reason = of_model(Kind.INPUT, recognized.clause)
    return replace(result, recognized=reason, suspicions=others, warnings=warnings)
