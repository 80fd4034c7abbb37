"""What the components of a run of `map` share: relative rotations of all images, averaged one by one."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.facts.command_options import MapOptions
from sfm_shapefit.facts.intrinsics import RefinedIntrinsics
from sfm_shapefit.facts.result import Inputs
from sfm_shapefit.files.colmap.database import DatabaseMatches
from sfm_shapefit.files.colmap.database_images import UnposedImages, read_images
from sfm_shapefit.files.colmap.database_pairs import refuse_no_features
from sfm_shapefit.files.colmap.known import read_known
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.pairs.direction_options import LEAST_MATCHES
from sfm_shapefit.pairs.pair_scores import MOST_SCORED_PAIRS, PairScores, score_repetition
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pipeline.inputs import MatchSource, inputs_from, read_left_out, see_matches
from sfm_shapefit.pipeline.intrinsics import choose_intrinsics
from sfm_shapefit.pipeline.memory import largest_group, see_within_limit
from sfm_shapefit.pipeline.relative_rotations import measure_rotations
from sfm_shapefit.placement.gauge_rule import between_images
from sfm_shapefit.placement.memory_plan import MEMORY_PLANS, MemoryPlan
from sfm_shapefit.rotations.averaged import AveragedRotations
from sfm_shapefit.rotations.components import ComponentAveraging
from sfm_shapefit.rotations.frames import relative_rotations_of_frames
from sfm_shapefit.rotations.sequences import Loop, Videos, confirm_videos, find_videos, judge_loops
from sfm_shapefit.scene.given import Known
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.matches import PairNames, View


def start_run(
    file: DatabaseFile, options: MapOptions, clock: Clock, priors: Path | str | Known | None
) -> "MapContext":
    """Read what a run works from: the database, and the files that the options name."""
    with clock("read"):
        refuse_no_features(file)
        read = read_images(file)
        images = read.images
        options, inputs, known = read_beside(file, images, options, priors)
        matches = DatabaseMatches(file, images.names)
        images, intrinsics = choose_intrinsics(images, matches, options.freedom.intrinsics, inputs.left_out)
    run = MapContext(
        options=options,
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


def read_beside(
    file: DatabaseFile, images: Images, options: MapOptions, priors: Path | str | Known | None
) -> tuple[MapOptions, Inputs, Known]:
    """Read what the options tell of the images of a database, which needs no features for that.

    Returns:
        the options with their distances between these images, the inputs with the pairs that are left out,
        and what is known of the images; with `priors` of that kind, it has been read already.

    Raises:
        InputError: if a file cannot be used, or an option is not for these images.
    """
    if options.freedom.rigs == "free" and not images.has_rigs:
        raise InputError(
            f"{file.path} has no rig of several cameras with poses to refine; leave out rigs=free"
        )
    inputs = read_left_out(inputs_from(file.path), images.names, options.directions.without)
    gauge = between_images(options.gauge, images.names, "the database has no image")
    options, gravity = replace(options, gauge=gauge), options.averaging.gravity
    if isinstance(priors, Known):
        return options, inputs, priors
    files = {"control_points": gauge.control_points, "scale_bars": gauge.scale_bars, "gravity": gravity}
    return options, inputs, read_known(images, file, priors, **files)


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
    suspicions: tuple[str, ...] = ()
    """Why the models are to be looked at, whatever their pairs say, a clause each."""
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
        if len(relative.pairs) > MOST_SCORED_PAIRS:
            return self._replace(scores=score_repetition(self.images.num_images, relative))
        with self.clock("scores of pairs"):
            return self._replace(scores=score_repetition(self.images.num_images, relative, self.view()))

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
        averaging = ComponentAveraging(
            self.options.averaging,
            self.clock.threads,
            gravity,
            scores,
            timed=lambda: self.clock("rotation averaging"),
        )
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
