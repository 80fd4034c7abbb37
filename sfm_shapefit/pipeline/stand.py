"""Where the cameras of one rigid piece stand, from their placement to their model."""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.freedom import Freedom, GivenPoses
from sfm_shapefit.adjustment.sources import Links, collect_matches, collect_tracks
from sfm_shapefit.base.arrays import BoolArray, IntArray
from sfm_shapefit.base.executors import Advance
from sfm_shapefit.facts.intrinsics import RefinedIntrinsics
from sfm_shapefit.facts.options import PlacingOptions
from sfm_shapefit.files.colmap.points import ModelPictures
from sfm_shapefit.files.colmap.track_matches import TrackMatches
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.pipeline.given import Given
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.placement.gauge import Gauge
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.known_positions import KnownPositions
from sfm_shapefit.scene.matches import is_among


class PosedPart(NamedTuple):
    """The placed images of all, in the order of their ids: that of the sums of an adjustment."""

    images: Images
    rows: IntArray
    """(i,) their rows among all."""
    frames: IntArray
    """(f,) rows of their frames among all."""
    lenses: IntArray
    """(l,) rows of their lenses among all."""


class Stand(NamedTuple):
    """Where the cameras of one rigid piece stand, in the frame that is worked in."""

    given: Given
    source: MatchSource
    """The matches, at the rotations that the piece has now."""
    directions: PairDirections
    placement: Placement
    gauge: Gauge
    """The map from the placement's locations to the frame that is worked in."""
    freedom: Freedom
    intrinsics: RefinedIntrinsics
    held: KnownPositions | None = None
    """Priors that pull at the frames and hold the gauge by that, with the weights that they ended with."""
    estimate: Estimate | None = None
    """The last adjustment; None if there was none."""
    scale: float = 1.0
    """Length of the solver's unit in units of the estimate."""
    adjustment: Estimate | None = None
    """How this placement was adjusted; None if it was not."""
    failures: tuple[str, ...] = ()
    """Steps that failed and were left out, a clause each; the model is to be looked at for them."""

    @classmethod
    def of(
        cls,
        given: Given,
        source: MatchSource,
        directions: PairDirections,
        placement: Placement,
        options: PlacingOptions,
    ) -> "Stand":
        """Return where cameras are placed, before anything is adjusted: in the gauge of all of them."""
        gauge = given.rule.choose(placement.cameras, placement.locations, placement.unit)
        lenses, has_rigs = given.intrinsics, given.rigid.groups is not None
        freedom = Freedom.asked(options.freedom, lenses.parts, rigs=has_rigs)
        return cls(given, source, directions, placement, gauge, freedom, lenses)

    @property
    def among(self) -> IntArray | None:
        """The images whose matches are read: of a further piece, which is small, its own; None for all."""
        return self.placement.cameras if self.placement.piece else None

    @property
    def fit_rotations(self) -> BoolArray:
        """Images (i,) whose rotations the model's own tracks fit as well as any: these ask for no turns."""
        frames, done = np.zeros(len(self.given.images.frames.ids), dtype=np.bool_), self.adjustment
        if not self.source.has_database and done and done.errors and done.errors.sigma_rad == 0.0:
            frames |= ~self.freedom.singled_out()
        return np.asarray(frames[self.given.images.frame_of])

    def failed(self, how: str) -> "Stand":
        """Return the same without a step that failed; `how` says which and why, a clause."""
        return self._replace(failures=(*self.failures, how))

    def place(self, kept: BoolArray | None = None) -> Images:
        """Return all images where they are placed, fixed ones as they were; NaN where neither.

        Only the placement's cameras (k,) that are `kept` count.
        """
        chosen = np.ones(len(self.placement.cameras), dtype=np.bool_) if kept is None else kept
        centers = self.gauge.similarity.apply(self.placement.locations[chosen])
        images = self.source.images
        placed = images.placed(self.placement.cameras[chosen], centers)
        fixed, frames = self.given.fixed_frames[:, None], placed.frames
        return placed.posed(frames.rotations, np.where(fixed, images.frames.centers, frames.centers))

    def given_poses(self, posed: PosedPart) -> GivenPoses:
        """Return what is known of the frames of some placed images beside the pixels."""
        rotations = None if self.adjustment is None else self.given.images.frames.rotations
        return GivenPoses(rotations, self.given.fixed_frames, self.held).of(posed.frames)

    def pictures(self, posed: PosedPart) -> ModelPictures:
        """Return the keypoints of placed images and their lenses."""
        rows, view = posed.rows.tolist(), self.source.view
        counts = view.num_keypoints[posed.rows]
        return ModelPictures(posed.images, lambda k: view.keypoints(rows[k]), counts)

    def read_links(self, posed: PosedPart, advance: Advance, *, rejected: bool = False) -> Links:
        """Return what joins the keypoints of placed images, or matches of rejected pairs; rays are forgotten.

        From here to the end of a triangulation, or an adjustment, most memory is needed.
        """
        view, pictures = self.source.view, self.pictures(posed)
        if isinstance(self.source.matches, TrackMatches):  # the model has its tracks already
            return collect_tracks(posed.images, pictures, self.source.matches.points_of(posed.images))
        wanted = is_among(view.pairs, self.placement.rejected_pairs) == rejected
        if self.among is not None:
            wanted &= np.isin(view.pairs, self.among).all(axis=1)
        links = view.links(chosen=wanted, advance=advance, consume=True)
        place = np.full(self.source.images.num_images, -1)
        place[posed.rows] = np.arange(len(posed.rows))
        return collect_matches(posed.images, pictures, place, links, view.num_matches)


def posed_part(images: Images) -> PosedPart:
    """Return those of some images that have a pose."""
    rows = np.flatnonzero(images.is_posed)
    rows = rows[np.argsort(images.ids[rows])]
    frames, lenses = (np.unique(of[rows]) for of in (images.frame_of, images.lens_of))
    return PosedPart(images.part(rows), rows, frames, lenses)
