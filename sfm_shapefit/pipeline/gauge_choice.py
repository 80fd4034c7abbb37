"""Which scale, origin and axes the output gets: as asked, or by what is known."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import mean_rotation_l1
from sfm_shapefit.facts.options import KnownDistance, LocateOptions
from sfm_shapefit.files.colmap.model import PosedModel
from sfm_shapefit.files.colmap.priors import database_priors, exif_priors, table_priors
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.pipeline.rigs import Rigid
from sfm_shapefit.placement.gauge import (
    Gauge,
    coincide,
    distance_gauge,
    input_gauge,
    metric_gauge,
    moved_gauge,
    prior_gauge,
    unit_gauge,
)
from sfm_shapefit.scene.given import PositionPriors


def read_priors(
    model: PosedModel, file: DatabaseFile | None, options: LocateOptions, table: Path | str | None
) -> PositionPriors | None:
    """Return the position priors of the model's images, if they are wanted.

    Raises:
        InputError: if they are wanted and there are none, or they can have no effect.
    """
    if options.scale not in ("auto", "prior") and table is not None:
        raise InputError(f"priors have no effect with the scale {options.scale}; leave out one of the two")
    if options.control_points and table is not None:
        raise InputError(
            "control points and position priors would both set the scale; leave out one of the two"
        )
    if options.known_distance and (table is not None or options.refine_with_priors):
        raise InputError(
            "known distances and position priors would both set the scale; leave out one of the two"
        )
    if table is not None:
        return exif_priors(Path(table), model) if Path(table).is_dir() else table_priors(Path(table), model)
    if options.scale != "prior":
        if options.refine_with_priors:
            raise InputError("refine_with_priors needs priors; give a table, or the scale prior")
        return None
    if file is None:
        raise InputError("the scale prior needs position priors; give a table with --priors, or a database")
    return database_priors(file, model)


class GaugeRule(NamedTuple):
    """What sets scale, origin and axes of the output: as asked, or by what is known."""

    model: PosedModel
    rigid: Rigid
    options: LocateOptions
    priors: PositionPriors | None

    def choose(self, cameras: IntArray, locations: FloatArray, unit: float | None) -> Gauge:
        """Return the gauge of cameras that were found.

        Rigid groups know the scale. Else it is as asked: "auto" takes a known distance, else priors that are
        given, else the input. A single fixed camera moves only the origin.

        Args:
            cameras: (k,) those in the output, ascending.
            locations: (k, 3) where they are, in axes of the input.
            unit: length of the unit of rigid groups in the locations' units; None without such groups.

        Raises:
            InputError: if what is asked for is not determined.
            UnsolvableError: if the only fixed image is not among the cameras.
        """
        model, rigid, options = self.model, self.rigid, self.options
        centers, fixed = model.centers[cameras], rigid.fixed[cameras]
        has_centers = not coincide(model.centers - model.frame_offsets)
        if not has_centers:
            centers = np.zeros_like(centers)  # where sensors are in their rig says nothing of positions
        if unit is not None:
            return metric_gauge(locations, unit, centers, fixed, has_rigs=model.has_rigs)
        if options.known_distance:
            for name in (name for one in options.known_distance for name in one[:2]):
                if name not in model.names:
                    raise InputError(f"known_distance: the model has no posed image {name}")
            names = [model.names[camera] for camera in cameras.tolist()]
            gauge = gauge_of_distances(names, locations, options.known_distance)
        elif self.priors is not None:
            gauge = prior_gauge(locations, self.priors.of(cameras), axes_known=has_centers)
        else:
            gauge = unit_gauge(locations) if options.scale == "unit" else input_gauge(locations, centers)
        if not rigid.fixed.any():
            return gauge
        name = model.names[int(np.argmax(rigid.fixed))]
        if not fixed.any():
            raise UnsolvableError(
                f"{name} is to stay where it is, but the matches do not tie it to the others"
            )
        return moved_gauge(gauge, locations[fixed][0], centers[fixed][0], name)


def restore_axes(model: PosedModel, cameras: IntArray, rotations: FloatArray) -> FloatArray:
    """Return the turn of the world (3, 3) that brings adjusted rotations closest to the input's on average.

    Args:
        model: the input.
        cameras: (k,) of its images.
        rotations: (k, 3, 3) of them, cam_from_world.
    """
    return mean_rotation_l1(model.rotations[cameras].transpose(0, 2, 1) @ rotations)


def gauge_of_distances(names: Sequence[str], locations: FloatArray, known: Sequence[KnownDistance]) -> Gauge:
    """Return the gauge of known distances of cameras, by their names; those that are not there say nothing.

    Raises:
        InputError: if the cameras of a distance coincide.
        UnsolvableError: if of each distance an image is not among the cameras.
    """
    place_of = {name: place for place, name in enumerate(names)}
    there = [one for one in known if {*one[:2]} <= place_of.keys()]
    if not there:
        missing = next(name for name in known[0][:2] if name not in place_of)
        raise UnsolvableError(f"known_distance: the image {missing} could not be placed; choose another")
    places = np.array([[place_of[first], place_of[second]] for first, second, _ in there])
    said = [f"{first} and {second}" for first, second, _ in there]
    return distance_gauge(locations, places, np.array([float(distance) for *_, distance in there]), said)
