"""Ask for evidence that the fit did not use: of our own models, and of any that is looked at."""

from dataclasses import replace

import numpy as np

from sfm_shapefit.base.arrays import BoolArray
from sfm_shapefit.judgement.evidence import ModelEvidence, PairFits
from sfm_shapefit.judgement.seams import Cut, Seam, find_seams
from sfm_shapefit.judgement.wrong_lenses import question_lenses
from sfm_shapefit.pipeline.doubts import ask_rotations
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.scene.images import Images, Pictures
from sfm_shapefit.scene.points import Points


def gather_evidence(
    images: Images,
    points: Points,
    pictures: Pictures,
    pairs: ModelEvidence,
    threads: int,
    among: BoolArray | None = None,
) -> ModelEvidence:
    """Return the evidence of a model's pairs, and that of its points.

    Args:
        images: where the model has them; NaN where it does not.
        points: of the images.
        pictures: keypoints and lenses of the images.
        pairs: evidence of its pairs.
        threads: number of threads to use.
        among: (i,) images that make the points; all if None.
    """
    _, lenses = question_lenses(points, images, pictures, threads, among)
    return replace(pairs, lenses=lenses)


def question_pairs(source: MatchSource, fits: PairFits, threads: int) -> ModelEvidence:
    """Return what the pairs of a source say against where its images stand.

    Args:
        source: the images, at the rotations of the model, and their matches.
        fits: of all pairs, their directions measured at these rotations.
        threads: number of threads to use.
    """
    seams = _question_cuts(source, fits.cuts(), threads)
    return ModelEvidence(places=fits.other_places(), seams=seams, num_held=fits.count_held())


def _question_cuts(source: MatchSource, cuts: tuple[Cut, ...], threads: int) -> tuple[Seam, ...]:
    """Return the cuts that are seams, by the rotations that pairs across have by themselves."""
    if not cuts:
        return ()
    across = np.concatenate([cut.contradicting for cut in cuts])
    return find_seams(cuts, ask_rotations(source, across, threads), source.images.rotations)
