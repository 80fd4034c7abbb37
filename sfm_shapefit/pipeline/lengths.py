"""How well lengths are known in a model: one that was made here, or any as it stands."""

import numpy as np

from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.place_errors import (
    ScaleErrors,
    draws_at,
    errors_of_images,
    errors_of_points,
)
from sfm_shapefit.facts.lengths import Axes, LengthFacts, spread_rows, tell_usual_length
from sfm_shapefit.facts.placed import UNITS
from sfm_shapefit.facts.scale_bars import MeasuredBars
from sfm_shapefit.files.colmap.marks import look_at_marks
from sfm_shapefit.pipeline.state import ModelState
from sfm_shapefit.placement.control_points import triangulate_marks
from sfm_shapefit.placement.scale_bars import pooled_noise
from sfm_shapefit.scene.given import ScaleBars
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.structure_options import StructureOptions

_ARBITRARY = ("input", "unit")


def measure_bars(
    images: Images, known: ScaleBars, estimate: Estimate | None, options: StructureOptions
) -> MeasuredBars:
    """Return scale bars as images have them where they stand, by what is known of the errors of these."""
    marks = triangulate_marks(known, look_at_marks(images, known), options)
    rows = np.flatnonzero(images.is_posed)
    posed, used = images.part(rows), marks.agreeing
    seen = known.points[used], np.searchsorted(rows, known.images[used])
    noise_px = np.nan if estimate is None else estimate.noise_px
    noise_px = pooled_noise(marks.errors_px[used], seen[0], noise_px)
    ends = errors_of_points(posed, draws_at(estimate, posed), marks.positions, seen, noise_px)
    return MeasuredBars(known, marks, ends.apart(known.ends))


def usual_length(state: ModelState) -> LengthFacts | None:
    """Return how well a length between points of a finished model is known; None where it is not known."""
    gauge = state.gauge
    axes = Axes(
        unit="m" if gauge.datum else UNITS[gauge.scale],
        has_scale=gauge.scale not in _ARBITRARY,
        has_up=gauge.datum is not None or state.inputs.known.gravity is not None,
    )
    return length_between(state.images, state.points, state.estimate, scale_errors(state), axes)


def length_between(
    images: Images, points: Points, estimate: Estimate | None, scale: ScaleErrors, axes: Axes
) -> LengthFacts | None:
    """Return how well a usual length between points of a model is known; None where it is not known."""
    if estimate is None or estimate.draws is None or not points.num_points:
        return None
    rows, chosen = np.flatnonzero(images.is_posed), spread_rows(points.lengths())
    observed = np.concatenate([np.arange(*points.offsets[k : k + 2]) for k in chosen.tolist()])
    of = np.repeat(np.arange(len(chosen)), points.lengths()[chosen])
    posed, seen = images.part(rows), (of, np.searchsorted(rows, points.images[observed]))
    draws = draws_at(estimate, posed)
    places = errors_of_points(posed, draws, points.xyz[chosen], seen, estimate.noise_px)
    return tell_usual_length(places, scale, axes)


def scale_errors(state: ModelState) -> ScaleErrors:
    """Return the errors of a scale that the adjustment did not have: of bars, distances or control points."""
    gauge, estimate = state.gauge, state.estimate
    if state.bars is not None and state.bars.fit is not None:
        return state.bars.fit.errors
    count = 0 if estimate is None or estimate.draws is None else estimate.draws.shape[2]
    draws, sigma = np.zeros(count), 0.0
    if gauge.scale in ("control points", "distance"):
        sigma = gauge.scale_sigma or 0.0
    if gauge.scale == "distance" and count:
        place_of = {name: k for k, name in enumerate(state.images.names)}
        ends = np.array([[place_of[first], place_of[second]] for first, second, _ in state.inputs.distances])
        known = errors_of_images(state.images, draws_at(estimate, state.images)).apart(ends)
        shared = known.length_draws / known.lengths[:, None]
        shared = shared[np.isfinite(shared).all(axis=1)]
        draws = -shared.mean(axis=0) if len(shared) else draws
    return ScaleErrors(draws, sigma)
