"""Rough rotations of any source, off by degrees and some of them by anything, made exact by the matches.

Directions need rotations known to tenths of a degree; the relative rotations of pairs do not. Near what rough
ones say of a pair its matches are fitted without a trial, and what fits is believed. Pairs that fit nothing
near it are false, unless most matches of a camera say so: that is turned, and its pairs are tried as `map`
tries all of them. Averaged, the rotations are as good as those of `map`, and go on as they do. Where the
first placement finds other lenses, a second one starts where it has turned the images.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import fit_similarity_l1, mean_rotation_l1
from sfm_shapefit.facts.options import LocateOptions
from sfm_shapefit.facts.result import LocateResult
from sfm_shapefit.facts.warnings import rotation_suspicions, rotation_warnings
from sfm_shapefit.pairs.essential import (
    concatenate_rotations,
    estimate_relative_rotations,
    have_many_pairs,
    refine_rough_rotations,
)
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pipeline.adjustment import turned_deg
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.pipeline.first_placement import start_from_first
from sfm_shapefit.pipeline.given import Given
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.pipeline.relative_rotations import estimate_here
from sfm_shapefit.pipeline.settle import settle
from sfm_shapefit.placement.gauge import coincide
from sfm_shapefit.rotations.average import average_relative_rotations
from sfm_shapefit.rotations.frames import relative_rotations_of_frames
from sfm_shapefit.scene.images import Images

_NEAR = 6.0  # standard deviations of an image that a pair may turn by; two images and three axes give 5.7
_LEAST_SHARE = 0.25
"""Share of the root-matches of an image's pairs that fit near its rotation; with less, it is turned."""


def settle_rough(
    given: Given, source: MatchSource, options: LocateOptions, clock: Clock, sigma_rad: float
) -> LocateResult:
    """Place images whose rotations are known to `sigma_rad` about each axis, but for gross errors."""
    rough, given = source.images, given._replace(pull_rad=np.inf)
    with clock("relative rotations"):
        relative, believed = measure_near(source, sigma_rad, clock)
    with clock("rotation averaging"):
        averaged = average_near(rough, relative.subset(believed), clock.threads)
    corrected = replace(source.at(averaged), alone=relative)
    start = partial(start_from_first, options=options, clock=clock, rotations_known=True)
    given, corrected, first = start(given, corrected, lenses_wanted=True)
    if corrected.images.differ_in_rays(rough):
        given, corrected, first = start(given, corrected)
    found = settle(given, corrected, options, clock, first)
    told = _tell_changes(found, rough, given.images)
    assert told.turned_deg is not None
    sigma_deg = float(np.degrees(sigma_rad))
    wrong = rotation_warnings(told.turned_deg, rough.names, sigma_deg)
    told = replace(told, suspicions=(*found.suspicions, *rotation_suspicions(told.turned_deg, sigma_deg)))
    further = tuple(_tell_changes(piece, rough, given.images) for piece in found.further)
    return replace(told, further=further, warnings=(*wrong, *found.warnings))


def _tell_changes(found: LocateResult, rough: Images, given: Images) -> LocateResult:
    """Return a piece with how far its images were turned and moved from where they were given."""
    there = np.isfinite(found.placed.centers).all(axis=1)
    common = mean_rotation_l1(rough.rotations[there].transpose(0, 2, 1) @ found.images.rotations[there])
    turned = np.where(there, turned_deg(rough.rotations @ common, found.images.rotations), np.nan)
    return replace(found, turned_deg=turned, moved=_moved(given.centers, found.placed.centers))


def _moved(given: FloatArray, placed: FloatArray) -> FloatArray | None:
    """Return how far centers (n, 3) are from the given ones; None if these are no places."""
    there = np.isfinite(placed).all(axis=1) & np.isfinite(given).all(axis=1)
    if coincide(given[there]):
        return None
    motion = fit_similarity_l1(given[there], placed[there])
    return np.asarray(np.linalg.norm(motion.apply(given) - placed, axis=1))


def measure_near(source: MatchSource, sigma_rad: float, clock: Clock) -> tuple[RelativeRotations, BoolArray]:
    """Return the relative rotations of pairs near rough ones, and which of them to believe.

    Pairs of turned images are those of trials.
    """
    rotations = source.images.rotations
    refined = _measure(
        source, clock, partial(refine_rough_rotations, rotations=rotations, sigma_rad=sigma_rad)
    )
    if not len(refined.pairs):
        return refined, np.zeros(0, dtype=np.bool_)
    fits = refined.are_sound() & (refined.residuals_deg(rotations) <= np.degrees(_NEAR * sigma_rad))
    turned = _turned(refined, fits, source.images.num_images)[refined.pairs].any(axis=1)
    kept = np.flatnonzero(~turned)
    tried = _measure(source, clock, without=refined.pairs[kept])
    both = concatenate_rotations([refined.subset(kept), tried])
    believed = np.append(fits[kept], np.ones(len(tried.pairs), dtype=np.bool_))
    order = np.lexsort(both.pairs.T[::-1])
    return both.subset(order), believed[order]


def _measure(
    source: MatchSource,
    clock: Clock,
    estimate: Callable[..., RelativeRotations] | None = None,
    without: IntArray | None = None,
) -> RelativeRotations:
    """Return the relative rotations of pairs, but for some of them; by trials, as `map` does, if None."""
    view = source.matches.at(source.images.apart(), source.inputs.left_out)
    are_many = have_many_pairs(view.images.num_images, view.num_pairs)
    estimate = estimate or partial(estimate_relative_rotations, are_many=are_many)
    return estimate_here(view, estimate, clock, without=without)


def average_near(rough: Images, relative: RelativeRotations, threads: int) -> Images:
    """Return images with averaged rotations, in the axes of the rough ones.

    Images that no pair ties to the largest component keep their own.
    """
    own, sensors = rough.frames.rotations, rough.sensors.rotations[rough.lens_of]
    of_frames = relative_rotations_of_frames(relative, rough.frame_of, sensors)
    if not len(of_frames.pairs):
        return rough
    averaged = average_relative_rotations(len(own), of_frames, threads)
    known = averaged.registered
    common = mean_rotation_l1(averaged.rotations[known].transpose(0, 2, 1) @ own[known])
    turned: FloatArray = np.where(known[:, None, None], averaged.rotations @ common, own)
    return rough.posed(turned, np.zeros_like(rough.frames.centers))


def _turned(refined: RelativeRotations, fits: BoolArray, num_images: int) -> BoolArray:
    """Return images (n,) hardly any of whose matches fit near their rotations."""
    votes = np.repeat(np.sqrt(refined.num_matches)[:, None], 2, axis=1)
    every = np.bincount(refined.pairs.ravel(), votes.ravel(), num_images)
    near = np.bincount(refined.pairs[fits].ravel(), votes[fits].ravel(), num_images)
    return np.asarray(near < _LEAST_SHARE * every)
