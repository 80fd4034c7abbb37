"""What a refinement of rigs made of them: how far each sensor turned and moved, and how sure that is."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated

import numpy as np

from sfm_shapefit.adjustment.free_sensors import SensorSigma
from sfm_shapefit.base.geometry import rotation_angles_deg
from sfm_shapefit.base.record import Record

if TYPE_CHECKING:
    import pycolmap

    from sfm_shapefit.base.arrays import FloatArray


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
    given: "Mapping[int, pycolmap.Rigid3d]",
    found: "Mapping[int, pycolmap.Rigid3d]",
    sigmas: Mapping[int, SensorSigma],
) -> tuple[RefinedSensor, ...]:
    """Return a row for each sensor that was refined, by the ids of their cameras.

    Args:
        given, found: the sensors' poses before and after.
        sigmas: of the refined ones, which are those that have a row.
    """
    return tuple(
        _row(camera, given[camera], found[camera], sigma) for camera, sigma in sorted(sigmas.items())
    )


def _row(
    camera: int, given: "pycolmap.Rigid3d", found: "pycolmap.Rigid3d", sigma: SensorSigma
) -> RefinedSensor:
    turn = given.rotation.matrix().T @ found.rotation.matrix()
    before, after = (_center(pose) for pose in (given, found))
    return RefinedSensor(
        camera=camera,
        turned_deg=float(rotation_angles_deg(turn[None])[0]),
        moved=float(np.linalg.norm(after - before)),
        distance=float(np.linalg.norm(after)),
        turn_sigma_deg=float(np.degrees(sigma.turn_rad)),
        place_sigma=sigma.place,
    )


def _center(sensor_from_rig: "pycolmap.Rigid3d") -> "FloatArray":
    return np.asarray(-(sensor_from_rig.rotation.matrix().T @ sensor_from_rig.translation))


def describe_rigs(rows: Sequence[RefinedSensor]) -> list[str]:
    """Return a sentence for each refined sensor, the one that changed most first."""
    return [row.statement for row in sorted(rows, key=lambda row: -row.turned_deg)]
