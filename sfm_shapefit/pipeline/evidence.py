"""Ask for evidence that the fit did not use: of our own models, and of any that is looked at."""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray
from sfm_shapefit.judgement.evidence import ModelEvidence, PairFits
from sfm_shapefit.judgement.grade import LEAST_HELD
from sfm_shapefit.judgement.seams import Cut, Seam, find_seams, tied_by_points
from sfm_shapefit.judgement.witnesses import FITTING_PX, are_confirmed
from sfm_shapefit.judgement.wrong_lenses import question_lenses
from sfm_shapefit.pipeline.doubts import ask_rotations
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.scene.images import Images, Pictures
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.filter import keypoint_errors_px

_MOST_POINTS = 40  # points per image that are asked what they hold; a few of each suffice

_MOST_ASKED = 200  # images of a lens that are left out; each takes 1.4 ms, and a median of so many is exact


class Structure(NamedTuple):
    """The points of a model, and what they are seen with."""

    points: Points
    """Points that the images see."""
    images: Images
    """Images where the model has them; NaN where it does not."""
    pictures: Pictures
    """Keypoints and lenses of the images."""
    among: BoolArray | None = None
    """(i,) images that make the points; all if None."""
    asked: BoolArray | None = None
    """(i,) images that are asked whether they contradict their lenses; all if None."""


def gather_evidence(
    source: MatchSource, fits: PairFits | None, structure: Structure, threads: int
) -> ModelEvidence:
    """Return the evidence against a model that its fit did not use.

    Args:
        source: the images, at the rotations of the model, and their matches.
        fits: of all pairs, their directions measured at these rotations; None if there are none.
        structure: the points of the model.
        threads: number of threads to use.
    """
    points, images, pictures, among, asked = structure
    _, lenses = question_lenses(points, images, pictures, threads, among, _ask_some(images, asked))
    if fits is None:
        return ModelEvidence(lenses=lenses)
    held = fits.held(images)
    cuts, num_held = fits.cuts(held), int(held.sum())
    if cuts or num_held < LEAST_HELD * images.num_images:
        fitting = keypoint_errors_px(points, images, pictures) <= FITTING_PX
        cuts = tuple(tied_by_points(cut, points, fitting, images.num_images) for cut in cuts)
        if num_held < LEAST_HELD * images.num_images:
            step = max(points.num_points // (_MOST_POINTS * images.num_images), 1)
            some = points.taken(fitting & (points.points_seen() % step == 0))
            num_held = max(num_held, int(fits.held(images, some).sum()))
    contradicted = fits.contradicted(images)
    doubted = np.isin(np.arange(images.num_images), [one.camera for one in contradicted])
    sure = ask_pixels(source, structure, doubted)
    return ModelEvidence(
        lenses=lenses,
        places=fits.other_places(),
        seams=_question_cuts(source, cuts, threads),
        contradicted=tuple(one for one in contradicted if not sure[one.camera]),
        num_held=num_held,
    )


def _ask_some(images: Images, asked: BoolArray | None) -> BoolArray | None:
    """Return which images (i,) are asked for their focal length: of a lens that took very many, only some."""
    every = np.bincount(images.lens_of[images.is_posed])
    if every.max(initial=0) <= _MOST_ASKED:
        return asked
    some = images.is_posed if asked is None else images.is_posed & asked
    for lens in np.unique(images.lens_of[some]).tolist():
        rows = np.flatnonzero(some & (images.lens_of == lens))
        some[rows] = np.arange(len(rows)) % -(-len(rows) // _MOST_ASKED) == 0
    return some


def ask_pixels(source: MatchSource, structure: Structure, doubted: BoolArray) -> BoolArray:
    """Return which doubted images (i,) stand where their pixels see the points that the others make.

    None is where the model has other keypoints than the matches.
    """
    points, images, pictures = structure[:3]
    view = source.view
    counts = [pictures.count(k) for k in range(images.num_images)] if doubted.any() else []
    if not points.num_points or counts != view.num_keypoints.tolist():
        return np.zeros_like(doubted)
    links = list(view.links(without=view.pairs[~doubted[view.pairs].any(axis=1)]))
    return are_confirmed(points, images, pictures, doubted, (view.num_keypoints, links))


def _question_cuts(source: MatchSource, cuts: tuple[Cut, ...], threads: int) -> tuple[Seam, ...]:
    """Return the cuts that are seams, by the rotations that pairs across have by themselves."""
    if not cuts:
        return ()
    across = np.concatenate([cut.contradicting for cut in cuts])
    return find_seams(cuts, ask_rotations(source, across, threads), source.images.rotations)
