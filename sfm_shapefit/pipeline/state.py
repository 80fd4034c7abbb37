"""The state of a model on its way from matches to points: what each stage is handed, and hands on."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.freedom import Freedom, GivenPoses
from sfm_shapefit.adjustment.sources import Links, collect_matches, collect_tracks
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, distinct
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.executors import Advance, Crew
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.base.row_file import make_room
from sfm_shapefit.facts.control_points import ControlPoint
from sfm_shapefit.facts.intrinsics import RefinedIntrinsics
from sfm_shapefit.facts.scale_bars import MeasuredBars
from sfm_shapefit.files.colmap.points import ModelKeypoints
from sfm_shapefit.files.colmap.track_matches import TrackMatches
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.judgement.measured_pairs import MeasuredPairs
from sfm_shapefit.judgement.reasons import Kind, Reason, of_model
from sfm_shapefit.judgement.support import Support
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.pipeline.inputs import MatchSource, RunInputs
from sfm_shapefit.placement.fixed_and_rigged import FixedAndRigged, find_fixed_and_rigged
from sfm_shapefit.placement.gauge import Gauge
from sfm_shapefit.placement.gauge_rule import GaugeRule
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.refinement.starts import RefinedPlacement
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.known_positions import KnownPositions
from sfm_shapefit.scene.matches import MOST_BESIDE_TRACKS, is_among
from sfm_shapefit.scene.points import Points
from sfm_shapefit.solver.solve import refuse_admm

_LATER: Any = None
"""In place of what a later stage finds out."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelState:
    """One rigid piece of a model between two stages, which replace what they find out; see `stages`."""

    inputs: RunInputs
    source: MatchSource
    """The matches as the images see them, at the rotations and lenses that these have now."""
    rigid: FixedAndRigged
    intrinsics: RefinedIntrinsics
    """What may still change of lenses in doubt, and what became of them so far."""
    near: RefinedPlacement | None = None
    """A first placement, at the centers (i, 3) where its adjustment has the images, NaN for others."""
    first: Estimate | None = None
    """How a first placement was adjusted."""
    measured: MeasuredPairs = _LATER
    """Directions of pairs and, until cameras are placed, what else was measured."""
    placement: Placement = _LATER
    """Where cameras stand, in the solver's units; then `judged`."""
    frame: Gauge = _LATER
    """The map from the placement's locations to the frame that is worked in."""
    held: KnownPositions | None = None
    """Priors that pull at image frames and hold this one by that, with the weights that they ended with."""
    adjustment: Estimate | None = None
    """How the placement was adjusted."""
    turned_deg: FloatArray | None = None
    """(i,) by how much that turned each rotation, exactly 0 where it was kept."""
    kept: BoolArray = _LATER
    """(k,) placed cameras that are in the output."""
    images: Images = _LATER
    """All images where they are in the output, NaN where they are not."""
    points: Points = _LATER
    support: Support = _LATER
    gauge: Gauge = _LATER
    """The map from the placement's locations to the output."""
    bundle: Estimate | None = None
    """How cameras and points were bundle adjusted, if that was asked for."""
    control: tuple[ControlPoint, ...] = ()
    bars: MeasuredBars | None = None
    """Scale bars as they are in the output."""
    evidence: ModelEvidence = _LATER
    warnings: tuple[str, ...] = ()
    """What the user should know, a sentence each, from the stages that know it."""
    reasons: tuple[Reason, ...] = ()
    """What bears on the verdict beside the evidence."""

    @classmethod
    def of(cls, inputs: RunInputs, source: MatchSource) -> "ModelState":
        """Return the state before the first stage.

        InputError: if the fixed images stand at one place, or the solver does not go with rigs.
        """
        rigid = find_fixed_and_rigged(source.images, inputs.fixed)
        if rigid.groups is not None:
            refuse_admm(inputs.options.placement.solver)
        source = replace(source, fixed=inputs.fixed if inputs.fixed.any() else None)
        return cls(inputs=inputs, source=source, rigid=rigid, intrinsics=inputs.intrinsics)

    @property
    def directions(self) -> PairDirections:
        """The directions of all pairs that were looked at, at the present rotations."""
        return self.measured.directions

    @property
    def judged(self) -> Judged:
        """The placement with the evidence for it."""
        assert isinstance(self.placement, Judged)
        return self.placement

    @property
    def among(self) -> IntArray | None:
        """The images whose matches are read: of a further piece, which is small, its own; None for all."""
        return self.placement.cameras if self.placement.piece else None

    @property
    def estimate(self) -> Estimate | None:
        """The last adjustment; None without one."""
        return self.bundle or self.adjustment or self.first

    @property
    def freedom(self) -> Freedom:
        """What adjustments may change beside centers and points."""
        if self.adjustment is None:
            rigs = self.rigid.groups is not None
            return Freedom.asked(self.inputs.options.freedom, self.intrinsics.parts, rigs=rigs)
        every, adjusted = self.source.images.frames.ids, self.adjustment.images.frames.ids
        freedom = self.adjustment.freedom.among(np.searchsorted(every, adjusted), len(every))
        return replace(freedom, parts=self.intrinsics.parts)

    @property
    def fit_rotations(self) -> BoolArray:
        """Images (i,) whose rotations the model's own tracks fit as well as any: these ask for no turns."""
        images, done = self.inputs.images, self.adjustment
        frames = np.zeros(len(images.frames.ids), dtype=np.bool_)
        if not self.source.has_database and done and done.errors and done.errors.sigma_rad == 0.0:
            frames |= ~self.freedom.singled_out()
        return np.asarray(frames[images.frame_of])

    @property
    def gauge_rule(self) -> GaugeRule:
        """What sets scale, origin and axes of the model."""
        inputs = self.inputs
        return GaugeRule(inputs.images, self.rigid, inputs.scale, inputs.known.priors, inputs.distances)

    def framed(self) -> "ModelState":
        """Return the same in the frame of the placed cameras that are kept, or of all; priors hold theirs."""
        if self.held is not None:
            return self
        placed, kept = self.placement, slice(None) if self.kept is None else self.kept
        frame = self.gauge_rule.choose(placed.cameras[kept], placed.locations[kept], placed.unit)
        return replace(self, frame=frame)

    def warned(self, *warnings: str) -> "ModelState":
        """Return the same with more that the user should know."""
        return replace(self, warnings=(*self.warnings, *warnings))

    def failed(self, how: str) -> "ModelState":
        """Return the same without a step that failed; `how` says which and why, a clause."""
        return replace(self.warned(how), reasons=(*self.reasons, of_model(Kind.FAILED, how)))

    def placed(self, kept: BoolArray | None = None) -> Images:
        """Return all images where they are placed, fixed ones as they were; NaN where neither.

        Only the placement's cameras (k,) that are `kept` count; all if None.
        """
        chosen = np.ones(len(self.placement.cameras), dtype=np.bool_) if kept is None else kept
        centers = self.frame.similarity.apply(self.placement.locations[chosen])
        images = self.source.images
        frames = images.placed(self.placement.cameras[chosen], centers).frames
        fixed = self.inputs.fixed_frames[:, None]
        return images.posed(frames.rotations, np.where(fixed, images.frames.centers, frames.centers))

    def moved(self, motion: Similarity, gauge: Gauge) -> "ModelState":
        """Return the same in another gauge, a similarity away; fixed cameras stay."""
        images = self.images.transformed(motion, self.inputs.fixed_frames)
        return replace(self, images=images, points=self.points.transformed(motion), gauge=gauge)

    def freedom_of(self, rows: IntArray) -> Freedom:
        """Return the freedom of the frames and lenses of some images (r,)."""
        images = self.source.images
        return self.freedom.of(distinct(images.frame_of[rows]), distinct(images.lens_of[rows]))

    def given_poses(self, rows: IntArray) -> GivenPoses:
        """Return what is known of the frames of some images (r,) beside the pixels."""
        images = self.inputs.images
        rotations = None if self.adjustment is None else images.frames.rotations
        given = GivenPoses(rotations, self.inputs.fixed_frames, self.held)
        return given.of(distinct(images.frame_of[rows]))

    def crew_of(self, clock: Clock) -> Crew:
        """Return who works, and how for memory."""
        return replace(clock.crew, divides=self.source.memory_plan.divides)

    def pictures(self, images: Images, rows: IntArray) -> ModelKeypoints:
        """Return the keypoints of some images (r,), and their lenses."""
        chosen, view = rows.tolist(), self.source.view
        return ModelKeypoints(
            images.part(rows), lambda k: view.keypoints(chosen[k]), view.num_keypoints[rows]
        )

    def read_links(
        self, images: Images, advance: Advance, threads: int = 1, *, rejected: bool = False
    ) -> Links:
        """Return what joins the keypoints of posed images, or matches of rejected pairs; rays are forgotten.

        From here to the end of a triangulation, or an adjustment, most memory is needed.
        """
        view, rows = self.source.view, images.posed_rows
        pictures, posed = self.pictures(images, rows), images.part(rows)
        if isinstance(self.source.matches, TrackMatches):  # the model has its tracks already
            return collect_tracks(posed, pictures, self.source.matches.points_of(posed), threads)
        wanted = is_among(view.pairs, self.placement.rejected_pairs) == rejected
        if self.among is not None:
            wanted &= np.isin(view.pairs, self.among).all(axis=1)
        links = view.links(chosen=wanted, advance=advance, consume=True)
        place = np.full(images.num_images, -1)
        place[rows] = np.arange(len(rows))
        number = np.uint32 if view.num_keypoints.sum() < 2**32 else np.int64
        room = make_room((view.num_matches, 2), number, in_file=view.num_matches > MOST_BESIDE_TRACKS)
        return collect_matches(posed, pictures, place, links, room, threads)
