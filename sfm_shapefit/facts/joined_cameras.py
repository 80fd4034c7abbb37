"""What models know of their cameras once they are joined: who is trusted, and how well a center is known.

Errors of a join come on top of those of its models, as if they moved each camera of the joined model alike:

    C' = s^2 R C R^T + sigma^2 / 3 I        sigma, the standard deviation of where its cameras come to lie
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.facts.joins import Joined
from sfm_shapefit.facts.result import LocateResult
from sfm_shapefit.facts.rows import correlations_of, covariance_of
from sfm_shapefit.facts.tables import CameraRow
from sfm_shapefit.judgement.reasons import Grade, ModelVerdict

if TYPE_CHECKING:
    import pycolmap


class JoinedGroup(NamedTuple):
    """Models in the world of the first of them."""

    reconstruction: "pycolmap.Reconstruction"
    world_from: Mapping[int, Similarity]
    """By the number of each model, the first one's first."""
    joins: Sequence[Joined]
    tied: Sequence[tuple[str, str]] = ()
    """Images of models that are joined, which stand rightly to one another as far as the joins do."""


def joined_camera_rows(
    checked: Sequence[CameraRow], group: JoinedGroup, located: Mapping[int, LocateResult]
) -> Iterator[CameraRow]:
    """Yield the rows of the cameras that stand in the joined model, then those of the other images."""
    numbers = [number for number in group.world_from if number in located]
    own = {row.name: (row, number) for number in reversed(numbers) for row in located[number].cameras}
    variances = _variances_of_joins(group)
    for seen in checked:
        if not seen.placed or seen.name not in own:
            yield seen
            continue
        row, number = own[seen.name]
        sigma, correlation = _errors(row, group.world_from[number], variances[number])
        reasons = [reason for reason in (row.reason, seen.reason) if reason]
        yield replace(seen, reason="; ".join(reasons), trust=row.trust, sigma=sigma, correlation=correlation)
    placed = {row.name for row in checked}
    for name, (row, _) in own.items():
        if name not in placed:
            yield CameraRow(name=name, reason=row.reason, trust=row.trust)


def _variances_of_joins(group: JoinedGroup) -> dict[int, float]:
    """Return what the joins add to the variance of a center along an axis, by the number of its model."""
    found = dict.fromkeys(group.world_from, 0.0)
    for done in group.joins:  # ascending, so that the model that it is joined to is there
        assert done.join is not None
        sigma = group.world_from[done.to].scale * done.join.center_sigma
        found[done.model] = found[done.to] + sigma**2 / 3.0
    return found


def _errors(
    row: CameraRow, world_from: Similarity, variance: float
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return standard deviations and correlations of a center in the joined model; nothing if not known."""
    own = covariance_of(row) if row.sigma else np.full((3, 3), np.nan)
    if not np.isfinite(own).all():
        return row.sigma, row.correlation
    turned = world_from.scale**2 * world_from.rotation @ own @ world_from.rotation.T
    covariance = (turned + variance * np.eye(3))[None]
    sigmas = np.sqrt(np.diagonal(covariance[0]))
    return tuple(sigmas.tolist()), tuple(correlations_of(covariance)[0].tolist())


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
