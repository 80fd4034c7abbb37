"""`map_database`: rotations averaged from the matches, then `locate`, component by component.

    images and matches -> relative rotations -> components -> averaged rotations
        -> first placement -> rotations and centers adjusted on few tracks -> locate -> models

Images that the averaging drops form components of their own.
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.colmap.database_images import UnposedImages, pose_at_origin, read_images
from sfm_shapefit.colmap.intrinsics import differ_in_rays, with_parameters
from sfm_shapefit.colmap.model import PosedModel, read_model
from sfm_shapefit.commands.locate import Locating, locate_source
from sfm_shapefit.commands.relative_rotations import Sharing, measure_rotations
from sfm_shapefit.commands.stages.averaging import average_consistently
from sfm_shapefit.commands.stages.clock import Clock, Progress
from sfm_shapefit.commands.stages.first_placement import adjust_first_placement
from sfm_shapefit.commands.stages.gauge_choice import read_priors
from sfm_shapefit.commands.stages.inputs import choose_inputs, open_source
from sfm_shapefit.commands.stages.intrinsics import settle_intrinsics
from sfm_shapefit.commands.stages.rigs import find_rigid_parts
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.locate_options import LEAST_MATCHES, LocateOptions, MapOptions
from sfm_shapefit.results.intrinsics import Intrinsics
from sfm_shapefit.results.map_result import MappedModel, MapResult
from sfm_shapefit.results.result import LocateResult
from sfm_shapefit.rotations.averaged import AveragedRotations
from sfm_shapefit.rotations.relative_rotations import RelativeRotations
from sfm_shapefit.rotations.triplets import score_triplets
from sfm_shapefit.settings import merge_options
from sfm_shapefit.viewgraph import connected_components

if TYPE_CHECKING:
    import pycolmap

# A model is warned of if a smaller share of its pairs agrees with its rotations (castle-P30: 0.97, lego100:
# 0.89), an image if a smaller share of its own does.
_ALARMING_SHARE = 0.7
_DOUBTFUL_SHARE = 0.25
_UNMATCHED = f"no matches: fewer than {LEAST_MATCHES} inliers with every other image"


def map_database(
    database: Path | str,
    options: MapOptions | None = None,
    *,
    progress: Progress | None = None,
    **overrides: Any,
) -> MapResult:
    """Place the images of a COLMAP database: average rotations, then `locate`, for each component.

    Args:
        database: with keypoints and two-view geometries; it is never changed. Intrinsics are the database's.
        options: settings, see `help(MapOptions)`; defaults if None.
        **overrides: single options by name: `map_database(database, bundle_adjust=True)`.
        progress: called as stages advance.

    Returns:
        `models`, most cameras first, each with `located` (see `locate`), the rotations it started from and
        how they were chosen; `left_out`, the reason for each image in no model; `warnings`.

    Raises:
        InputError: if the database cannot be used; the message says what to do.
        UnsolvableError: if no component of three images or more can be placed.
    """
    options = merge_options(options, MapOptions, overrides)
    path, clock = Path(database), Clock(progress) if progress else Clock()
    with clock("read"):
        images = read_images(path)
        unposed, intrinsics = settle_intrinsics(read_model(images.reconstruction), path, options)
    run = _Run(options, clock, path, intrinsics, unposed)
    relative = run.measure()
    if options.adjust and intrinsics.free.doubts:
        known = run.refine_intrinsics(relative)
        if differ_in_rays(known, unposed):
            run = run._replace(unposed=known)
            relative = run.measure()
    scores = score_triplets(unposed.num_images, relative).tolist()
    run = run._replace(triplet_scores=dict(zip(map(tuple, relative.pairs.tolist()), scores, strict=True)))
    models, reasons = [], dict.fromkeys(range(unposed.num_images), _UNMATCHED)
    for members, averaging in run.average_components(relative, reasons):
        try:
            found = run.locate_component(members, averaging)
        except UnsolvableError as error:
            reasons |= dict.fromkeys(members.tolist(), f"its component cannot be placed: {error}")
            continue
        names = tuple(unposed.names[k] for k in members.tolist())
        models.append(MappedModel(located=found, averaging=averaging, names=names))
        for k in members.tolist():
            del reasons[k]
    if not models:
        raise UnsolvableError(_explain_failure(path, relative, reasons))
    models.sort(key=lambda model: -int(model.located.kept.sum()))
    left_out = {unposed.names[k]: reason for k, reason in sorted(reasons.items())}
    return MapResult(
        database=path,
        options=options,
        models=tuple(models),
        num_images=unposed.num_images,
        num_pairs=len(relative.pairs),
        left_out=left_out,
        timings_s=clock.seconds,
        warnings=tuple(_warnings(images, models, left_out)),
    )


class _Run(NamedTuple):
    """What all components of a run have in common; the clock adds up the time that they take."""

    options: MapOptions
    clock: Clock
    database: Path
    intrinsics: Intrinsics
    """Which of them are in doubt."""
    unposed: PosedModel
    """The images as a model."""
    triplet_scores: Mapping[tuple[int, int], float] = MappingProxyType({})
    """Of the pairs with a relative rotation."""

    def measure(self) -> RelativeRotations:
        """Return the relative rotations of all pairs, by the intrinsics that the images have."""
        with self.clock("relative rotations"):
            sharing = Sharing(self.options.num_threads(), advance=self.clock.advance)
            source = self.options.relative_rotations
            return measure_rotations(self.database, self.unposed, LEAST_MATCHES, source, sharing)

    def refine_intrinsics(self, relative: RelativeRotations) -> PosedModel:
        """Return the images with the intrinsics that first placements of all components find.

        Relative rotations by a wrong focal length are off by degrees, and the averaging may follow the false
        ones among them; a placement that is wrong in places knows the focal length all the same. Of a camera
        in several components the one with most images counts.
        """
        found: dict[int, tuple[float, ...]] = {}
        for members, averaging in self.average_components(relative, {}):
            image_ids = self.unposed.image_ids[members].tolist()
            model = _pose(self.unposed.reconstruction, image_ids, averaging.rotations)
            inputs = choose_inputs(model.reconstruction, self.database, self.options.directions)
            with open_source(model, inputs, self.options) as source, suppress(UnsolvableError):
                with self.clock("first placement"):
                    adjusted = adjust_first_placement(
                        source, self.options, self.clock, self.intrinsics.free, thorough=False
                    ).adjusted
                for camera in adjusted.lenses.sigmas:
                    found.setdefault(camera, tuple(adjusted.reconstruction.camera(camera).params))
        return with_parameters(self.unposed, found)

    def average_components(
        self, relative: RelativeRotations, reasons: dict[int, str]
    ) -> Iterator[tuple[IntArray, AveragedRotations]]:
        """Yield the images of each component that got rotations, ascending, and those rotations.

        Why an image belongs to none is written to `reasons`.
        """
        num_images = self.unposed.num_images
        waiting = _group_images(num_images, relative.pairs)
        while waiting:
            members = waiting.pop(0)
            if len(members) < self.options.min_model_size:
                if len(members) > 1:
                    few = f"joined to {len(members) - 1} other image only; three make a model"
                    reasons |= dict.fromkeys(members.tolist(), few)
                continue
            with self.clock("rotation averaging"):
                inside = relative.subset(np.asarray(np.isin(relative.pairs, members).all(axis=1)))
                local = replace(inside, pairs=np.searchsorted(members, inside.pairs))
                try:
                    answer = average_consistently(
                        len(members),
                        local,
                        self.options.min_matches,
                        averaging=self.options.averaging,
                        threads=self.options.num_threads(),
                    )
                except UnsolvableError as error:
                    reasons |= dict.fromkeys(members.tolist(), str(error))
                    continue
            left = members[~answer.registered]
            reasons |= dict.fromkeys(left.tolist(), "its relative rotations contradict those of the others")
            if len(left) < len(members):
                rest = inside.pairs[np.isin(inside.pairs, left).all(axis=1)]
                among = _group_images(num_images, rest)
                waiting = [*waiting, *(group for group in among if len(group) > 1)]
            kept = answer.registered
            if kept.sum() >= self.options.min_model_size:
                yield members[kept], answer.subset(kept)

    def locate_component(self, members: IntArray, averaging: AveragedRotations) -> LocateResult:
        """Place one component: adjust a first placement, and locate from the rotations of that."""
        image_ids = self.unposed.image_ids[members].tolist()
        settings = {item.name: getattr(self.options, item.name) for item in fields(LocateOptions)}
        known = self.options.known_distance
        if known is not None and not {*known[:2]} <= {self.unposed.names[k] for k in members.tolist()}:
            # The known distance belongs to another component.
            known, settings["known_distance"] = None, None
            settings["scale"] = "auto"
        if known is None and settings["scale"] in ("auto", "input"):
            # There is no input whose scale could be taken.
            settings["scale"] = "unit"
        options = LocateOptions(**settings)
        model = _pose(self.unposed.reconstruction, image_ids, averaging.rotations)
        inputs = choose_inputs(model.reconstruction, self.database, options.directions)
        with open_source(model, inputs, options) as averaged:
            source, centers, covariances, intrinsics = averaged, None, None, self.intrinsics
            if self.options.adjust:
                with self.clock("first placement"):
                    first = adjust_first_placement(averaged, options, self.clock, intrinsics.free)
                centers, covariances = first.centers, first.adjusted.covariances
                intrinsics = intrinsics.after(first.adjusted.lenses)
                source = averaged.turned(_pose(first.adjusted.reconstruction, image_ids, first.rotations))
            priors = read_priors(source.model, inputs, options, None)
            rigid = find_rigid_parts(source.model, options, has_priors=priors is not None)
            locating = Locating(
                inputs, rigid, priors, centers=centers, covariances=covariances, intrinsics=intrinsics
            )
            with self.clock("locate"):
                found = locate_source(source, locating, options, Clock(self.clock.progress))
        ends = members[found.directions.pairs].tolist()
        scores = np.array([self.triplet_scores.get((i, j), np.nan) for i, j in ends])
        return replace(found, triplet_scores=scores)


def _pose(images: "pycolmap.Reconstruction", image_ids: list[int], rotations: FloatArray) -> PosedModel:
    """Return some images of a model with these rotations and all centers 0."""
    return read_model(pose_at_origin(images, image_ids, rotations))


def _group_images(num_images: int, pairs: IntArray) -> list[IntArray]:
    """Return the connected components, ascending, the largest first; single images are components too."""
    labels = connected_components(num_images, pairs)
    groups = np.split(np.argsort(labels, kind="stable"), np.cumsum(np.bincount(labels))[:-1])
    return sorted(groups, key=lambda group: (-len(group), int(group[0])))


def _explain_failure(path: Path, relative: RelativeRotations, reasons: dict[int, str]) -> str:
    """Say why no component could be placed."""
    if len(relative.pairs) == 0:
        return (
            f"no pair of images in {path} has {LEAST_MATCHES} inlier matches and a relative rotation; match "
            "the images and verify them geometrically first"
        )
    causes = list(reasons.values())
    most = max(set(causes), key=lambda cause: (causes.count(cause), cause))
    return f"no component of {path} can be placed; for most images: {most}"


def _warnings(images: UnposedImages, models: list[MappedModel], left_out: dict[str, str]) -> Iterator[str]:
    """Yield what the user should know, a sentence each."""
    if images.has_rigs:
        yield "the database's rigs are not used: every camera is placed on its own"
    for number, model in enumerate(models):
        share, agreements = model.averaging.share, model.averaging.agreements
        if share < _ALARMING_SHARE:
            yield (
                f"model {number}: only {share:.0%} of the pairs agree with the averaged rotations; do not "
                "trust it without a look"
            )
        doubtful = np.flatnonzero(agreements < _DOUBTFUL_SHARE)
        if len(doubtful):
            worst = model.names[int(doubtful[np.argmin(agreements[doubtful])])]
            yield (
                f"model {number}: most pairs of {len(doubtful)} images contradict their averaged rotations, "
                f"above all those of {worst}"
            )
    if left_out:
        name, reason = next(iter(left_out.items()))
        yield f"{len(left_out)} images are in no model, {name} for one: {reason}"
