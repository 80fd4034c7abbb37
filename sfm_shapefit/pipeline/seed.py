"""From placed cameras to cameras with points, adjusted if asked for, in their gauge."""

from dataclasses import replace

import numpy as np

from sfm_shapefit.adjustment.bundle_adjustment import adjust_seed
from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.run import begin
from sfm_shapefit.adjustment.sources import Links
from sfm_shapefit.adjustment.structure import triangulate
from sfm_shapefit.adjustment.views import views_of
from sfm_shapefit.base.arrays import BoolArray, hand_back_memory
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.executors import nobody
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.judgement.support import (
    EvidenceShares,
    PartnerCounts,
    Support,
    images_of_few_points,
    images_without_support,
)
from sfm_shapefit.pipeline.state import ModelState
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points
from sfm_shapefit.scene.structure import Structure
from sfm_shapefit.tracks.filter import filter_points
from sfm_shapefit.tracks.links import MatchedKeypoints

_FEWEST_KEPT = 3  # trusted cameras; fewer are no result, so that all are kept then


def select_trusted(placement: Judged, min_trust: float) -> BoolArray:
    """Return which of the placed cameras are trusted enough; all, if hardly any is."""
    kept: BoolArray = placement.assessment.trust >= min_trust
    return kept if np.sum(kept) >= _FEWEST_KEPT else np.ones_like(kept)


def seed_points(state: ModelState, clock: Clock, confirmed: BoolArray | None = None) -> ModelState:
    """Move the kept cameras, triangulate points, and adjust both if asked for.

    Bundle adjustment is free to scale, shift and turn everything; the gauge is set after it. Half of the
    points suffice for images (i,) that are `confirmed` by the pixels.
    """
    source, options, fixed = state.source, state.inputs.options, state.inputs.fixed_frames
    threads = clock.threads
    images, points, bundle, partners = _make_points(state, clock)
    hand_back_memory()  # the links are gone
    least = np.full(len(fixed), options.structure.min_points_per_image)
    if confirmed is not None:
        least[images.frame_of[confirmed]] = (least[images.frame_of[confirmed]] + 1) // 2
    seen = images_of_few_points(points, images, least, fixed)
    images, points = _leave_out(seen >= 0, images, points)
    unsupported, shares = np.zeros(len(seen), dtype=np.bool_), EvidenceShares()
    if source.has_database:
        if (seen >= 0).any():  # which were partners of others
            partners = _count(
                state.read_links(images, nobody, threads), images, partners.anew(images), threads
            )
        partners = _count(state.read_links(images, nobody, threads, rejected=True), images, partners, threads)
        counts = partners.compare(points)
        unsupported = images_without_support(counts, images, fixed)
        if options.trust.min_trust > 0.0:
            seen = np.where(unsupported, points.count_seen(len(seen)), seen)
            images, points = _leave_out(unsupported, images, points)
        shares = counts.shares(images.is_posed)
    support = Support(seen, unsupported, shares)
    return replace(state, images=images, points=points, support=support, bundle=bundle)


def _make_points(state: ModelState, clock: Clock) -> tuple[Images, Points, Estimate | None, PartnerCounts]:
    """Return the images with points, filtered, how bundle adjustment went, if asked for, and partners."""
    bundle, options, view = None, state.inputs.options, state.source.view
    images, limit_px = state.placed(state.kept), options.structure.max_reprojection_error_px
    rows = images.posed_rows
    adjusts = options.freedom.adjust == "full"
    with clock("structure"):
        links = state.read_links(images, clock.advance, clock.threads)
    with clock("bundle adjustment" if adjusts else "triangulation"):
        posed = images.part(rows)
        if adjusts:  # which triangulates at the poses of the start itself
            freedom, given = state.freedom_of(rows), state.given_poses(rows)
            run = begin(posed, links, options.structure, freedom, given, state.crew_of(clock))
            bundle, points = adjust_seed(run)
            posed, images = bundle.images, images.updated(bundle.images)
        else:
            points = triangulate(posed, links, options.structure, clock.advance, clock.threads)
        counts = PartnerCounts(images, view.num_keypoints, limit_px, state.source.fixed)
        partners = _count(links, images, counts, clock.threads)
        del links
        hand_back_memory()
        points = filter_points(
            Structure(points, posed, state.pictures(images, rows)), options.structure, clock.threads
        )
    if bundle is not None:
        assert points.errors_px is not None
        final = replace(bundle.solves, final_error_px=float(points.errors_px.mean()))
        bundle = replace(bundle, solves=final)
    return images, replace(points, images=rows[points.images]), bundle, partners


def _count(links: Links, images: Images, partners: PartnerCounts, threads: int) -> PartnerCounts:
    if isinstance(links, MatchedKeypoints):
        rows = images.posed_rows
        posed = images.part(rows)
        poses = views_of(posed).poses(posed)
        partners.add(links, replace(poses, images=rows[poses.images]), threads)
    return partners


def _leave_out(gone: BoolArray, images: Images, points: Points) -> tuple[Images, Points]:
    """Return the images without a pose of some (i,), and the points that the others see."""
    return images.without(gone), points.taken(points.paired(~gone[points.images]))
