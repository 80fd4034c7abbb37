"""What models know of their cameras once they are joined: who is trusted, and how well a center is known.

Errors of a join come on top of those of its models, as if they moved each camera of the joined model alike:

    C' = s^2 R C R^T + sigma^2 / 3 I        sigma, the standard deviation of where its cameras come to lie
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.facts.check_result import CheckResult
from sfm_shapefit.facts.joins import JoinFacts
from sfm_shapefit.facts.map_result import JoinedModel
from sfm_shapefit.facts.model import JoinedFacts
from sfm_shapefit.facts.placed import KeyFigures, unit_of
from sfm_shapefit.facts.result import Inputs, LocateResult
from sfm_shapefit.facts.rows import correlations_of, covariances_of
from sfm_shapefit.facts.scale_bars import compare_bars
from sfm_shapefit.facts.scene import told_distances
from sfm_shapefit.facts.tables import CameraRow, Table
from sfm_shapefit.judgement.reasons import Grade, ModelVerdict
from sfm_shapefit.placement.gauge import Gauge
from sfm_shapefit.placement.gauge_options import KnownDistance
from sfm_shapefit.scene.given import ScaleBars

if TYPE_CHECKING:
    import pycolmap

_SIGMA_OF = (
    "joined: what the models know of their cameras, and how well the joins are known; relative to the mean "
    "position and scale of the first"
)


class JoinedGroup(NamedTuple):
    """Models in the world of the first of them."""

    reconstruction: "pycolmap.Reconstruction"
    world_from: Mapping[int, Similarity]
    """By the number of each model, the first one's first."""
    joins: Sequence[JoinFacts]
    tied: Sequence[tuple[str, str]] = ()
    """Images of models that are joined, which stand rightly to one another as far as the joins do."""


def joined_camera_rows(
    checked: Table[CameraRow], group: JoinedGroup, located: Mapping[int, LocateResult]
) -> Table[CameraRow]:
    """Return the rows of the cameras that stand in the joined model, then those of the other images."""
    numbers = [number for number in group.world_from if number in located]
    own = {
        name: (number, row)
        for number in reversed(numbers)
        for row, name in enumerate(located[number].cameras.columns["name"])
    }
    variances, columns = _variances_of_joins(group), {k: v.copy() for k, v in checked.columns.items()}
    errors = {k: _errors(located[k].cameras, group.world_from[k], variances[k]) for k in numbers}
    for row in np.flatnonzero(checked.columns["placed"]).tolist():
        if (name := columns["name"][row]) in own:
            number, source = own[name]
            before = located[number].cameras[source]
            columns["reason"][row] = "; ".join(filter(None, [before.reason, columns["reason"][row]]))
            columns["trust"][row] = before.trust
            columns["sigma"][row], columns["correlation"][row] = (part[source] for part in errors[number])
    names = set(columns["name"])
    others = [located[number].cameras[row] for name, (number, row) in own.items() if name not in names]
    more = {name: [getattr(row, name) for row in others] for name in ("name", "reason", "trust")}
    return checked.changed(columns).followed_by(Table(CameraRow, 3, more))


def _variances_of_joins(group: JoinedGroup) -> dict[int, float]:
    """Return what the joins add to the variance of a center along an axis, by the number of its model."""
    found = dict.fromkeys(group.world_from, 0.0)
    for done in group.joins:  # ascending, so that the model that it is joined to is there
        assert done.join is not None
        sigma = group.world_from[done.to_number].scale * done.join.center_sigma
        found[done.number] = found[done.to_number] + sigma**2 / 3.0
    return found


def _errors(rows: Table[CameraRow], world_from: Similarity, variance: float) -> tuple[FloatArray, FloatArray]:
    """Return standard deviations and correlations (n, 3) of centers in the joined model, where known."""
    own = covariances_of(rows)
    known = np.isfinite(own).all(axis=(1, 2))
    turned = world_from.scale**2 * world_from.rotation @ own[known] @ world_from.rotation.T
    covariances = turned + variance * np.eye(3)
    sigmas, correlations = rows.columns["sigma"].copy(), rows.columns["correlation"].copy()
    sigmas[known] = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    correlations[known] = correlations_of(covariances)
    return sigmas, correlations


def joined_verdict(
    seen: ModelVerdict, group: JoinedGroup, located: Mapping[int, LocateResult]
) -> ModelVerdict:
    """Return the verdict on joined models: as they are `seen` together, and no better than any of them.

    A model that could not be judged by itself is judged in the joined one.
    """
    said = [
        one if one.of_each else replace(one, sentence=f"model {number}: {one.sentence}")
        for number in group.world_from
        if number in located
        for one in located[number].verdict.findings
        if one.grade is not Grade.CANNOT_BE_JUDGED
    ]
    return ModelVerdict.weigh([*said, *seen.findings])


class JoinInputs(NamedTuple):
    """What is known of joined models beside the models."""

    joins: Sequence[JoinFacts]
    """What came of joining each model to another."""
    options: Mapping[str, Any]
    inputs: Inputs
    """Where matches come from."""
    distances: Sequence[KnownDistance] = ()
    bars: ScaleBars | None = None
    """Scale bars with their marks in the images of the group."""
    located: Mapping[int, LocateResult] = MappingProxyType({})
    """The models by number, as far as they are ours, with what is known of their cameras."""
    notes: Sequence[str] = ()
    """What was read otherwise than it stands in the models."""


def tell_joined(group: JoinedGroup, told: JoinInputs, checked: CheckResult, gauge: Gauge) -> JoinedModel:
    """Return joined models in a gauge with what is told of them, beside what `check` said of them."""
    first, located, images = next(iter(group.world_from)), told.located, checked.model.images
    labels = {
        k: name for one in group.joins for k, name in ((one.number, one.model), (one.to_number, one.to))
    }
    folder = f"joined_{first}" if located else "."
    seen, measures = checked.facts, (float(np.median(images.focal_lengths_px)), unit_of(gauge))
    cameras = joined_camera_rows(checked.cameras, group, located)
    bars = told.bars and compare_bars(images, told.bars, None, gauge.scale_sigma)
    facts = JoinedFacts.taken_from(
        seen,
        inputs=told.inputs.facts,
        options=dict(told.options),
        verdict=joined_verdict(seen.verdict, group, located),
        models=[labels[number] for number in group.world_from],
        joins=[
            replace(one, folder=folder if one.joined and one.number in labels else None) for one in told.joins
        ],
        num_images=len(cameras),
        num_placed=group.reconstruction.num_reg_images(),
        figures=KeyFigures.of_cameras(cameras, seen.figures.pair_error_deg, *measures),
        sigma_of=_SIGMA_OF if located else "",
        scale=gauge.statement,
        scale_sigma=gauge.scale_sigma,
        known_distances=told_distances(told.distances, images),
        scale_bars=bars.rows() if bars else (),
        datum=gauge.datum,
        warnings=[
            *(*told.notes, *seen.warnings, *filter(None, [gauge.warning])),
            *(bars.warnings() if bars else ()),
        ],
    )
    return JoinedModel(
        reconstruction=group.reconstruction,
        models=tuple(group.world_from),
        joins=tuple(told.joins),
        cameras=cameras,
        pairs=checked.pairs,
        facts=facts,
    )
