"""What a refinement of rigs made of them: how far each sensor turned and moved, and how sure that is."""

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np

from sfm_shapefit.adjustment.free_sensors import SensorSigma
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import rotation_angles_deg
from sfm_shapefit.base.record import Record
from sfm_shapefit.scene.images import Images, Sensors


class RefinedSensor(Record):
    """A sensor whose pose in its rig was refined."""

    camera: Annotated[int, "The id of its camera in the model."]
    turned_deg: Annotated[float, "By how much its rotation changed."]
    moved: Annotated[float, "How far it moved in its rig, in units of the output."]
    distance: Annotated[float, "From the reference sensor, in units of the output."]
    turn_sigma_deg: Annotated[float, "Standard deviation of its rotation per axis, by the noise alone."]
    place_sigma: Annotated[float, "Standard deviation of its place per axis, by the noise alone."]

    @property
    def statement(self) -> str:
        """How far it turned and moved, and how sure that is."""
        return (
            f"camera {self.camera} turned by {self.turned_deg:.3g} deg (+- {self.turn_sigma_deg:.2g}) and "
            f"moved by {self.moved:.3g} (+- {self.place_sigma:.2g}), {self.distance:.4g} from the reference"
        )


def refined_rigs(
    given: Images, found: Images, sigmas: Mapping[int, SensorSigma]
) -> tuple[RefinedSensor, ...]:
    """Return a row for each sensor that was refined, by the ids of their cameras.

    Args:
        given, found: the same images with their sensors before and after.
        sigmas: standard deviations of the refined sensors, which are those that have a row.
    """
    rows = []
    for k, lens in enumerate(found.lenses):
        if lens.id in sigmas:
            before, after = (images.sensors for images in (given, found))
            moved = sensor_centers(after)[k] - sensor_centers(before)[k]
            turn = before.rotations[k].T @ after.rotations[k]
            rows.append(
                RefinedSensor(
                    camera=lens.id,
                    turned_deg=float(rotation_angles_deg(turn[None])[0]),
                    moved=float(np.linalg.norm(moved)),
                    distance=float(np.linalg.norm(sensor_centers(after)[k])),
                    turn_sigma_deg=float(np.degrees(sigmas[lens.id].turn_rad)),
                    place_sigma=sigmas[lens.id].place,
                )
            )
    return tuple(rows)


def sensor_centers(sensors: Sensors) -> FloatArray:
    """Return where sensors stand in their rigs, (l, 3)."""
    return np.asarray(-np.einsum("lba,lb->la", sensors.rotations, sensors.translations))


def describe_rigs(rows: Sequence[RefinedSensor]) -> list[str]:
    """Return a sentence for each refined sensor, the one that changed most first."""
    return [row.statement for row in sorted(rows, key=lambda row: -row.turned_deg)]
