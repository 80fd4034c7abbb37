"""The models of one database joined where that is safe: by position priors, or by matches between them."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import METRIC_SIGMA, Similarity, compose
from sfm_shapefit.facts.joins import Joined
from sfm_shapefit.facts.map_result import JoinedModel, MappedModel
from sfm_shapefit.files.colmap.database import DatabaseMatches
from sfm_shapefit.files.colmap.merge import merge_models
from sfm_shapefit.files.colmap.points import observed_points
from sfm_shapefit.files.colmap.priors import MissingPriorsError, database_priors
from sfm_shapefit.pairs.essential import estimate_relative_rotations
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.pipeline.joined import JoinedGroup, ToldOfJoins, tell_group
from sfm_shapefit.placement.join import (
    ModelJoin,
    PlacedByPriors,
    Ties,
    join_by_matches,
    join_by_priors,
    place_by_priors,
)
from sfm_shapefit.scene.given import PositionPriors
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import MatchBatch, View

if TYPE_CHECKING:
    import pycolmap

_WIDENING = 2.0  # thresholds of reprojection errors by which a camera may miss the other model; models drift
_NOTHING_IN_COMMON = "no pair of images and no position priors tie them together"


class JoinedModels(NamedTuple):
    """What came of joining models."""

    joins: tuple[Joined, ...]
    """One for each model but the largest."""
    joined: tuple[JoinedModel, ...]
    """Models in one world, larger ones first; none where nothing was joined."""
    warnings: tuple[str, ...] = ()
    """What was told and could not be used for it, a sentence each."""


def join_models(
    models: Sequence[MappedModel],
    images: Images,
    matches: DatabaseMatches,
    told: ToldOfJoins,
    clock: Clock,
) -> JoinedModels:
    """Join each model to the first larger one that it can be joined to safely.

    Args:
        models: largest first.
        images: all of the database.
        matches: of these.
        told: what is known of the images beside.
        clock: whose progress is told.
    """
    if len(models) < 2:
        return JoinedModels((), ())
    priors, warnings = told.priors, []
    if priors is None:
        try:
            priors = database_priors(matches.file, images)
        except MissingPriorsError:
            pass
        except InputError as error:
            warnings.append(f"the position priors of the database join no models: {error}")
    evidence = _Evidence(models, images, priors, partial(matches.at, left_out=told.left_out))
    joins = [evidence.join(number) for number in range(1, len(models))]
    joined = [tell_group(group, models, matches, told, clock) for group in _merge(models, joins, evidence)]
    return JoinedModels(tuple(joins), tuple(joined), tuple(warnings))


class _Between(NamedTuple):
    """Matches between images of two models."""

    images: IntArray
    """(k, 2) images of each match, that of the larger model first."""
    points: IntArray
    """(k, 2) ids of the points that its keypoints observe; -1 for none."""
    rays: FloatArray
    """(k, 2, 3) in the worlds of the models."""
    turns: FloatArray
    """(p, 3, 3) rotations first_from_second, one of each pair of images."""

    @classmethod
    def concatenated(cls, parts: "Sequence[_Between]") -> "_Between":
        """Return all parts as one."""
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))


class _Evidence:
    """What ties models together."""

    def __init__(
        self,
        models: Sequence[MappedModel],
        images: Images,
        priors: PositionPriors | None,
        see: Callable[[Images], View],
    ) -> None:
        for placed in (model.located.placed for model in reversed(models)):
            images = images.with_lenses_of(placed, np.ones(len(placed.lenses), dtype=np.bool_))
        self.models, self.images, self.priors = models, images, priors
        index = {image_id: k for k, image_id in enumerate(images.ids.tolist())}
        self.model_of_image = np.full(images.num_images, -1, dtype=np.int64)
        for number, model in enumerate(models):
            for image_id in model.located.reconstruction.reg_image_ids():
                self.model_of_image[index[image_id]] = number
        self.centers = np.full((images.num_images, 3), np.nan)
        self.rotations = np.full((images.num_images, 3, 3), np.nan)
        self.ids: list[IntArray] = []
        """For each image, the id of the point that each keypoint observes; -1 for none."""
        for image, number in enumerate(self.model_of_image.tolist()):
            self.ids.append(self._observed(image, number) if number >= 0 else np.zeros(0, dtype=np.int64))
        self.by_priors: dict[int, PlacedByPriors | str | None] = {}
        """Models on their priors, those that were asked; fitted once, with however many they are compared."""
        self.matches = self._read_matches(see(self.images.apart()))

    def _observed(self, image: int, number: int) -> IntArray:
        """Return what the keypoints of an image of a model observe, and note its pose."""
        posed = self.models[number].located.reconstruction.image(int(self.images.ids[image]))
        self.centers[image] = posed.projection_center()
        self.rotations[image] = posed.cam_from_world().rotation.matrix()
        keypoints, points = observed_points(posed)
        found = np.full(posed.num_points2D(), -1, dtype=np.int64)
        found[keypoints] = points.astype(np.int64)
        return found

    def _read_matches(self, view: View) -> dict[tuple[int, int], "_Between"]:
        """Return the matches between models, by the two models, and what turns they suggest."""
        parts: dict[tuple[int, int], list[_Between]] = {}
        for batch in view.between(self.model_of_image):
            relative = estimate_relative_rotations(batch)
            turns = dict(zip(map(tuple, relative.pairs.tolist()), relative.rotations, strict=True))
            for k, (i, j) in enumerate(batch.pairs.tolist()):
                part = self._between(batch, k, turns.get((i, j)))
                key = sorted((int(self.model_of_image[i]), int(self.model_of_image[j])))
                parts.setdefault((key[0], key[1]), []).append(part)
        return {key: _Between.concatenated(found) for key, found in parts.items()}

    def _between(self, batch: MatchBatch, k: int, turn: FloatArray | None) -> "_Between":
        """Return the matches of one pair of images, that of the larger model first."""
        rows = slice(batch.offsets[k], batch.offsets[k + 1])
        (i, j), ends = batch.pairs[k].tolist(), batch.keypoints[rows]
        rays = [batch.rays_i[rows], batch.rays_j[rows]]
        if self.model_of_image[i] > self.model_of_image[j]:
            i, j, ends, rays = j, i, ends[:, ::-1], rays[::-1]
            turn = None if turn is None else turn.T
        points = [_take(self.ids[i], ends[:, 0]), _take(self.ids[j], ends[:, 1])]
        return _Between(
            images=np.tile([i, j], (len(ends), 1)),
            points=np.stack(points, axis=1),
            rays=np.stack([rays[0] @ self.rotations[i], rays[1] @ self.rotations[j]], axis=1),
            turns=np.zeros((0, 3, 3))
            if turn is None
            else (self.rotations[i].T @ turn.T @ self.rotations[j])[None],
        )

    def join(self, number: int) -> Joined:
        """Return what comes of joining a model to one of the larger ones, the largest first."""
        refused = []
        for larger in range(number):
            try:
                return Joined(model=number, to=larger, join=self._join(larger, number))
            except UnsolvableError as error:
                refused.append(Joined(model=number, to=larger, join=None, reason=str(error)))
        telling = [one for one in refused if one.reason != _NOTHING_IN_COMMON]
        return (telling or refused)[0]

    def _join(self, first: int, second: int) -> ModelJoin:
        """Return the join by priors, or else by points.

        Raises:
            UnsolvableError: if neither is safe.
        """
        metric_sigma = self._metric_sigma(first, second)
        known = [self._by_priors(k) for k in (first, second)]
        reasons = []
        if metric_sigma is None and None not in known:
            try:
                return join_by_priors(*(_unless_refused(one) for one in known))
            except UnsolvableError as error:
                reasons.append(str(error))
        between = self.matches.get((first, second))
        if between is not None:
            try:
                ties = self._tie(between, first, second)
                return join_by_matches(ties, between.turns, self._centers_of(second), metric_sigma)
            except UnsolvableError as error:
                reasons.append(str(error))
        raise UnsolvableError("; ".join(reasons) or _NOTHING_IN_COMMON)

    def _metric_sigma(self, first: int, second: int) -> float | None:
        """Return how well two models know the scale between them, relative; None if neither's rigs tell one.

        Raises:
            UnsolvableError: if only one of them has rigs, which the scale of the other must not change, or
                they do not know their scale.
        """
        located = [self.models[k].located for k in (first, second)]
        has_rigs = [one.images.has_rigs for one in located]
        if not any(has_rigs):
            return None
        if not all(has_rigs):
            raise UnsolvableError("only one of them has rigs of several cameras, and a scale by that")
        sigmas = [one.gauge.scale_sigma for one in located]
        if any(sigma is None or sigma > METRIC_SIGMA for sigma in sigmas):
            raise UnsolvableError("their rigs do not tell the scale of both")
        return float(np.linalg.norm(np.array(sigmas, dtype=np.float64)))

    def _by_priors(self, number: int) -> PlacedByPriors | str | None:
        """Return a model on its position priors, or why that is refused; None if it has none."""
        if number not in self.by_priors:
            own = np.flatnonzero(self.model_of_image == number)
            priors = None if self.priors is None else self.priors.of(own)
            found: PlacedByPriors | str | None = None
            if priors is not None and len(priors):
                try:
                    found = place_by_priors(self.centers[own], priors)
                except UnsolvableError as error:
                    found = str(error)
            self.by_priors[number] = found
        return self.by_priors[number]

    def _centers_of(self, number: int) -> FloatArray:
        return np.asarray(self.centers[self.model_of_image == number])

    def _tie(self, between: "_Between", first: int, second: int) -> Ties:
        """Return the matches between two models with centers and points in the worlds of these."""
        options = self.models[first].located.options.structure
        points = []
        for k, number in enumerate((first, second)):
            structure, ids = self.models[number].located.reconstruction, between.points[:, k]
            points.append(np.full((len(ids), 3), np.nan))
            there = ids >= 0
            points[k][there] = np.reshape([structure.point3D(i).xyz for i in ids[there].tolist()], (-1, 3))
        focal_px = self.images.focal_lengths_px[between.images].min(axis=1)
        return Ties(
            eyes_first=self.centers[between.images[:, 0]],
            eyes_second=self.centers[between.images[:, 1]],
            rays_first=between.rays[:, 0],
            rays_second=between.rays[:, 1],
            points_first=points[0],
            points_second=points[1],
            pairs=between.images[:, 0] * self.images.num_images + between.images[:, 1],
            tolerances=_WIDENING * options.max_reprojection_error_px / focal_px,
        )

    def same_points(self, done: Joined) -> list[tuple[int, int]]:
        """Return the points of both models that are one, by a join that rests on matches; each once."""
        if done.join is None or done.join.agreeing is None:
            return []
        rows = self.matches[done.to, done.model].points[done.join.agreeing]
        rows = rows[(rows >= 0).all(axis=1)]
        seen: tuple[set[int], set[int]] = (set(), set())
        found = []
        for one, other in rows.tolist():
            if one not in seen[0] and other not in seen[1]:
                found.append((one, other))
                seen[0].add(one)
                seen[1].add(other)
        return found


def _unless_refused(found: PlacedByPriors | str | None) -> PlacedByPriors:
    """Return a model on its priors, or raise UnsolvableError with the reason why it is not."""
    if isinstance(found, PlacedByPriors):
        return found
    raise UnsolvableError(found or _NOTHING_IN_COMMON)


def _merge(
    models: Sequence[MappedModel], joins: Sequence[Joined], evidence: _Evidence
) -> Iterator[JoinedGroup]:
    """Yield the models that were joined, each group in the world of its largest."""
    merging = [_Merging(model.located.reconstruction, number) for number, model in enumerate(models)]
    root = list(range(len(models)))
    for done in joins:
        if done.join is not None:
            root[done.model] = root[done.to]
            merging[root[done.to]].add(done, models[done.model], evidence.same_points(done))
    for merged in merging:
        if merged.joins:
            yield JoinedGroup(merged.reconstruction, merged.world_from, merged.joins)


class _Merging:
    """A group of joined models as it grows, and the ids that its points had."""

    def __init__(self, reconstruction: "pycolmap.Reconstruction", number: int) -> None:
        self.reconstruction = reconstruction
        self.world_from = {number: Similarity(scale=1.0, rotation=np.eye(3), translation=np.zeros(3))}
        self.joins: list[Joined] = []
        # For each model: the new ids of its points, by their old ones, where they are others.
        self.ids: dict[int, dict[int, int]] = {number: {}}

    def add(self, done: Joined, model: MappedModel, same_points: list[tuple[int, int]]) -> None:
        """Take in a model that was joined to one of the group."""
        assert done.join is not None
        self.joins.append(done)
        own = self.ids[done.to]
        same_points = [(own.get(one, one), other) for one, other in same_points]
        world_from = compose(self.world_from[done.to], done.join.first_from_second)
        second = model.located.reconstruction
        self.reconstruction, renamed, new = merge_models(self.reconstruction, second, world_from, same_points)
        self.world_from[done.model] = world_from
        for ids in self.ids.values():
            ids |= {point: renamed[now] for point, now in ids.items() if now in renamed}
        for one, now in renamed.items():
            self.ids[next(iter(self.ids))].setdefault(one, now)
        self.ids[done.model] = new


def _take(ids: IntArray, keypoints: IntArray) -> IntArray:
    """Return the points of keypoints; -1 where the image has no such keypoint."""
    extended = np.append(ids, -1)
    return np.asarray(extended[np.minimum(keypoints, len(ids))])
