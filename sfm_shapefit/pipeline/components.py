"""The components of a database: relative rotations of all images, and averaged ones, component by component.

Frames that the averaging of a component drops are grouped anew by the pairs among themselves.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.base.lists import RowLists
from sfm_shapefit.base.wording import counted
from sfm_shapefit.facts.command_options import MapOptions
from sfm_shapefit.facts.intrinsics import RefinedIntrinsics
from sfm_shapefit.facts.result import Inputs
from sfm_shapefit.files.colmap.database import DatabaseMatches
from sfm_shapefit.files.colmap.database_images import UnposedImages, read_images
from sfm_shapefit.files.colmap.database_pairs import refuse_no_features
from sfm_shapefit.files.colmap.known import read_known
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.pairs.direction_options import LEAST_MATCHES
from sfm_shapefit.pairs.missing_matches import count_partners, matched_shares
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pairs.triplets import score_triplets
from sfm_shapefit.pipeline.inputs import MatchSource, inputs_from, read_left_out, see_matches
from sfm_shapefit.pipeline.intrinsics import choose_intrinsics
from sfm_shapefit.pipeline.memory import largest_group, see_within_limit
from sfm_shapefit.pipeline.relative_rotations import measure_rotations
from sfm_shapefit.placement.gauge_rule import between_images
from sfm_shapefit.placement.memory_plan import MEMORY_PLANS, MemoryPlan
from sfm_shapefit.rotations.arrangements import choose_arrangement, evidence_of
from sfm_shapefit.rotations.average import average_relative_rotations
from sfm_shapefit.rotations.averaged import AveragedRotations
from sfm_shapefit.rotations.averaging_options import AveragingOptions
from sfm_shapefit.rotations.frames import relative_rotations_of_frames
from sfm_shapefit.rotations.sequences import Loop, Videos, confirm_videos, find_videos, judge_loops
from sfm_shapefit.scene.given import Gravity, Known
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import PairNames, View, rows_of_pairs

_MOST_SCORED_PAIRS = 20_000  # pairs; scores of more are not worth 0.2 ms a pair and 16 bytes a match

# What only unsound pairs, or pairs below `min_matches`, tie to the rest.
_UNTIED = (
    "no pair that can be believed ties it to the others: their matches are few, fit no one relative pose, or "
    "contradict the rest"
)


class PairScores(NamedTuple):
    """Scores of pairs with a relative rotation, by which those of repeated structure are told."""

    pairs: IntArray = np.zeros((0, 2), dtype=np.int64)
    """(m, 2)"""
    values: FloatArray = np.zeros((0, 2))
    """(m, 2) by triangles, and the matched share of their overlap; NaN where unknown."""

    def of(self, pairs: IntArray) -> FloatArray:
        """Return those of some pairs (k, 2), (k, 2)."""
        return np.vstack([self.values, [np.nan, np.nan]])[rows_of_pairs(pairs, self.pairs)]


def start_run(
    file: DatabaseFile, options: MapOptions, clock: Clock, priors: Path | str | None
) -> "MapContext":
    """Read what a run works from: the database, and the files that the options name."""
    path = file.path
    with clock("read"):
        refuse_no_features(file)
        read = read_images(file)
        images = read.images
        if options.freedom.rigs == "free" and not images.has_rigs:
            raise InputError(f"{path} has no rig of several cameras to refine; leave out rigs=free")
        inputs = read_left_out(inputs_from(path), images.names, options.directions.without)
        matches = DatabaseMatches(file, images.names)
        images, intrinsics = choose_intrinsics(images, matches, options.freedom.intrinsics, inputs.left_out)
        gauge = between_images(options.gauge, images.names, "the database has no image")
        known = read_known(
            images,
            file,
            priors,
            control_points=gauge.control_points,
            scale_bars=gauge.scale_bars,
            gravity=options.averaging.gravity,
        )
    run = MapContext(
        options=replace(options, gauge=gauge),
        clock=clock,
        matches=matches,
        read=read,
        images=images,
        intrinsics=intrinsics,
        known=known,
        without=inputs.left_out,
    )
    with clock("read"):
        return run.within_limit()


class MapContext(NamedTuple):
    """What all components of a run have in common; the clock adds up the time that they take."""

    options: MapOptions
    clock: Clock
    matches: DatabaseMatches
    read: UnposedImages
    images: Images
    """All of the database, at the origin."""
    intrinsics: RefinedIntrinsics
    """Which of theirs are in doubt."""
    known: Known
    without: PairNames
    """Pairs that are taken for unmatched."""
    scores: PairScores = PairScores()
    """Scores of pairs of images."""
    memory_plan: MemoryPlan = MEMORY_PLANS[0]
    """What is given up for memory where the matches of all images are read."""

    def within_limit(self) -> "MapContext":
        """Return the run with what is given up for the limit of memory.

        InputError: if the largest group of images that pairs tie takes more, whatever is given up.
        """
        if not self.options.memory.max_memory_mb:
            return self
        largest = largest_group(see_matches(self.matches, self.images, self.inputs))
        source = self.see(self.images.part(largest), self.inputs)
        return self._replace(memory_plan=source.memory_plan)

    def see(self, images: Images, inputs: Inputs) -> MatchSource:
        """Return the matches as images of a component see them, within the limit of memory."""
        return see_within_limit(see_matches(self.matches, images, inputs), self.options, is_component=True)

    def measure(self) -> RelativeRotations:
        """Return the relative rotations of all pairs, by the intrinsics that the images have."""
        with self.clock("relative rotations"):
            return measure_rotations(self.view(), LEAST_MATCHES, self.clock)

    def view(self) -> View:
        """Return the matches of all images in axes of their cameras, but for the pairs that are left out."""
        return self.matches.at(self.images.apart(), self.without, self.memory_plan.reading)

    def find_videos(self, relative: RelativeRotations) -> Videos:
        """Return the videos among the images, as far as the options want to know of them."""
        sequence = self.options.averaging.sequence
        nothing = Videos(np.full(self.images.num_images, -1), np.full(self.images.num_images, -1))
        videos = nothing if sequence == "none" else find_videos(self.images.names)
        return confirm_videos(videos, relative) if sequence == "auto" else videos

    def judge_loops(
        self, videos: Videos, relative: RelativeRotations
    ) -> tuple["MapContext", RelativeRotations, tuple[Loop, ...]]:
        """Return run and pairs without loop pairs that the chains of videos contradict, and all loops."""
        if not videos.num_videos:
            return self, relative, ()
        with self.clock("rotation averaging"):
            verdict = judge_loops(videos, self.images.names, relative, self.clock.threads)
        names = self.images.names
        refused = {(names[i], names[j]) for i, j in relative.pairs[verdict.refused].tolist()}
        kept = ~np.isin(np.arange(len(relative.pairs)), verdict.refused)
        without = self.without | {(min(pair), max(pair)) for pair in refused}
        return self._replace(without=without), relative.subset(kept), verdict.loops

    def score_pairs(self, relative: RelativeRotations) -> "MapContext":
        """Return the run with the scores by which pairs of repeated structure are told."""
        scores = np.full((len(relative.pairs), 2), np.nan)
        scores[:, 0] = score_triplets(self.images.num_images, relative)
        if len(scores) <= _MOST_SCORED_PAIRS:
            with self.clock("scores of pairs"):
                view = self.view()
                pixels = [view.keypoints(k) for k in range(self.images.num_images)]
                sizes = self.images.sizes_px
                batches = list(view.links(LEAST_MATCHES))  # both look at all of them
                partners = count_partners([len(image_pixels) for image_pixels in pixels], batches)
                for batch in batches:
                    rows = rows_of_pairs(batch.pairs, relative.pairs)
                    scores[rows[rows >= 0], 1] = matched_shares(pixels, sizes, partners, batch)[rows >= 0]
        return self._replace(scores=PairScores(relative.pairs, scores))

    def average_images(
        self, relative: RelativeRotations, reasons: dict[int, str]
    ) -> Iterator[tuple[IntArray, IntArray, AveragedRotations]]:
        """Yield the frames of each component, and its images with their rotations."""
        of_image, images = self.frame_of_image, self.images
        sensors = images.sensors.rotations[images.lens_of]
        of_frames = relative_rotations_of_frames(relative, of_image, sensors)
        gravity = self.known.gravity
        gravity = None if gravity is None else gravity.of_frames(of_image, sensors)
        scores = PairScores() if images.has_rigs else self.scores
        averaging = ComponentAveraging(self.options.averaging, self.clock, gravity, scores)
        for frames, averaged in averaging.average(int(of_image.max()) + 1, of_frames, reasons):
            members = np.flatnonzero(np.isin(of_image, frames))
            places = np.searchsorted(frames, of_image[members])
            yield frames, members, averaged.turned(places, sensors[members])

    @property
    def frame_of_image(self) -> IntArray:
        """Frames of the images (n,), numbered as their first images stand."""
        frame_of = self.images.frame_of
        _, first = np.unique(frame_of, return_index=True)
        return np.argsort(np.argsort(first))[frame_of]

    @property
    def inputs(self) -> Inputs:
        """What models are located from."""
        return replace(inputs_from(self.matches.file.path), left_out=self.without)

    def pose(self, members: IntArray, rotations: FloatArray) -> Images:
        """Return some images with these rotations (k, 3, 3), all frames at the origin."""
        return self.images.part(members).turned_to(rotations)


class ComponentAveraging(NamedTuple):
    """How the rotations of components are averaged."""

    options: AveragingOptions
    clock: Clock
    gravity: Gravity | None
    """Gravity in the axes of frames."""
    scores: PairScores = PairScores()
    """Scores of pairs of frames, as far as they are known."""

    def average(
        self, num_frames: int, relative: RelativeRotations, reasons: dict[int, str]
    ) -> Iterator[tuple[IntArray, AveragedRotations]]:
        """Yield the frames of each component that got rotations, ascending, and those rotations.

        Why a frame belongs to none is written to `reasons`.
        """
        waiting, least = _group_frames(num_frames, relative.pairs), self.options.min_model_size
        while waiting:
            members = waiting.pop(0)
            if len(members) < least:
                if len(members) > 1:
                    few = f"matches tie it only into {_group(len(members))}; a model needs {least}"
                    reasons |= dict.fromkeys(members.tolist(), few)
                continue
            inside, local = pairs_among(relative, members)
            try:
                with self.clock("rotation averaging"):
                    answer = self._average_component(members, inside, local)
            except UnsolvableError as error:
                reasons |= dict.fromkeys(members.tolist(), str(error))
                continue
            kept, left = members[answer.registered], members[~answer.registered]
            reasons |= dict.fromkeys(left.tolist(), _UNTIED)
            if len(left) < len(members):
                rest = inside.pairs[np.isin(inside.pairs, left).all(axis=1)]
                waiting = [*waiting, *(group for group in _group_frames(num_frames, rest) if len(group) > 1)]
            if len(kept) >= least:
                yield kept, answer.subset(answer.registered)
            else:
                tied = f"pairs that can be believed tie it only into {_group(len(kept))}"
                reasons |= dict.fromkeys(kept.tolist(), f"{tied}; a model needs {least}")

    def _average_component(
        self, members: IntArray, inside: RelativeRotations, local: RelativeRotations
    ) -> AveragedRotations:
        """Average rotations, by the arrangement of the frames that the matches speak for, and by gravity.

        The pairs among them are `inside`, and `local` by their place among the members.
        """

        def average(some: RelativeRotations) -> AveragedRotations:
            used = some.num_matches >= self.options.min_matches
            if not used.any():
                raise UnsolvableError(
                    f"none of {counted(len(used), 'pair')} has {self.options.min_matches} inlier matches; "
                    "lower min_matches"
                )
            return average_relative_rotations(len(members), some.subset(used), self.clock.threads)

        answer = average(local)
        evidence = evidence_of(inside, self.scores.of(inside.pairs)[:, 1])
        if evidence.any():
            chosen = choose_arrangement(local, evidence, answer, average)
            repeated, rivals = int(chosen.refused.sum()), int(chosen.rival.sum())
            answer = replace(chosen.averaged, num_repeated=repeated, num_rivals=rivals)
        if self.gravity is None:
            return answer
        from sfm_shapefit.rotations.gravity import refine_with_gravity  # it loads long

        return refine_with_gravity(answer, local, self.gravity.of(members))


def pairs_among(
    relative: RelativeRotations, members: IntArray
) -> tuple[RelativeRotations, RelativeRotations]:
    """Return the pairs among some images or frames, ascending, and the same by their place among these."""
    inside = relative.subset(np.asarray(np.isin(relative.pairs, members).all(axis=1)))
    return inside, replace(inside, pairs=np.searchsorted(members, inside.pairs))


def _group(count: int) -> str:
    """Count the frames of a group; without rigs, each is an image."""
    return f"a group of {counted(count, 'image')} (a frame of a rig counts as one)"


def _group_frames(num_frames: int, pairs: IntArray) -> list[IntArray]:
    """Return the connected components, ascending, the largest first; single frames are components too."""
    groups = RowLists.by_label(connected_components(num_frames, pairs))
    return sorted(groups, key=lambda group: (-len(group), int(group[0])))
