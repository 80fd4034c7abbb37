"""How well lengths are known in a model: one that was made here, or any as it stands."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.freedom import Freedom
from sfm_shapefit.adjustment.place_errors import (
    PlaceErrors,
    ScaleErrors,
    draws_at,
    errors_of_images,
    errors_of_points,
)
from sfm_shapefit.adjustment.run import begin
from sfm_shapefit.adjustment.scale_bars import pooled_noise
from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.facts.lengths import (
    Axes,
    LengthBetween,
    LengthFacts,
    LengthsFacts,
    spread_rows,
    tell_length,
    tell_usual_length,
)
from sfm_shapefit.facts.placed import UNITS
from sfm_shapefit.facts.scale_bars import MeasuredBars
from sfm_shapefit.facts.tables import model_datum, model_scale_sigma
from sfm_shapefit.files.colmap.listed_poses import read_by_itself
from sfm_shapefit.files.colmap.marks import look_at_marks
from sfm_shapefit.files.colmap.model import ColmapModel, ModelSource
from sfm_shapefit.files.colmap.points import points_of
from sfm_shapefit.files.colmap.scale_bars import read_scale_bars
from sfm_shapefit.pipeline.bundle_adjust import read_bundle
from sfm_shapefit.pipeline.state import ModelState
from sfm_shapefit.placement.control_points import triangulate_marks
from sfm_shapefit.scene.given import ScaleBars
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points
from sfm_shapefit.scene.same_images import names_among
from sfm_shapefit.tracks.structure_options import StructureOptions
from sfm_shapefit.tracks.triangulation import TriangulatedPoints

ARBITRARY = ("input", "unit")
"""Kinds of scale that give way to known lengths."""


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


def compare_bars(
    images: Images, known: ScaleBars, estimate: Estimate | None, scale_sigma: float | None
) -> MeasuredBars:
    """Return scale bars that only check a model, whose scale has an error, as far as that is known."""
    found = measure_bars(images, known, estimate, StructureOptions())
    count = found.found.draws.shape[2]
    return found._replace(found=found.found.in_scale(ScaleErrors(np.zeros(count), scale_sigma or 0.0)))


def usual_length(state: ModelState) -> LengthFacts | None:
    """Return how well a length between points of a finished model is known; None where it is not known."""
    gauge = state.gauge
    axes = Axes(
        unit="m" if gauge.datum else UNITS[gauge.scale],
        has_scale=gauge.scale not in ARBITRARY,
        has_up=gauge.datum is not None or state.inputs.known.gravity is not None,
    )
    return length_between(state.images, state.points, state.estimate, scale_errors(state), axes)


def length_between(
    images: Images, points: Points, estimate: Estimate | None, scale: ScaleErrors, axes: Axes
) -> LengthFacts | None:
    """Return how well a usual length between points of a model is known; None where it is not known."""
    if estimate is None or estimate.draws is None or not points.num_points:
        return None
    return tell_usual_length(_errors_of(images, points, estimate, spread_rows(points.lengths())), scale, axes)


def _errors_of(images: Images, points: Points, estimate: Estimate, chosen: IntArray) -> PlaceErrors:
    """Return the errors of some points of a model, by their rows."""
    rows = np.flatnonzero(images.is_posed)
    observed = points.rows_of(chosen)
    seen = observed.list_of_rows(), np.searchsorted(rows, points.images[observed.rows])
    posed = images.part(rows)
    return errors_of_points(posed, draws_at(estimate, posed), points.xyz[chosen], seen, estimate.noise_px)


def scale_errors(state: ModelState) -> ScaleErrors:
    """Return the errors of a scale that the adjustment did not have: of bars, distances or control points."""
    gauge, estimate = state.gauge, state.estimate
    if state.bars is not None and state.bars.fit is not None:
        return state.bars.fit.errors
    count = _num_draws(estimate)
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


def judge_bars(model: ModelSource, file: Path) -> MeasuredBars:
    """Return the scale bars of a file as a model has them; raises as `evaluate_lengths`."""
    images, _, estimate = _estimate_of(read_by_itself(model, with_lenses=True))
    return compare_bars(images, read_scale_bars(file, images), estimate, model_scale_sigma(model))


def evaluate_lengths(
    model: ModelSource,
    ends: Sequence[tuple[str | int, str | int]] = (),
    *,
    scale_bars: Path | str | None = None,
) -> LengthsFacts:
    """Return how well lengths in a model are known, and how it compares with known ones.

        found = evaluate_lengths("sparse/0", [("0001.jpg", "0004.jpg"), (17, 402)], scale_bars="bars.txt")
        print(found.usual.statement)
        print(found.lengths[0].length.interval)            # 2.503 ± 0.004 (95 %), worst direction ...

    The errors are those that the pixels show where the model stands: noise, rotations, calibration. That of
    the scale is included where the model knows it, as one of `locate` does.

    Args:
        model: a result, reconstruction or model folder, whose images observe points.
        ends: two images, by name, or 3D points, by id, of each distance that is wanted.
        scale_bars: file of known lengths between points, as of `locate`; here they only check.

    Raises:
        InputError: if the model or the bars cannot be used, or it has no such image or point.
        UnsolvableError: if nothing is known of the errors of the `ends`: where images observe no points, or
            are above 2,000. Without `ends`, `usual` is None then.
    """
    _refuse_no_pairs(ends)
    posed = read_by_itself(model, with_lenses=True)
    seen = images, points, estimate = _estimate_of(posed)
    scale_sigma = model_scale_sigma(model)
    bars = None
    if scale_bars is not None:
        bars = compare_bars(images, read_scale_bars(Path(scale_bars), images), estimate, scale_sigma)
    datum = model_datum(model)
    axes = Axes(unit="m" if datum else "units", has_scale=scale_sigma is not None, has_up=datum is not None)
    scale = ScaleErrors(np.zeros(_num_draws(estimate)), scale_sigma or 0.0)
    lengths = list(_between(seen, scale, axes, ends))
    known = {(one.first, one.second) for one in lengths}
    unknown = [f"{first} and {second}" for first, second in ends if (str(first), str(second)) not in known]
    return LengthsFacts(
        usual=length_between(images, points, estimate, scale, axes),
        lengths=lengths,
        scale_bars=bars.rows() if bars else (),
        scale_sigma=scale_sigma,
        warnings=[
            *posed.notes,
            *(bars.warnings() if bars else ()),
            *(f"nothing is known of the error of the distance of {ends}; choose others" for ends in unknown),
        ],
    )


def _refuse_no_pairs(ends: object) -> None:
    """Refuse what is no list of pairs, one pair outside a list included."""
    listed = ends if isinstance(ends, list | tuple) else [ends]
    if not all(isinstance(pair, list | tuple) and len(pair) == 2 for pair in listed):
        raise InputError(
            'ends must be a list of pairs of places, such as [("0001.jpg", "0004.jpg"), (17, 402)]'
        )


def _num_draws(estimate: Estimate | None) -> int:
    return 0 if estimate is None or estimate.draws is None else estimate.draws.shape[2]


def _estimate_of(model: ColmapModel) -> tuple[Images, Points, Estimate | None]:
    """Return posed images and points of a model, and what its observations tell of the errors of these."""
    if not model.num_points:
        return model.images, points_of(model.arrays, model.images), None
    images, points, tracks = read_bundle(model.arrays)
    options = StructureOptions()
    run = begin(images, tracks, options, Freedom())
    problem = run.problem(tracks, TriangulatedPoints.of_tracks(tracks, points.xyz))
    scale_px = run.choose_scale(problem) * options.max_reprojection_error_px
    return images, points, replace(run, loss_scale_px=scale_px).estimate(problem)


def _between(
    seen: tuple[Images, Points, Estimate | None],
    scale: ScaleErrors,
    axes: Axes,
    ends: Sequence[tuple[str | int, str | int]],
) -> Iterator[LengthBetween]:
    """Yield how well the distance of each two places of a model is known."""
    images, points, estimate = seen
    if not ends:
        return
    if estimate is None or estimate.draws is None:
        raise UnsolvableError(
            "errors are known of models of at most 2,000 frames whose images observe 3D points; leave "
            "lengths out"
        )
    cameras = errors_of_images(images, draws_at(estimate, images))
    for first, second in ends:
        rows = np.array([_row_of(images, points, end) for end in (first, second)])
        if rows[0] == rows[1]:
            raise InputError(f"{first} and {second} are one place, and no length; name two")
        own, chosen = rows < images.num_images, rows - images.num_images
        places = cameras.followed_by(_errors_of(images, points, estimate, chosen[~own]))
        rows[~own] = images.num_images + np.arange(np.sum(~own))
        apart = places.apart(rows[None]).in_scale(scale)
        if found := tell_length(apart, float(apart.lengths[0]), axes):
            yield LengthBetween(first=str(first), second=str(second), length=found)


def _row_of(images: Images, points: Points, end: str | int) -> int:
    """Return the row of an image by its name, or after all images that of a point by its id."""
    named, ambiguity = names_among([str(end)], images.names)
    if isinstance(end, str) and end in named:
        return images.names.index(named[end])
    known = np.flatnonzero(points.ids == int(end)).tolist() if str(end).isdecimal() else []
    if not known:
        why = f" ({ambiguity})" if ambiguity else ""
        raise InputError(
            f"the model has no posed image {end}{why}, and no 3D point of such an id; name another"
        )
    return images.num_images + int(known[0])
