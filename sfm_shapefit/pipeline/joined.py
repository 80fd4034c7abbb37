"""What is said of models that were joined: scale, verdict, and rows for cameras and pairs, as of one model.

Nothing is placed anew. The joined model is judged as `check MODEL` judges any, pairs between the models
too, and what its models know of their own cameras is kept: who is not trusted, and why, and how well a center
is known. Errors of a join come on top, as if they moved each camera of the model that was joined alike:

    C' = s^2 R C R^T + sigma^2 / 3 I        sigma, the standard deviation of where its cameras come to lie

The verdict is no better than that of any of the models.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import Similarity, compose
from sfm_shapefit.facts.joins import Joined
from sfm_shapefit.facts.map_result import JoinedModel
from sfm_shapefit.facts.model import JoinedFacts
from sfm_shapefit.facts.placed import UNITS, KeyFigures
from sfm_shapefit.facts.result import Inputs, LocateResult
from sfm_shapefit.facts.rows import correlations_of, covariances_of
from sfm_shapefit.facts.scene import told_distances
from sfm_shapefit.facts.tables import CameraRow, Table
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.reconstructions import name_of, transform_model
from sfm_shapefit.judgement.reasons import Grade, ModelVerdict
from sfm_shapefit.pairs.options import DirectionOptions
from sfm_shapefit.pipeline.checked import check_source
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.pipeline.gauge_choice import gauge_of_distances
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.placement.gauge import Gauge
from sfm_shapefit.placement.options import KnownDistance

if TYPE_CHECKING:
    import pycolmap

_SIGMA_OF = (
    "joined: what the models know of their cameras, and how well the joins are known; relative to the mean "
    "position and scale of the first"
)
# What says how large a model is; another scale has no meaning beside that of a known distance.
_ARBITRARY = ("unit", "input")
_SAME = Similarity(scale=1.0, rotation=np.eye(3), translation=np.zeros(3))


class Told(NamedTuple):
    """What is known of joined models beside the models."""

    joins: Sequence[Joined]
    """What came of joining each model to another."""
    options: Mapping[str, Any]
    inputs: Inputs
    """Where matches come from."""
    distances: Sequence[KnownDistance] = ()
    located: Mapping[int, LocateResult] = MappingProxyType({})
    """The models by number, as far as they are ours, with what is known of their cameras."""
    notes: Sequence[str] = ()
    """What was read otherwise than it stands in the models."""


class JoinedGroup(NamedTuple):
    """Models in the world of the first of them."""

    reconstruction: "pycolmap.Reconstruction"
    world_from: Mapping[int, Similarity]
    """By the number of each model, the first one's first."""
    joins: Sequence[Joined]
    tied: Sequence[tuple[str, str]] = ()
    """Images of models that are joined, which stand rightly to one another as far as the joins do."""


def tell_group(
    group: JoinedGroup, told: Told, source: MatchSource, options: DirectionOptions, clock: Clock
) -> JoinedModel:
    """Return joined models with what can be said of them; `source` has the matches of their images."""
    first, located = next(iter(group.world_from)), told.located
    labels = {
        k: label for one in group.joins for k, label in zip((one.model, one.to), one.labels, strict=True)
    }
    folder = f"joined_{first}" if located else "."
    gauge = Gauge(scale="input", similarity=_SAME, statement="input: those of the first model")
    if first in located:
        gauge, group = _choose_scale(group, located[first].gauge, told.distances)
    model = read_model(group.reconstruction)
    rows = {name: k for k, name in enumerate(model.images.names)}
    tied = np.array([(rows[a], rows[b]) for a, b in group.tied], dtype=np.int64).reshape(-1, 2)
    source = replace(source.at(model.images), tied=tied)
    found = check_source(model, source, options, clock)
    seen, measures = found.facts, (float(np.median(model.images.focal_lengths_px)), UNITS[gauge.scale])
    cameras = _camera_rows(found.cameras, group, located)
    facts = JoinedFacts.taken_from(
        seen,
        inputs=told.inputs.facts,
        options=dict(told.options),
        verdict=_judge(seen.verdict, group, located),
        models=[labels[number].removeprefix("model ") for number in group.world_from],
        joins=[one.facts(folder if one.join and one.model in labels else None) for one in told.joins],
        num_images=len(cameras),
        num_placed=group.reconstruction.num_reg_images(),
        figures=KeyFigures.of_cameras(cameras, seen.figures.pair_error_deg, *measures),
        sigma_of=_SIGMA_OF if located else "",
        scale=gauge.statement,
        scale_sigma=gauge.scale_sigma,
        known_distances=told_distances(told.distances, model.images),
        datum=gauge.datum,
        timings_s=clock.seconds,
        warnings=[*told.notes, *seen.warnings, *filter(None, [gauge.warning])],
    )
    return JoinedModel(
        reconstruction=group.reconstruction,
        models=tuple(group.world_from),
        joins=tuple(told.joins),
        cameras=cameras,
        pairs=found.pairs,
        facts=facts,
    )


def _choose_scale(
    group: JoinedGroup, first: Gauge, known: Sequence[KnownDistance]
) -> tuple[Gauge, JoinedGroup]:
    """Return the gauge of joined models, and the models in it.

    A scale that the first model knows stays. An arbitrary one gives way to known distances, be they within
    one of the models or between two.
    """
    number = next(iter(group.world_from))
    placed = {name_of(image): image for image in group.reconstruction.images.values() if image.has_pose}
    there = [one for one in known if {*one[:2]} <= placed.keys()]
    warning = ""
    if first.scale in _ARBITRARY and there:
        centers = np.array([image.projection_center() for image in placed.values()])
        try:
            gauge = gauge_of_distances(list(placed), centers, there)
        except InputError as error:  # two cameras stand in one place
            warning = str(error)
        else:
            world = group.world_from.items()
            return gauge, group._replace(
                reconstruction=transform_model(group.reconstruction, gauge.similarity),
                world_from={number: compose(gauge.similarity, one) for number, one in world},
            )
    statement = f"that of model {number}: {first.statement}"
    return replace(first, statement=statement, warning=warning), group


def _camera_rows(
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
        sigma = group.world_from[done.to].scale * done.join.center_sigma
        found[done.model] = found[done.to] + sigma**2 / 3.0
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


def _judge(seen: ModelVerdict, group: JoinedGroup, located: Mapping[int, LocateResult]) -> ModelVerdict:
    """Return the verdict: what was seen of the joined model, and what made its models no better.

    One that could not be judged by itself is judged in it.
    """
    said = [
        one if one.of_each else replace(one, sentence=f"model {number}: {one.sentence}")
        for number in group.world_from
        if number in located
        for one in located[number].verdict.findings
        if one.grade is not Grade.CANNOT_BE_JUDGED
    ]
    return ModelVerdict.weigh([*said, *seen.findings])
