"""From averaged rotations to adjusted ones: a first placement, and its adjustment on few covering tracks.

Averaged rotations are a few hundredths of a degree off, wrong ones by much more. The cameras are placed with
them all the same, then rotations, centers and points are adjusted together. What comes out is far finer:
directions, verdicts and trust are measured anew from it.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment.bundle_adjustment import adjust_thinly
from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import mean_rotation_l1
from sfm_shapefit.facts.options import PlacingOptions
from sfm_shapefit.pipeline.clock import Clock
from sfm_shapefit.pipeline.given import Given
from sfm_shapefit.pipeline.inputs import MatchSource
from sfm_shapefit.pipeline.measure import Wanted, build_graph, measure, wants_points
from sfm_shapefit.pipeline.rigs import find_rigid_parts, may_be_checked, place_by_checked, place_cameras
from sfm_shapefit.pipeline.stand import Stand, posed_part
from sfm_shapefit.placement.place import Near


class FirstPlacement(NamedTuple):
    """What comes out of the adjustment of a first placement."""

    adjusted: Estimate
    """Where an adjustment has the images that were placed, in any scale and from any origin."""
    rotations: FloatArray
    """(n, 3, 3) cam_from_world. Images that the first placement lacks keep their averaged rotations, turned
    as the others were on average."""
    near: Near
    """Where the images stand."""


def adjust_first_placement(
    given: Given,
    source: MatchSource,
    options: PlacingOptions,
    clock: Clock,
    *,
    lenses_wanted: bool = False,
    rotations_known: bool = False,
) -> FirstPlacement:
    """Place the images of a source by their averaged rotations, and adjust all on few tracks.

    Nothing that is known of them sets a scale here but rigs; `lenses_wanted` and `rotations_known` as in
    `adjust_thinly`.

    Raises:
        UnsolvableError: if no camera can be placed, or nothing can be triangulated.
    """
    images, is_free = source.images, not given.rigid.has_scale  # offsets do what points do
    wanted = Wanted(tracks=wants_points(source, options.nodes), checked=is_free)
    measured = measure(source, options.directions, clock, wanted)
    build = partial(build_graph, images, measured, options.nodes)
    graph, directions = given.rigid.apply(build()), measured.directions
    place = partial(
        place_cameras, options=options.placement, nodes=options.nodes, clock=clock, certified=False
    )
    placement = next(place(graph))
    if measured.checks and may_be_checked(graph):
        better = place_by_checked(placement, partial(build, checked=True), place)
        placement = placement if better is None else better[1]
    del graph, build, measured  # arrays of all pairs
    stand = Stand.of(given, source, directions, placement, options)
    posed = posed_part(stand.place())
    links = partial(stand.read_links, posed, clock.advance)
    freedom = stand.freedom.of(posed.frames, posed.lenses)
    adjusted = adjust_thinly(
        *(posed.images, links, options.structure, freedom),
        lenses_wanted=lenses_wanted,
        rotations_known=rotations_known,
    )
    rotations, centers = images.rotations.copy(), np.full((images.num_images, 3), np.nan)
    rotations[posed.rows], centers[posed.rows] = adjusted.images.rotations, adjusted.images.centers
    # Images without a place keep their averaged rotations, in the axes that the others have now.
    there = np.isfinite(centers).all(axis=1)
    common = mean_rotation_l1(images.rotations[there].transpose(0, 2, 1) @ rotations[there])
    rotations[~there] = images.rotations[~there] @ common
    return FirstPlacement(adjusted, rotations, Near(centers, placement.refined))


def start_from_first(
    given: Given,
    source: MatchSource,
    options: PlacingOptions,
    clock: Clock,
    *,
    lenses_wanted: bool = False,
    rotations_known: bool = False,
) -> tuple[Given, MatchSource, FirstPlacement]:
    """Return what is known of images, and their matches, with the rotations and lenses of a first placement.

    Args and errors as of `adjust_first_placement`.
    """
    with clock("first placement"):
        first = adjust_first_placement(
            *(given, source, options, clock), lenses_wanted=lenses_wanted, rotations_known=rotations_known
        )
    images, adjusted = source.images, first.adjusted
    intrinsics = given.intrinsics.after(adjusted, images.lenses_of(adjusted.images))
    images = images.with_lenses_of(adjusted.images, adjusted.is_tried)
    if adjusted.refines_sensors:
        images = images.with_sensors_of(adjusted.images)
    source = source.at(images.turned_to(first.rotations))
    rigid = find_rigid_parts(source.images)
    return given._replace(rigid=rigid, intrinsics=intrinsics), source, first
