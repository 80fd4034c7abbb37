"""Which scale, origin and axes the output gets: as asked, or by what is known."""

from pathlib import Path

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray
from sfm_shapefit.colmap.model import PosedModel
from sfm_shapefit.colmap.priors import database_priors, table_priors
from sfm_shapefit.commands.stages.rigs import Rigid
from sfm_shapefit.errors import InputError, UnsolvableError
from sfm_shapefit.locate_options import LocateOptions
from sfm_shapefit.placement.gauge import (
    Gauge,
    PositionPriors,
    distance_gauge,
    input_gauge,
    metric_gauge,
    moved_gauge,
    prior_gauge,
    unit_gauge,
)
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.results.result import Inputs


def read_priors(
    model: PosedModel, inputs: Inputs, options: LocateOptions, table: Path | str | None
) -> PositionPriors | None:
    """Return the position priors of the model's images, if they are wanted.

    Raises:
        InputError: if they are wanted and there are none, or they can have no effect.
    """
    if options.scale not in ("auto", "prior") and table is not None:
        raise InputError(f"priors have no effect with the scale {options.scale}; leave out one of the two")
    if table is not None:
        return table_priors(Path(table), model)
    if options.scale != "prior":
        if options.refine_with_priors:
            raise InputError("refine_with_priors needs priors; give a table, or the scale prior")
        return None
    if inputs.database is None:
        raise InputError("the scale prior needs position priors; give a table with --priors, or a database")
    return database_priors(inputs.database, model)


def choose_gauge(
    model: PosedModel,
    placement: Placement,
    kept: BoolArray,
    rigid: Rigid,
    options: LocateOptions,
    priors: PositionPriors | None,
) -> Gauge:
    """Return scale, origin and axes of the output.

    Rigid groups know the scale. Else it is as asked: "auto" takes a known distance, else priors that are
    given, else the input. A single fixed camera moves only the origin. Only cameras that are `kept` count.

    Raises:
        InputError: if what is asked for is not determined.
        UnsolvableError: if the only fixed image is not placed.
    """
    cameras = placement.cameras[kept]
    locations, centers = placement.locations[kept], model.centers[cameras]
    fixed = rigid.fixed[cameras]
    if placement.unit is not None:
        return metric_gauge(locations, placement.unit, centers, fixed, has_rigs=model.has_rigs)
    if options.known_distance:
        gauge = _gauge_of_distance(model, cameras.tolist(), locations, options.known_distance)
    elif priors is not None:
        gauge = prior_gauge(locations, priors.of(cameras))
    else:
        gauge = unit_gauge(locations) if options.scale == "unit" else input_gauge(locations, centers)
    if not rigid.fixed.any():
        return gauge
    name = model.names[int(np.argmax(rigid.fixed))]
    if not fixed.any():
        raise UnsolvableError(f"{name} is to stay where it is, but the matches do not tie it to the others")
    return moved_gauge(gauge, locations[fixed][0], centers[fixed][0], name)


def _gauge_of_distance(
    model: PosedModel, cameras: list[int], locations: FloatArray, known: tuple[str, str, float]
) -> Gauge:
    """Return the gauge of the known distance of two cameras, by their names."""
    places = []
    for name in known[:2]:
        if name not in model.names:
            raise InputError(f"known_distance: the model has no posed image {name}")
        index = model.names.index(name)
        if index not in cameras:
            raise InputError(f"known_distance: the image {name} could not be placed; choose another")
        places.append(cameras.index(index))
    names = f"{known[0]} and {known[1]}"
    return distance_gauge(locations, places[0], places[1], float(known[2]), names)
