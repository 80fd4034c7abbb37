"""States to begin from: rotations as they are given, rough ones corrected, averaged ones made finer.

Directions need rotations known to tenths of a degree. Averaged ones are a few hundredths off, wrong ones by
much more: the cameras are placed with them all the same, then rotations, centers and points are adjusted
together on few covering tracks. What comes out is far finer; directions, verdicts and trust are measured anew
from it.

Rough rotations, off by degrees and some of them by anything, are corrected by the relative rotations of
pairs. Near what rough ones say of a pair its matches are fitted without a trial, and what fits is believed.
Pairs that fit nothing near it are false, unless most matches of a camera say so: the camera is turned, and
its pairs are tried as `map` tries all of them. Averaged, the rotations are as good as those of `map`, and go
on as they do. Where the first placement finds other lenses, a second one starts where it has turned the
images.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from sfm_shapefit.adjustment.bundle_adjustment import adjust_thinly
from sfm_shapefit.adjustment.run import begin
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.clock import Clock
from sfm_shapefit.base.geometry import mean_rotation_l1
from sfm_shapefit.pairs.essential import (
    concatenate_rotations,
    estimate_relative_rotations,
    have_many_pairs,
    refine_rough_rotations,
)
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pipeline.inputs import MatchSource, RunInputs
from sfm_shapefit.pipeline.measure import MeasureRequest, measure, wants_points
from sfm_shapefit.pipeline.placing import PlacingSetup, place_first
from sfm_shapefit.pipeline.state import ModelState
from sfm_shapefit.placement.fixed_and_rigged import find_fixed_and_rigged
from sfm_shapefit.scene.images import Images

_NEAR = 6.0  # standard deviations of an image that a pair may turn by; two images and three axes give 5.7
_LEAST_SHARE = 0.25
"""Share of the root-matches of an image's pairs that fit near its rotation; with less, it is turned."""


def begin_model(inputs: RunInputs, source: MatchSource, clock: Clock) -> ModelState:
    """Return the state that directions are measured from.

    UnsolvableError: if a first placement is needed and no camera can be placed, or nothing triangulated.
    """
    state = ModelState.of(inputs, source)
    if inputs.rough_rad is not None:
        return _correct_rotations(state, inputs.rough_rad, clock)
    if inputs.is_component and inputs.options.freedom.adjust != "none":
        first = adjust_first_placement(replace(state, inputs=inputs.without_positions()), clock)
        return replace(first, inputs=inputs)
    return state


def adjust_first_placement(
    state: ModelState, clock: Clock, *, lenses_wanted: bool = False, rotations_known: bool = False
) -> ModelState:
    """Place the images of a state by their rotations, adjust all on few tracks, and go on from there.

    Images that get no place keep their rotations, turned as the others are on average; `lenses_wanted` and
    `rotations_known` as in `adjust_thinly`.

    Raises:
        UnsolvableError: if no camera can be placed, or nothing can be triangulated.
    """
    source, options, images = state.source, state.inputs.options, state.source.images
    with clock("first placement"):
        is_free = not state.rigid.has_scale  # offsets do what points do
        wanted = MeasureRequest(tracks=wants_points(source, options.nodes), checked=is_free)
        measured = measure(source, options.directions, clock, wanted)
        setup = PlacingSetup(images, options.placement, options.nodes, clock)
        placement = place_first(setup, state.rigid, measured)
        directions = replace(measured, tracks=None)
        del measured  # arrays of all pairs
        placed = replace(state, measured=directions, placement=placement).framed()
        start = placed.placed()
        rows = start.posed_rows
        adjusted = adjust_thinly(
            begin(
                start.part(rows),
                placed.read_links(start, clock.advance, clock.threads),
                options.structure,
                placed.freedom_of(rows),
                crew=placed.crew_of(clock),
            ),
            lenses_wanted=lenses_wanted,
            rotations_known=rotations_known,
        )
    rotations, centers = images.rotations.copy(), np.full((images.num_images, 3), np.nan)
    rotations[rows], centers[rows] = adjusted.images.rotations, adjusted.images.centers
    known = np.isfinite(centers).all(axis=1)
    common = mean_rotation_l1(images.rotations[known].transpose(0, 2, 1) @ rotations[known])
    rotations[~known] = images.rotations[~known] @ common
    intrinsics = state.intrinsics.after(adjusted, images.lenses_of(adjusted.images))
    images = images.with_lenses_of(adjusted.images, adjusted.is_tried)
    if adjusted.refines_sensors:
        images = images.with_sensors_of(adjusted.images)
    source = source.at(images.turned_to(rotations))
    return replace(
        state,
        source=source,
        rigid=find_fixed_and_rigged(source.images),
        intrinsics=intrinsics,
        near=replace(placement.refined, locations=centers),
        first=adjusted,
    )


def _correct_rotations(state: ModelState, sigma_rad: float, clock: Clock) -> ModelState:
    """Return a state with exact rotations for those known to `sigma_rad` about each axis, but for some."""
    rough = state.source.images
    with clock("relative rotations"):
        relative, believed = measure_near(state.source, sigma_rad, clock)
    with clock("rotation averaging"):
        averaged = average_near(rough, relative.subset(believed), clock.threads)
    corrected = replace(state, source=replace(state.source.at(averaged), alone=relative))
    first = adjust_first_placement(corrected, clock, lenses_wanted=True, rotations_known=True)
    if first.source.images.differ_in_rays(rough):
        first = adjust_first_placement(first, clock, rotations_known=True)
    return first


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
    from sfm_shapefit.pipeline.relative_rotations import estimate_here  # here: few rotations are rough

    view = source.matches.at(source.images.apart(), source.inputs.left_out)
    are_many = have_many_pairs(view.images.num_images, view.num_pairs)
    estimate = estimate or partial(estimate_relative_rotations, are_many=are_many)
    return estimate_here(view, estimate, clock, without=without)


def average_near(rough: Images, relative: RelativeRotations, threads: int) -> Images:
    """Return images with averaged rotations, in the axes of the rough ones.

    Images that no pair ties to the largest component keep their own.
    """
    from sfm_shapefit.rotations.average import average_relative_rotations  # here: few rotations are rough
    from sfm_shapefit.rotations.frames import relative_rotations_of_frames

    given, sensors = rough.frames.rotations, rough.sensors.rotations[rough.lens_of]
    of_frames = relative_rotations_of_frames(relative, rough.frame_of, sensors)
    if not len(of_frames.pairs):
        return rough
    averaged = average_relative_rotations(len(given), of_frames, threads)
    known = averaged.registered
    common = mean_rotation_l1(averaged.rotations[known].transpose(0, 2, 1) @ given[known])
    turned: FloatArray = np.where(known[:, None, None], averaged.rotations @ common, given)
    return rough.posed(turned, np.zeros_like(rough.frames.centers))


def _turned(refined: RelativeRotations, fits: BoolArray, num_images: int) -> BoolArray:
    """Return images (n,) hardly any of whose matches fit near their rotations."""
    votes = np.repeat(np.sqrt(refined.num_matches)[:, None], 2, axis=1)
    every = np.bincount(refined.pairs.ravel(), votes.ravel(), num_images)
    near = np.bincount(refined.pairs[fits].ravel(), votes[fits].ravel(), num_images)
    return np.asarray(near < _LEAST_SHARE * every)
