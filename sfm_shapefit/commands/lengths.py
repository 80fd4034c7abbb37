"""How well lengths are known in a model: one that was made here, or any as it stands."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.place_errors import ScaleErrors, draws_at, errors_of_images
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.facts.lengths import (
    Axes,
    LengthBetween,
    LengthsFacts,
    errors_of,
    length_between,
    tell_length,
)
from sfm_shapefit.facts.scale_bars import MeasuredBars, compare_bars
from sfm_shapefit.facts.tables import model_datum, model_scale_sigma
from sfm_shapefit.files.colmap.control_points import read_control_points
from sfm_shapefit.files.colmap.listed_poses import read_by_itself
from sfm_shapefit.files.colmap.model import ModelSource
from sfm_shapefit.files.colmap.scale_bars import read_scale_bars
from sfm_shapefit.pipeline.bundle import estimate_errors
from sfm_shapefit.pipeline.gauge_choice import compare_control_points
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points
from sfm_shapefit.scene.same_images import names_among


def judge_bars(model: ModelSource, file: Path) -> MeasuredBars:
    """Return the scale bars of a file as a model has them; raises as `evaluate_lengths`."""
    images, _, estimate = estimate_errors(read_by_itself(model, with_lenses=True))
    return compare_bars(images, read_scale_bars(file, images), estimate, model_scale_sigma(model))


def evaluate_lengths(
    model: ModelSource,
    ends: Sequence[tuple[str | int, str | int]] = (),
    *,
    scale_bars: Path | str | None = None,
    control_points: Path | str | None = None,
) -> LengthsFacts:
    """Return how well lengths in a model are known, and how it compares with known lengths and points.

        found = evaluate_lengths("sparse/0", [("0001.jpg", "0004.jpg"), (17, 402)], scale_bars="bars.txt")
        print(found.usual.statement)
        print(found.lengths[0].length.interval)            # 2.503 ± 0.004 m (95 %), worst direction ...

    The errors are those that the pixels show where the model stands: noise, rotations, calibration. That of
    the scale is included where the model knows it, as one of `locate` does.

    Args:
        model: a result, reconstruction or model folder, whose images observe points.
        ends: two images, by name, or 3D points, by id, of each distance that is wanted.
        scale_bars: file of known lengths between points, as of `locate`; here they only check.
        control_points: gcp_list.txt, as of `locate`; a similarity maps the model onto three or more points.

    Raises:
        InputError: if the model, the bars or the points cannot be used, or it has no such image or point.
        UnsolvableError: if nothing is known of the errors of the `ends`: where images observe no points, or
            are above 2,000. Without `ends`, `usual` is None then.
    """
    _refuse_no_pairs(ends)
    posed = read_by_itself(model, with_lenses=True)
    seen = images, points, estimate = estimate_errors(posed)
    scale_sigma = model_scale_sigma(model)
    bars = None
    if scale_bars is not None:
        bars = compare_bars(images, read_scale_bars(Path(scale_bars), images), estimate, scale_sigma)
    datum, control, of_control = model_datum(model), None, list[str]()
    if control_points is not None:
        known = read_control_points(Path(control_points), images)
        control, of_control = compare_control_points(images, known, datum)
    axes = Axes(unit="m" if datum else "units", has_scale=scale_sigma is not None, has_up=datum is not None)
    scale = ScaleErrors(np.zeros(estimate.num_draws if estimate else 0), scale_sigma or 0.0)
    lengths = list(_between(seen, scale, axes, ends))
    told = {(one.first, one.second) for one in lengths}
    unknown = [f"{first} and {second}" for first, second in ends if (str(first), str(second)) not in told]
    return LengthsFacts(
        usual=length_between(images, points, estimate, scale, axes),
        lengths=lengths,
        scale_bars=bars.rows() if bars else (),
        control_points=control,
        scale_sigma=scale_sigma,
        warnings=[
            *posed.notes,
            *(bars.warnings() if bars else ()),
            *of_control,
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
        places = cameras.followed_by(errors_of(images, points, estimate, chosen[~own]))
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
