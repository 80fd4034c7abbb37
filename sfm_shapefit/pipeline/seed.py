"""From placed cameras to cameras with points, adjusted if asked for, in their gauge."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment.bundle_adjustment import adjust_seed
from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.sources import Links
from sfm_shapefit.adjustment.structure import triangulate
from sfm_shapefit.adjustment.views import views_of
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, hand_back_memory
from sfm_shapefit.base.executors import nobody
from sfm_shapefit.base.geometry import Similarity, mean_rotation_l1
from sfm_shapefit.facts.options import PlacingOptions
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.judgement.support import (
    ObservationShares,
    PartnerCounts,
    images_of_few_points,
    images_without_support,
)
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.pipeline.stand import Stand, posed_part
from sfm_shapefit.placement.gauge import Gauge
from sfm_shapefit.placement.prior_refinement import PULLED
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.filter import filter_points
from sfm_shapefit.tracks.links import MatchedKeypoints

_FEWEST_KEPT = 3  # trusted cameras; fewer are no result, so that all are kept then


class Seeded(NamedTuple):
    """Placed cameras with their points."""

    images: Images
    """All of the input, NaN where they are not placed."""
    points: Points
    gauge: Gauge
    """From the solver's units to those of images and points."""
    fixed: BoolArray
    """(f,) frames that no motion moves."""
    adjusted: Estimate | None
    """How bundle adjustment went, if it was asked for."""
    num_seen: IntArray
    """(i,) points that an image saw which was left out because they are too few, or hardly any of those that
    its matches could make; -1 for all others."""
    unsupported: BoolArray
    """(i,) images hardly any of whose matches makes a point; of least trust 0 they are not left out."""
    observations: ObservationShares
    """Shares of keypoints matched in two other images that see a point, and that contradict the cameras."""

    def moved(self, motion: Similarity, gauge: Gauge) -> "Seeded":
        """Return the same after a similarity of the world, in the gauge that it leads to."""
        images, points = self.images.transformed(motion, self.fixed), self.points.transformed(motion)
        return self._replace(images=images, points=points, gauge=gauge)


def turn_about_origin(rotation: FloatArray) -> Similarity:
    """Return the motion that only turns the world."""
    return Similarity(scale=1.0, rotation=rotation, translation=np.zeros(3))


def select_trusted(placement: Judged, min_trust: float) -> BoolArray:
    """Return which of the placed cameras are trusted enough; all, if hardly any is."""
    kept: BoolArray = placement.assessment.trust >= min_trust
    return kept if np.sum(kept) >= _FEWEST_KEPT else np.ones_like(kept)


def seed_points(
    stand: Stand, kept: BoolArray, options: PlacingOptions, clock: Clock, sure: BoolArray | None = None
) -> Seeded:
    """Move the cameras, triangulate points, and adjust both if asked for.

    Bundle adjustment is free to scale, shift and turn everything; the gauge is set again after it.

    The placement's cameras (k,) that are `kept` are in the output. Half of the points suffice for images (i,)
    that are `sure`, as the pixels confirm them.
    """
    source, fixed = stand.source, stand.given.fixed_frames
    images, points, adjusted, partners = _make_points(stand, kept, options, clock)
    hand_back_memory()  # the links are gone
    least = np.full(len(fixed), options.structure.min_points_per_image)
    if sure is not None:
        least[images.frame_of[sure]] = (least[images.frame_of[sure]] + 1) // 2
    seen = images_of_few_points(points, images, least, fixed)
    images, points = _leave_out(seen >= 0, images, points)
    unsupported, shares = np.zeros(len(seen), dtype=np.bool_), ObservationShares(math.nan, math.nan)
    if source.has_database:
        posed = posed_part(images)
        if (seen >= 0).any():  # which were partners of others
            partners = _count(stand.read_links(posed, nobody), images, partners.anew(images))
        partners = _count(stand.read_links(posed, nobody, rejected=True), images, partners)
        counts = partners.compare(points)
        unsupported = images_without_support(counts, images, fixed)
        if options.trust.min_trust > 0.0:
            seen = np.where(unsupported, points.count_seen(len(seen)), seen)
            images, points = _leave_out(unsupported, images, points)
        shares = counts.shares(images.is_posed)
    seeded = Seeded(images, points, stand.gauge, fixed, adjusted, seen, unsupported, shares)
    if (adjusted is not None or (seen >= 0).any()) and stand.held is None:
        return _set_gauge(seeded, stand, stand.placement.cameras[kept])
    axes = stand.gauge.axes
    return seeded if axes is None else seeded.moved(turn_about_origin(axes), stand.gauge)


def _make_points(
    stand: Stand, kept: BoolArray, options: PlacingOptions, clock: Clock
) -> tuple[Images, Points, Estimate | None, PartnerCounts]:
    """Return the images with points, filtered, how bundle adjustment went, if asked for, and partners."""
    adjusted, advance = None, clock.advance
    images, num_keypoints = stand.place(kept), stand.source.view.num_keypoints
    limit_px = options.structure.max_reprojection_error_px
    posed = posed_part(images)
    adjusts = options.freedom.adjust == "full"
    with clock("structure"):
        links = stand.read_links(posed, advance)
    with clock("bundle adjustment" if adjusts else "triangulation"):
        if adjusts:  # which triangulates at the poses of the start itself
            freedom, given = stand.freedom.of(posed.frames, posed.lenses), stand.given_poses(posed)
            adjusted, points = adjust_seed(posed.images, links, options.structure, freedom, given)
            posed, images = posed._replace(images=adjusted.images), images.updated(adjusted.images)
        else:
            points = triangulate(posed.images, links, options.structure, advance)
        partners = _count(links, images, PartnerCounts(images, num_keypoints, limit_px, stand.source.fixed))
        del links
        points = filter_points(points, posed.images, stand.pictures(posed), options.structure)
    if adjusted is not None:
        assert points.errors_px is not None
        adjusted = replace(adjusted, final_error_px=float(points.errors_px.mean()))
    return images, replace(points, images=posed.rows[points.images]), adjusted, partners


def _count(links: Links, images: Images, partners: PartnerCounts) -> PartnerCounts:
    """Count matches between all posed ones of some images."""
    if isinstance(links, MatchedKeypoints):
        posed = posed_part(images)
        poses = views_of(posed.images).poses(posed.images)
        partners.add(links, replace(poses, images=posed.rows[poses.images]))
    return partners


def _leave_out(gone: BoolArray, images: Images, points: Points) -> tuple[Images, Points]:
    """Return the images without a pose of some (i,), and the points that the others see."""
    return images.without(gone), points.taken(points.paired(~gone[points.images]))


def _set_gauge(seeded: Seeded, stand: Stand, cameras: IntArray) -> Seeded:
    """Return an adjusted model in the gauge that was chosen, found anew for those of some cameras it has.

    The axes of the input are those in which the rotations agree best with the input's. What fixed cameras
    hold of the gauge is held already.
    """
    cameras = cameras[seeded.images.is_posed[cameras]]
    unit, fixed = None if stand.placement.unit is None else 1.0, seeded.fixed
    if fixed.any() and unit is not None:
        return seeded
    given, own = stand.source.images.rotations[cameras], seeded.images.rotations[cameras]
    turn = np.eye(3) if fixed.any() else mean_rotation_l1(given.transpose(0, 2, 1) @ own)
    found = stand.given.rule.choose(cameras, seeded.images.centers[cameras] @ turn.T, unit)
    axes = np.eye(3) if found.axes is None else found.axes
    scale, shift = found.similarity.scale, found.similarity.translation
    motion = Similarity(scale=scale, rotation=axes @ turn, translation=axes @ shift)
    before = seeded.gauge.similarity
    similarity = replace(
        before, scale=scale * before.scale, translation=scale * turn @ before.translation + shift
    )
    gauge = replace(found, similarity=similarity, statement=_state(seeded.gauge, found))
    return seeded.moved(motion, gauge)


def _state(before: Gauge, after: Gauge) -> str:
    """Return the statement of a gauge that was found again, with what pulled the cameras before."""
    _, mark, pulled = before.statement.partition(PULLED)
    return f"{after.statement}{mark}{pulled}"
