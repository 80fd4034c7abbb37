"""`map_database`: rotations averaged from the matches, then `locate`, component by component.

    images and matches -> relative rotations -> components -> averaged rotations
        -> first placement -> rotations and centers adjusted on few tracks -> locate -> models

Images that the averaging drops form components of their own.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing, suppress
from dataclasses import fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.adjustment.given_rotations import RotationWeight
from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.facts.intrinsics import Intrinsics
from sfm_shapefit.facts.map_result import MappedModel, MapResult, tell_joins
from sfm_shapefit.facts.map_warnings import lost_distances, map_warnings
from sfm_shapefit.facts.options import LocateOptions, MapOptions
from sfm_shapefit.facts.result import Inputs, LocateResult, Loop
from sfm_shapefit.files.colmap.database import DatabaseMatches
from sfm_shapefit.files.colmap.database_images import UnposedImages, pose_at_origin, read_images
from sfm_shapefit.files.colmap.intrinsics import differ_in_rays, with_parameters
from sfm_shapefit.files.colmap.model import PosedModel, read_model, sensors_of
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.pairs.missing_matches import count_partners, matched_shares
from sfm_shapefit.pairs.relative_rotations import LEAST_MATCHES, RelativeRotations
from sfm_shapefit.pairs.triplets import score_triplets
from sfm_shapefit.pipeline.clock import Clock, Progress
from sfm_shapefit.pipeline.components import ComponentAveraging, pairs_among
from sfm_shapefit.pipeline.control_points import read_control
from sfm_shapefit.pipeline.first_placement import FirstPlacement, adjust_first_placement
from sfm_shapefit.pipeline.gauge_choice import GaugeRule, read_priors
from sfm_shapefit.pipeline.gravity import read_gravity
from sfm_shapefit.pipeline.inputs import choose_inputs, read_left_out, see_matches
from sfm_shapefit.pipeline.intrinsics import settle_intrinsics
from sfm_shapefit.pipeline.joined import ToldOfJoins
from sfm_shapefit.pipeline.joins import JoinedModels, join_models
from sfm_shapefit.pipeline.relative_rotations import Sharing, measure_rotations
from sfm_shapefit.pipeline.rigs import find_rigid_parts
from sfm_shapefit.pipeline.settle import Told, settle
from sfm_shapefit.placement.gauge import FEWEST_PRIORS, UselessPriorsError
from sfm_shapefit.rotations.arrangements import agreeing_pairs
from sfm_shapefit.rotations.averaged import AveragedRotations
from sfm_shapefit.rotations.frames import relative_rotations_of_frames
from sfm_shapefit.rotations.sequences import Videos, Visit, confirm_videos, find_videos, judge_loops
from sfm_shapefit.scene.given import ControlPoints, Gravity, PositionPriors
from sfm_shapefit.scene.matches import PairNames, View

# The shares of more pairs would take longer than they are worth: 0.2 ms each, and their matches are read
# again.
_MOST_SCORED_PAIRS = 20_000
# Of the images: where so many have intrinsics in doubt, the relative rotations are measured twice. Fewer are
# found with the poses, which the others hold; their pairs do not decide the averaging.
_MANY_DOUBTED = 0.25
_UNMATCHED = f"no matches: fewer than {LEAST_MATCHES} inliers with every other image"


def map_database(
    database: Path | str,
    options: MapOptions | None = None,
    *,
    progress: Progress | None = None,
    priors: Path | str | None = None,
    executor: Executor | None = None,
    **overrides: Any,
) -> MapResult:
    """Place the images of a COLMAP database: average rotations, then `locate`, for each component.

    Args:
        database: with keypoints and two-view geometries, or the folder that holds it as database.db; it is
            never changed. Intrinsics are the database's.
        options: settings, see `help(MapOptions)`; defaults if None.
        **overrides: single options by name: `map_database(database, adjust="full")`.
        progress: called as stages advance.
        priors: a table of position priors, as of `locate`. Components with fewer than two keep the scale
            "unit", and so do those, with a warning, whose priors coincide or contradict the cameras.
        executor: shares out pairs and tracks among its workers, as of `locate`. None: all is done here.

    Returns:
        `models`, most cameras first, each with `located` (see `locate`), the rotations it started from and
        how they were chosen; `left_out`, the reason for each image in no model; `warnings`.

    Raises:
        InputError: if the database cannot be used; the message says what to do.
        UnsolvableError: if no component of three images or more can be placed.
        WorkerError: if a worker died and the executor does not replace it.
    """
    options = merge_options(options, MapOptions, overrides)
    clock = Clock.of(progress, executor)
    with closing(DatabaseFile(database_in(Path(database)))) as file:
        return _map_opened(_start(file, options, clock, priors))


def _map_opened(run: "_Run") -> MapResult:
    """Do what `map_database` does, once the matches are open."""
    options, path, clock = run.options, run.matches.file.path, run.clock
    relative = run.measure()
    if options.adjust != "none" and run.share_of_doubted_lenses() >= _MANY_DOUBTED:
        known = run.refine_intrinsics(relative)
        if differ_in_rays(known, run.unposed):
            run = run._replace(unposed=known)
            relative = run.measure()
    videos = run.find_videos(relative)
    run, relative, visits = run.judge_loops(videos, relative)
    run = run.score_pairs(relative)
    reasons = dict.fromkeys(range(int(run.frame_of_image.max()) + 1), _UNMATCHED)
    models = run.locate_components(relative, visits, reasons)
    if not models:
        raise UnsolvableError(_explain_failure(path, relative, reasons))
    found = JoinedModels((), ())
    if options.join == "safe":
        with clock("join"):
            told = ToldOfJoins(run.priors, options.known_distance, run.without)
            found = join_models(models, run.unposed, run.matches, told, clock)
    left_out = {
        name: reasons[frame]
        for name, frame in zip(run.unposed.names, run.frame_of_image.tolist(), strict=True)
        if frame in reasons
    }
    result = MapResult(
        database=path,
        options=options,
        models=tuple(models),
        joins=found.joins,
        joined=found.joined,
        num_images=run.unposed.num_images,
        num_pairs=len(relative.pairs),
        num_video_frames=videos.num_frames,
        left_out=left_out,
        timings_s=clock.seconds,
        warnings=(
            *map_warnings(run.images.rigs.incomplete, models, left_out),
            *found.warnings,
            *lost_distances(options.known_distance, models, found.joined),
        ),
    )
    return tell_joins(result)


def database_in(path: Path) -> Path:
    """Return the database of a folder, which is its database.db; any other path is that of a database.

    Raises:
        InputError: if the folder has none.
    """
    if not path.is_dir():
        return path
    if not (path / "database.db").is_file():
        raise InputError(f"{path} is a folder without a database.db; give the database file itself")
    return path / "database.db"


def _start(file: DatabaseFile, options: MapOptions, clock: Clock, priors: Path | str | None) -> "_Run":
    """Read what a run works from."""
    path = file.path
    with clock("read"):
        images = read_images(file)
        unposed = read_model(images.reconstruction)
        frame_of_image, sensor_rotations = images.frames(unposed.image_ids.tolist())
        if not _has_shared_frames(frame_of_image):
            if options.rigs == "free":
                raise InputError(f"{path} has no rig of several cameras to refine; leave out rigs=free")
            if options.scale == "rig":
                raise InputError(
                    f"{path} has no rig of several cameras to take the scale from; use another scale"
                )
        inputs = choose_inputs(images.reconstruction, path, options.directions)
        inputs = read_left_out(inputs, unposed.names, options)
        unposed, intrinsics = settle_intrinsics(unposed, file, options, inputs.left_out)
        for name in (name for one in options.known_distance for name in one[:2]):
            if name not in unposed.names:
                raise InputError(f"known_distance: the database has no image {name}")
        positions = read_priors(unposed, file, options, priors)
        control = read_control(unposed, options)
        gravity = read_gravity(file, unposed, options)
        matches = DatabaseMatches(file, unposed.names)
    return _Run(
        options=options,
        clock=clock,
        matches=matches,
        images=images,
        unposed=unposed,
        frame_of_image=frame_of_image,
        sensor_rotations=sensor_rotations,
        intrinsics=intrinsics,
        priors=positions,
        control=control,
        gravity=gravity,
        without=inputs.left_out,
    )


class _Run(NamedTuple):
    """What all components of a run have in common; the clock adds up the time that they take."""

    options: MapOptions
    clock: Clock
    matches: DatabaseMatches
    images: UnposedImages
    unposed: PosedModel
    """The images as a model."""
    frame_of_image: IntArray
    """(n,)"""
    sensor_rotations: FloatArray
    """(n, 3, 3) sensor_from_rig of each image."""
    intrinsics: Intrinsics
    """Which of theirs are in doubt."""
    priors: PositionPriors | None
    control: ControlPoints | None
    gravity: Gravity | None
    without: PairNames
    """Pairs that are taken for unmatched."""
    scores: Mapping[tuple[int, int], tuple[float, float]] = MappingProxyType({})
    """Of the pairs with a relative rotation: by their triangles, and the matched share of their overlap."""

    def measure(self) -> RelativeRotations:
        """Return the relative rotations of all pairs, by the intrinsics that the images have."""
        with self.clock("relative rotations"):
            sharing = Sharing(self.options.num_threads(), self.clock.executor, self.clock.advance)
            return measure_rotations(self.view(), LEAST_MATCHES, sharing)

    def view(self) -> View[PosedModel]:
        """Return the matches of all images, but for the pairs that are left out."""
        return self.matches.at(self.unposed, self.without)

    def find_videos(self, relative: RelativeRotations) -> Videos:
        """Return the videos among the images, as far as the options want to know of them."""
        asked = self.options.sequence
        nothing = Videos(np.full(self.unposed.num_images, -1), np.full(self.unposed.num_images, -1))
        videos = nothing if asked == "none" else find_videos(self.unposed.names)
        return confirm_videos(videos, relative) if asked == "auto" else videos

    def judge_loops(
        self, videos: Videos, relative: RelativeRotations
    ) -> tuple["_Run", RelativeRotations, tuple[Visit, ...]]:
        """Return run and pairs without loop pairs that the chains of their videos contradict, and visits."""
        if not videos.num_videos:
            return self, relative, ()
        with self.clock("rotation averaging"):
            loops = judge_loops(videos, relative, self.options.num_threads())
        names = self.unposed.names
        refused = {(names[i], names[j]) for i, j in relative.pairs[loops.refused].tolist()}
        kept = np.delete(np.arange(len(relative.pairs)), loops.refused)
        without = self.without | {(min(pair), max(pair)) for pair in refused}
        return self._replace(without=without), relative.subset(kept), loops.visits

    def score_pairs(self, relative: RelativeRotations) -> "_Run":
        """Return the run with the scores by which pairs of repeated structure are told."""
        pairs = list(map(tuple, relative.pairs.tolist()))
        triplets = score_triplets(self.unposed.num_images, relative).tolist()
        shares: dict[tuple[int, int], float] = {}
        if len(pairs) <= _MOST_SCORED_PAIRS:
            with self.clock("scores of pairs"):
                view = self.view()
                pixels = [view.keypoints(k) for k in range(self.unposed.num_images)]
                sizes = self.unposed.image_sizes()
                partners = count_partners([len(own) for own in pixels], view.links(LEAST_MATCHES))
                for batch in view.links(LEAST_MATCHES):
                    found = matched_shares(pixels, sizes, partners, batch).tolist()
                    shares |= zip(map(tuple, batch.pairs.tolist()), found, strict=True)
        both = zip(triplets, (shares.get(pair, np.nan) for pair in pairs), strict=True)
        return self._replace(scores=dict(zip(pairs, both, strict=True)))

    def share_of_doubted_lenses(self) -> float:
        """Return the share of images whose intrinsics are in doubt."""
        cameras = map(self.unposed.camera, range(self.unposed.num_images))
        return float(np.mean([camera.camera_id in self.intrinsics.free.doubts for camera in cameras]))

    def refine_intrinsics(self, relative: RelativeRotations) -> PosedModel:
        """Return the images with the intrinsics that first placements of all components find.

        Relative rotations by a wrong focal length are off by degrees, and the averaging may follow the false
        ones among them; a placement that is wrong in places knows the focal length all the same. Of a camera
        in several components the one with most images counts.
        """
        found: dict[int, list[float]] = {}
        for _, members, averaging in self.average_images(relative, {}):
            options = self._options_of(members, has_priors=False)
            model = self._pose(self.unposed.image_ids[members].tolist(), averaging.rotations)
            source = see_matches(self.matches, model, self.inputs_of(model), options)
            rule = GaugeRule(model, find_rigid_parts(model, options, has_priors=False), options, None)
            with suppress(UnsolvableError):
                with self.clock("first placement"):
                    free = self.intrinsics.free
                    first = adjust_first_placement(source, rule, self.clock, free, thorough=False)
                found = first.parameters() | found
        return with_parameters(self.unposed, found)

    def average_images(
        self, relative: RelativeRotations, reasons: dict[int, str]
    ) -> Iterator[tuple[IntArray, IntArray, AveragedRotations]]:
        """Yield the frames of each component, and its images with their rotations."""
        of_image, sensors = self.frame_of_image, self.sensor_rotations
        of_frames = relative_rotations_of_frames(relative, of_image, sensors)
        gravity = None if self.gravity is None else self.gravity.of_frames(of_image, sensors)
        averaging = ComponentAveraging(self.options, self.clock, gravity, self.shares_of_frames())
        for frames, averaged in averaging.average(int(of_image.max()) + 1, of_frames, reasons):
            members = np.flatnonzero(np.isin(of_image, frames))
            places = np.searchsorted(frames, of_image[members])
            yield frames, members, averaged.turned(places, sensors[members])

    def shares_of_frames(self) -> dict[tuple[int, int], float]:
        """Return the matched shares by pairs of frames; none where frames are those of rigs."""
        if not np.array_equal(self.frame_of_image, np.arange(len(self.frame_of_image))):
            return {}
        return {pair: share for pair, (_, share) in self.scores.items()}

    def locate_components(
        self, relative: RelativeRotations, visits: Sequence[Visit], reasons: dict[int, str]
    ) -> list[MappedModel]:
        """Return a model of each component that can be placed, most cameras first.

        Why a frame belongs to none is written to `reasons`, which starts with one for each.
        """
        models = []
        for frames, members, averaging in self.average_images(relative, reasons):
            try:
                located = self.locate_component(members, averaging, relative)
            except UnsolvableError as error:
                reasons |= dict.fromkeys(frames.tolist(), f"its component cannot be placed: {error}")
                continue
            names = tuple(self.unposed.names[k] for k in members.tolist())
            located = replace(located, loops=tuple(_loops_of(visits, self.unposed.names, set(names))))
            models.append(MappedModel(located=located, averaging=averaging, names=names))
            for k in frames.tolist():
                del reasons[k]
        return sorted(models, key=lambda model: -int(model.located.kept.sum()))

    def locate_component(
        self, members: IntArray, averaging: AveragedRotations, relative: RelativeRotations
    ) -> LocateResult:
        """Place one component, on the position priors of its images if they can set a scale."""
        priors = None if self.priors is None else self.priors.of(members)
        if priors is None or len(priors) < FEWEST_PRIORS:
            return self.locate_with_priors(members, averaging, relative, None)
        try:
            return self.locate_with_priors(members, averaging, relative, priors)
        except UselessPriorsError as error:  # which other components need not share
            found = self.locate_with_priors(members, averaging, relative, None)
            return replace(
                found, warnings=(*found.warnings, f"the scale is not that of position priors: {error}")
            )

    def locate_with_priors(
        self,
        members: IntArray,
        averaging: AveragedRotations,
        relative: RelativeRotations,
        priors: PositionPriors | None,
    ) -> LocateResult:
        """Place one component: adjust a first placement, and locate from the rotations of that."""
        image_ids = self.unposed.image_ids[members].tolist()
        control = None if self.control is None else self.control.of(members)
        gravity = None if self.gravity is None else self.gravity.among(members)
        options = self._options_of(members, has_priors=priors is not None)
        model = self._pose(image_ids, averaging.rotations)
        inputs = self.inputs_of(model)
        if averaging.num_repeated:  # the false pairs have most matches, and would fold the images again
            _, among = pairs_among(relative, members)
            inputs = replace(inputs, left_out=inputs.left_out | _false_pairs(model, among, averaging))
        rigid = find_rigid_parts(model, options, has_priors=priors is not None)
        averaged = see_matches(self.matches, model, inputs, options)
        source, first, intrinsics = averaged, None, self.intrinsics
        if self.options.adjust != "none":
            with self.clock("first placement"):
                rule = GaugeRule(model, rigid, options, priors)
                first = adjust_first_placement(averaged, rule, self.clock, intrinsics.free)
            intrinsics = intrinsics.after(first.adjusted.lenses)
            source = averaged.at(self._pose_as(image_ids, first))
            rigid = find_rigid_parts(source.model, options, has_priors=priors is not None)
        told = Told(
            inputs,
            rigid,
            RotationWeight(),
            priors=priors,
            control=control,
            gravity=gravity,
            intrinsics=intrinsics,
            rigs=sensors_of(model.reconstruction),
            near=first,
        )
        with self.clock("locate"):
            own = Clock.of(self.clock.progress, self.clock.executor)
            found = settle(source, told, options, own)
        ends = members[found.directions.pairs].tolist()
        unknown = (np.nan, np.nan)
        scores = np.array([self.scores.get((i, j), unknown) for i, j in ends]).reshape(-1, 2)
        return replace(
            found,
            triplet_scores=scores[:, 0],
            matched_shares=scores[:, 1],
            suspicions=tuple(_suspicions(averaging)),
        )

    def inputs_of(self, model: PosedModel) -> Inputs:
        """Return what the images of a component are located from."""
        inputs = choose_inputs(model.reconstruction, self.matches.file.path, self.options.directions)
        return replace(inputs, left_out=self.without)

    def _options_of(self, members: IntArray, *, has_priors: bool) -> LocateOptions:
        """Return the options of one component, whose scale is what is known of its own images."""
        settings = {item.name: getattr(self.options, item.name) for item in fields(LocateOptions)}
        names = {self.unposed.names[k] for k in members.tolist()}
        # Other known distances belong to other components.
        known = tuple(one for one in self.options.known_distance if {*one[:2]} <= names)
        if len(known) < len(self.options.known_distance):
            settings["known_distance"] = known
            settings["scale"] = settings["scale"] if known else "auto"
        if not has_priors:
            settings["refine_with_priors"] = False
        has_rigs = _has_shared_frames(self.frame_of_image[members])
        settings["rigs"] = settings["rigs"] if has_rigs else "held"
        if settings["scale"] == "rig" and not has_rigs:  # that of other components
            settings["scale"] = "auto"
        is_told = bool(known or has_priors or has_rigs or self.options.control_points)
        if not is_told and settings["scale"] in ("auto", "input", "prior"):
            # There is no input whose scale could be taken.
            settings["scale"] = "unit"
        return LocateOptions(**settings)

    def _pose_as(self, image_ids: list[int], first: FirstPlacement) -> PosedModel:
        """Return images with the rotations, intrinsics and rigs of a first placement, all centers 0."""
        rigs = self.images.rigs.with_sensors_of(first.adjusted.images)
        run = self._replace(images=replace(self.images, rigs=rigs)) if first.adjusted.sensors else self
        return run._pose(image_ids, first.rotations, first.parameters())

    def _pose(
        self, image_ids: list[int], rotations: FloatArray, found: Mapping[int, list[float]] | None = None
    ) -> PosedModel:
        """Return images with these rotations and all centers 0, and parameters that were found of cameras."""
        known = with_parameters(self.unposed, found or {})
        images = replace(self.images, reconstruction=known.reconstruction)
        return read_model(pose_at_origin(images, image_ids, rotations))


def _has_shared_frames(frames: IntArray) -> bool:
    """Return whether several images (n,) are of one frame, whose rig then knows a scale."""
    return len(np.unique(frames)) < len(frames)


def _false_pairs(model: PosedModel, among: RelativeRotations, averaging: AveragedRotations) -> PairNames:
    """Return the pairs of a model's images that its averaged rotations contradict, by name."""
    false = among.pairs[~agreeing_pairs(among, averaging)].tolist()
    names = ((model.names[i], model.names[j]) for i, j in false)
    return frozenset((min(pair), max(pair)) for pair in names)


def _suspicions(averaging: AveragedRotations) -> Iterator[str]:
    """Yield why a model is to be looked at, whatever its pairs say: they say the same of a folded scene."""
    if averaging.num_repeated:
        yield "the scene repeats itself, and pairs that would fold it were not followed"
    if averaging.num_rivals:
        yield "the images can be arranged in another way"


def _loops_of(visits: Iterable[Visit], names: Sequence[str], among: set[str]) -> Iterator[Loop]:
    """Yield the visits that begin among some images, by name."""
    for visit in visits:
        first, second = ((names[a], names[b]) for a, b in (visit.first, visit.second))
        if first[0] in among:
            yield Loop(
                first=first,
                second=second,
                num_pairs=visit.num_pairs,
                num_matches=visit.num_matches,
                num_refused=visit.num_refused,
                angle_deg=visit.angle_deg,
                tolerance_deg=visit.tolerance_deg,
            )


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
