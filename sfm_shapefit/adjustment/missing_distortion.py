"""Whether lenses without distortion have one after all, by how far the cameras move with it.

A distortion that a lens model lacks goes into poses and points: corridors bend, walls dome, and residuals
hardly show it. So each such lens gets the coefficient of the division model, which is 0 as it stands, and few
points are adjusted with it, focal lengths free. A distortion is missing if two things are so, from the
minimum without coefficients to the one with them:

    size          one camera in twenty, or more, moves by over 2 % of their median distance from the middle
    significance  if a coefficient is s standard deviations off, the cost falls by s^2 / 2, and its falls by
                  groups of neighboring points have a root of the sum of squares of s. So twice their sum over
                  that root is s, whatever neighbors share; of q coefficients it is about q^1/2 by chance, and
                  3 more hardly ever (Vuong, "Likelihood ratio tests for model selection", 1989).
"""

from dataclasses import replace

import numpy as np

from sfm_shapefit.adjustment.freedom import Freedom
from sfm_shapefit.adjustment.given_rotations import noise_px_of
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.run import MOST_FRAMES, begin
from sfm_shapefit.adjustment.shared_errors import group_neighbors
from sfm_shapefit.adjustment.solve import reprojection_errors_px
from sfm_shapefit.adjustment.views import views_of
from sfm_shapefit.base.arrays import BoolArray, IntArray, quantile
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.executors import Crew
from sfm_shapefit.base.geometry import fit_similarity_l1
from sfm_shapefit.base.losses import CAUCHY, loss
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import Lens, Origin
from sfm_shapefit.scene.structure import Structure
from sfm_shapefit.tracks.links import ObservedTracks
from sfm_shapefit.tracks.structure_options import StructureOptions
from sfm_shapefit.tracks.thin_tracks import choose_thin_tracks
from sfm_shapefit.tracks.triangulation import TriangulatedPoints

_BENT = {"SIMPLE_PINHOLE": "SIMPLE_DIVISION", "PINHOLE": "DIVISION"}
_LARGE, _MOST = 0.02, 0.95  # share of the median distance from the middle; share of the cameras
_SIGMAS, _FALL = 3.0, 1e-4  # see the header; relative fall of the cost, as in a thin solve


def find_missing_distortion(
    structure: Structure, asked: BoolArray, *, rotations_held: bool = False, threads: int = 0
) -> tuple[IntArray, float]:
    """Return the images whose lenses miss a distortion, and the share that cameras move by; see the header.

    Only posed images that are `asked` (i,) have a part in it. There are none with lenses that no adjustment
    knows, nor with more frames than are worth the time.
    """
    rows = np.flatnonzero(structure.images.is_posed & asked)
    images, nobody = structure.images.part(rows), (rows[:0], 0.0)
    is_bent = np.array([lens.model in _BENT for lens in images.lenses], dtype=np.bool_)
    are_known = all(lens.is_adjustable for lens in images.lenses)
    if not (is_bent.any() and are_known and 2 < len(images.frames.ids) <= MOST_FRAMES):
        return nobody
    images = images.with_lenses([_bend(lens) if lens.model in _BENT else lens for lens in images.lenses])
    tracks = _few_tracks(structure, images, rows)
    if not len(tracks[1].points):
        return nobody
    bends = Freedom(parts=np.stack([is_bent, is_bent], axis=1), pull_rad=0.0 if rotations_held else np.inf)
    run = replace(begin(images, tracks[0], StructureOptions(), bends, crew=Crew(threads)), links=None)
    problem = run.problem(*tracks)
    if np.isnan(reprojection_errors_px(problem)).all():  # all points lie behind the cameras
        return nobody
    run = replace(run, freedom=replace(bends, noise_px=noise_px_of(problem)))
    try:
        if _move(problem, run.solve(problem, _FALL, settles_points=True)[1]) <= _LARGE:
            return nobody  # as nearly always, after one solve
        straight = replace(run, freedom=replace(run.freedom, parts=bends.parts & [True, False]))
        after, before = straight.solve(problem, _FALL, settles_points=True)
        after, last = replace(after, freedom=run.freedom).solve(before, _FALL, settles_points=True)
    except UnsolvableError:
        return nobody
    share, score = _move(before, last), _score(before, last, after.loss_scale_px)
    is_missing = share > _LARGE and score > np.sqrt(is_bent.sum()) + _SIGMAS
    return (rows[is_bent[images.lens_of]], share) if is_missing else nobody


def _bend(lens: Lens) -> Lens:
    bent = replace(lens, model=_BENT[lens.model], parameters=(*lens.parameters, 0.0))
    return bent.in_doubt(Origin.GUESS)


def _few_tracks(
    structure: Structure, images: Images, rows: IntArray
) -> tuple[ObservedTracks, TriangulatedPoints]:
    """Return few tracks that hold the images, which are some rows of the structure's, and their points."""
    place = np.full(structure.images.num_images, -1)
    place[rows] = np.arange(len(rows))
    seen = structure.points.paired(place[structure.points.images] >= 0)
    points, pixels = structure.points.taken(seen), structure.pixels[seen]
    chosen = choose_thin_tracks(points.offsets, place[points.images], pixels, len(rows))
    is_chosen = np.isin(points.points_seen(), chosen)
    points, pixels = points.taken(is_chosen), pixels[is_chosen]
    tracks = ObservedTracks(
        offsets=points.offsets,
        cameras=np.searchsorted(views_of(images).images, place[points.images]).astype(np.int32),
        keypoints=points.keypoints,
        pixels=pixels,
        on_plane=np.zeros_like(pixels),
        ids=points.ids,
        may_split=False,
    )
    return tracks, TriangulatedPoints.of_tracks(tracks, points.xyz)


def _move(before: AdjustmentProblem, after: AdjustmentProblem) -> float:
    """Return how far frames move but for a similarity, the least of the farthest, as a share; see above."""
    own = before.centers
    arms = np.linalg.norm(own - np.median(own, axis=0), axis=1)
    apart = np.linalg.norm(fit_similarity_l1(after.centers, own).apply(after.centers) - own, axis=1)
    return float(quantile(apart, _MOST) / max(np.median(arms), np.finfo(float).tiny))


def _score(before: AdjustmentProblem, after: AdjustmentProblem, scale_px: float) -> float:
    errors_px = (reprojection_errors_px(one) for one in (before, after))
    first, then = (np.nan_to_num(loss(CAUCHY, (own / scale_px) ** 2)) for own in errors_px)
    falls = np.bincount(group_neighbors(before.points)[before.points_seen], first - then)
    return float(2.0 * falls.sum() / max(np.linalg.norm(falls), np.finfo(float).tiny))
