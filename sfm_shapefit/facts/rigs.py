"""Rigs after a refinement: how far each sensor turned and moved, and how sure that is."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np

from sfm_shapefit.adjustment.estimate import Estimate
from sfm_shapefit.adjustment.freedom import Freedom
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import rotation_angles_deg
from sfm_shapefit.base.record import Record
from sfm_shapefit.scene.images import Images, Sensors


class RefinedSensor(Record):
    """A sensor whose pose in its rig was refined."""

    camera: Annotated[int, "The id of its camera in the model."]
    turned_deg: Annotated[float, "Angle by which its rotation changed."]
    moved: Annotated[float, "How far it moved in its rig, in units of the output."]
    distance: Annotated[float, "Distance from the reference sensor, in units of the output."]
    turn_sigma_deg: Annotated[float, "Standard deviation of its rotation per axis, by the noise alone."]
    place_sigma: Annotated[float, "Standard deviation of its place per axis, by the noise alone."]

    @property
    def statement(self) -> str:
        """How far it turned and moved, and how sure that is."""
        return (
            f"camera {self.camera} turned by {self.turned_deg:.3g} deg (± {self.turn_sigma_deg:.2g}) and "
            f"moved by {self.moved:.3g} (± {self.place_sigma:.2g}), at {self.distance:.4g} from the "
            "reference sensor"
        )


def refined_rigs(
    given: Images, found: Images, freedom: Freedom, adjusted: Sequence[Estimate]
) -> tuple[RefinedSensor, ...]:
    """Return a row for each sensor that was refined, as sure as the last adjustment of it is.

    Args:
        given, found: the same images with their sensors before and after.
        freedom: what was to move.
        adjusted: what adjustments made of some of the images, one after the other.

    Raises:
        InputError: if sensors were to move, but none did.
    """
    rows, before, after = [], given.sensors, found.sensors
    sigmas = np.full((len(given.lenses), 2), np.nan)
    for done in adjusted:
        own = given.lenses_of(done.images)
        sigmas[own] = np.where(np.isnan(done.sensor_sigmas), sigmas[own], done.sensor_sigmas)
    if freedom.has_sensors and np.isnan(sigmas).all():
        raise InputError("there is nothing to adjust, so that rigs cannot be refined; leave out rigs=free")
    for k in np.flatnonzero(np.isfinite(sigmas[:, 0])).tolist():
        turn = before.rotations[k].T @ after.rotations[k]
        rows.append(
            RefinedSensor(
                camera=found.lenses[k].id,
                turned_deg=float(rotation_angles_deg(turn[None])[0]),
                moved=float(np.linalg.norm(sensor_centers(after)[k] - sensor_centers(before)[k])),
                distance=float(np.linalg.norm(sensor_centers(after)[k])),
                turn_sigma_deg=float(np.degrees(sigmas[k, 1])),
                place_sigma=float(sigmas[k, 0]),
            )
        )
    return tuple(rows)


def sensor_centers(sensors: Sensors) -> FloatArray:
    """Return where sensors stand in their rigs, (l, 3)."""
    return np.asarray(-np.einsum("lba,lb->la", sensors.rotations, sensors.translations))


def describe_rigs(rows: Sequence[RefinedSensor]) -> list[str]:
    """Return a sentence for each refined sensor, the one that changed most first."""
    return [row.statement for row in sorted(rows, key=lambda row: -row.turned_deg)]
