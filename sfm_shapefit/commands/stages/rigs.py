"""Rigs and fixed cameras in `locate`: which images form rigid groups, and how these are placed.

The frames of a model with rigs are groups with metric offsets. Cameras that are fixed stand where the input
has them: two or more are one group, whose offsets are their centres; of a single one only the origin can be
taken.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfm_shapefit.arrays import BoolArray
from sfm_shapefit.colmap.model import PosedModel
from sfm_shapefit.commands.stages.clock import Clock
from sfm_shapefit.commands.stages.measure import without_points
from sfm_shapefit.directions.tracks import JointGraph
from sfm_shapefit.errors import InputError, UnsolvableError
from sfm_shapefit.formats import refuse_irregular_file
from sfm_shapefit.judgement.trust import Evidence
from sfm_shapefit.options import FIX_SOLVED, LocateOptions
from sfm_shapefit.placement.gauge import Gauge, metric_gauge, moved_gauge
from sfm_shapefit.placement.place import Placement, place
from sfm_shapefit.placement.rigs import is_scaled, place_groups
from sfm_shapefit.solver.rigs import largest_tied
from sfm_shapefit.solver.rigs.groups import RigidGroups, separate

_COINCIDENT = 1e-9  # extent of the fixed centres, of their distance from the origin, that counts as none


class Rigid(NamedTuple):
    """What of a model is rigid."""

    fixed: BoolArray
    """(n,) images that stay exactly where the input has them."""
    groups: RigidGroups | None
    """The images in groups; None where each moves by itself."""
    held: int | None
    """The group of the fixed images."""


def rigid_parts(model: PosedModel, options: LocateOptions, *, has_priors: bool) -> Rigid:
    """Return what moves together and what not at all.

    Args:
        model: the input.
        options: which images are fixed, and the scale asked for.
        has_priors: whether position priors are to set scale and axes.

    Raises:
        InputError: if a name to be fixed is unknown, the fixed images stand at one place, or another scale is
            asked for than rigs or fixed images have.
    """
    fixed = _fixed_images(model, options.fix)
    count = int(np.sum(fixed))
    if options.scale == "rig" and not model.has_rigs:
        raise InputError("the model has no rig of several cameras to take the scale from; use another scale")
    if options.refine_rotations and model.has_rigs:
        raise InputError("the cameras of a frame turn as one, not one by one; leave out refine_rotations")
    if options.refine_rotations and count:
        raise InputError("fixed cameras keep their rotations; leave out refine_rotations")
    if count and has_priors:
        raise InputError(
            "fixed cameras stay in the axes of the input, priors turn them; leave out one of these"
        )
    if not model.has_rigs and count < 2:
        return Rigid(fixed, None, None)
    if options.scale not in ("auto", "input", "rig") or options.known_distance or has_priors:
        source = "rigs" if model.has_rigs else "fixed cameras"
        raise InputError(
            f"the scale is that of the {source}; leave out other scales, known distances and priors"
        )
    if not options.solves_shapefit or options.filter != "none":
        raise InputError(
            "rigs and fixed cameras go with the objectives auto, shapefit and lud, without a filter"
        )
    groups = model.groups if model.has_rigs else separate(model.num_images, 3)
    if count == 0:
        return Rigid(fixed, groups, None)
    centers = model.centers[fixed]
    extent = float(np.ptp(centers, axis=0).max())
    if count > 1 and extent <= _COINCIDENT * max(1.0, float(np.abs(centers).max())) and not model.has_rigs:
        raise InputError(
            f"the {count} fixed cameras stand at one place in the input; fix others, whose positions it has"
        )
    return Rigid(fixed, groups.with_fixed(fixed, model.centers), 0)


def rigs_statement(model: PosedModel, joint: JointGraph) -> str:
    """Say how many frames a model has, and how many of them the pairs tie to one another."""
    if not model.has_rigs:
        return "none: every image is a frame of its own"
    groups = model.groups.with_separate(joint.num_points)
    frames = f"{model.groups.num_groups} frames of {model.num_images} images"
    if not is_scaled(groups, joint.graph.edges):
        return f"{frames}; no pair sees two cameras of a frame that stand apart, so their scale is open"
    sizes = np.bincount(groups.group_of[: model.num_images], minlength=groups.num_groups)
    tied = int(np.sum(sizes[largest_tied(joint.graph.edges, groups, sizes)] > 0))
    return f"{frames}, of which the pairs tie {tied} in metric scale; the pieces below take images one by one"


def placed(
    joint: JointGraph,
    rigid: Rigid,
    evidence: Evidence,
    options: LocateOptions,
    clock: Clock,
) -> Placement:
    """Place the view graph, over groups where there are any.

    Offsets do what 3D points do otherwise, and rays to far points let the convex starts collapse. So points
    take part with groups only if they are wanted always, or if cameras hang loose without them.
    """
    if rigid.groups is None:
        k = joint.num_cameras
        return place(joint.graph, options, joint.covariance, evidence, k, clock.iteration)
    first = None
    if options.points != "always":
        try:
            first = _placed_groups(*_without_points(joint, evidence), rigid, options)
        except UnsolvableError:
            if joint.num_points == 0:
                raise
    if joint.num_points == 0 or (first is not None and not first.assessment.loose_groups):
        assert first is not None or options.points == "always"
        return first or _placed_groups(joint, evidence, rigid, options)
    second = _placed_groups(joint, evidence, rigid, options)
    return second if first is None or _num_held(second) > _num_held(first) else first


def _placed_groups(joint: JointGraph, evidence: Evidence, rigid: Rigid, options: LocateOptions) -> Placement:
    """Place groups, and points that each are one."""
    assert rigid.groups is not None
    return place_groups(
        joint.graph,
        rigid.groups.with_separate(joint.num_points),
        options,
        joint.covariance,
        evidence,
        joint.num_cameras,
        rigid.held,
    )


def _without_points(joint: JointGraph, evidence: Evidence) -> tuple[JointGraph, Evidence]:
    """Return the pairs of cameras alone; they stand before the rays."""
    k = joint.num_cameras
    rows = np.flatnonzero((joint.graph.edges < k).all(axis=1))
    return without_points(joint), evidence.restricted_to(rows, np.arange(k), joint.graph.num_nodes)


def _num_held(placement: Placement) -> int:
    """Return how many cameras are placed and not loose."""
    loose = sum(len(group.cameras) for group in placement.assessment.loose_groups)
    return len(placement.cameras) - loose


def rigid_gauge(
    model: PosedModel, placement: Placement, rigid: Rigid, kept: BoolArray, otherwise: Callable[[], Gauge]
) -> Gauge:
    """Return scale and origin of the output where groups or a fixed camera decide them.

    Args:
        model: the input.
        placement: its solution.
        rigid: what of it is rigid.
        kept: which of the placement's cameras are in the output.
        otherwise: chooses where no group knows the scale; a single fixed camera then moves only the origin.

    Raises:
        UnsolvableError: if the only fixed image is not placed.
    """
    cameras = placement.cameras[kept]
    locations, centers = placement.locations[kept], model.centers[cameras]
    still = rigid.fixed[cameras]
    if placement.unit is not None:
        return metric_gauge(locations, placement.unit, centers, still, has_rigs=model.has_rigs)
    gauge = otherwise()
    if not rigid.fixed.any():
        return gauge
    name = model.names[int(np.argmax(rigid.fixed))]
    if not still.any():
        raise UnsolvableError(f"{name} is to stay where it is, but the matches do not tie it to the others")
    return moved_gauge(gauge, locations[still][0], centers[still][0], name)


def _fixed_images(model: PosedModel, fix: str) -> BoolArray:
    """Return which images are to stay where they are."""
    if not fix:
        return np.zeros(model.num_images, dtype=np.bool_)
    if fix == FIX_SOLVED:
        images = [model.reconstruction.image(i) for i in model.image_ids.tolist()]
        solved = np.array([image.num_points3D > 0 for image in images], dtype=np.bool_)
        if not solved.any():
            raise InputError(
                "no image of the model observes a 3D point, so none is solved; name those to fix"
            )
        return solved
    path, index = Path(fix), {name: k for k, name in enumerate(model.names)}
    refuse_irregular_file(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path} cannot be read; give a text file with the name of one image per line"
        ) from error
    fixed = np.zeros(model.num_images, dtype=np.bool_)
    for number, line in enumerate(lines, start=1):
        name = line.strip()
        if not name or name.startswith("#"):
            continue
        if name not in index:
            raise InputError(f"{path}, line {number}: the model has no posed image {name!r}")
        fixed[index[name]] = True
    if not fixed.any():
        raise InputError(f"{path} names no image; give the name of one image per line")
    return fixed
