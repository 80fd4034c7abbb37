"""Which scale, origin and axes the output gets: as asked, or by what is known."""

from pathlib import Path

from sfm_shapefit.arrays import BoolArray
from sfm_shapefit.colmap.model import PosedModel
from sfm_shapefit.colmap.priors import database_priors, table_priors
from sfm_shapefit.errors import InputError
from sfm_shapefit.options import LocateOptions
from sfm_shapefit.placement.gauge import (
    Gauge,
    PositionPriors,
    distance_gauge,
    input_gauge,
    prior_gauge,
    unit_gauge,
)
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.results import Inputs


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


def chosen_gauge(
    model: PosedModel,
    placement: Placement,
    kept: BoolArray,
    options: LocateOptions,
    priors: PositionPriors | None,
) -> Gauge:
    """Return the gauge asked for; "auto" takes a known distance, else priors that are given, else the input.

    Raises:
        InputError: if what is asked for is not determined.
    """
    cameras, locations = placement.cameras[kept], placement.locations[kept]
    if options.known_distance:
        return _known_distance(model, placement, kept, options.known_distance)
    if priors is not None:
        return prior_gauge(locations, priors.of(cameras))
    if options.scale == "unit":
        return unit_gauge(locations)
    return input_gauge(locations, model.centers[cameras])


def _known_distance(
    model: PosedModel, placement: Placement, kept: BoolArray, known: tuple[str, str, float]
) -> Gauge:
    """Return the gauge of the known distance of two cameras, by their names."""
    cameras = placement.cameras[kept].tolist()
    places = []
    for name in known[:2]:
        if name not in model.names:
            raise InputError(f"known_distance: the model has no posed image {name}")
        index = model.names.index(name)
        if index not in cameras:
            raise InputError(f"known_distance: the image {name} could not be placed; choose another")
        places.append(cameras.index(index))
    names = f"{known[0]} and {known[1]}"
    return distance_gauge(placement.locations[kept], places[0], places[1], float(known[2]), names)
