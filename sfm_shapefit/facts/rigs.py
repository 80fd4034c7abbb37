"""What a refinement of rigs made of them: how far each sensor turned and moved, and how sure that is."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from sfm_shapefit.adjustment.free_sensors import SensorSigma
from sfm_shapefit.base.geometry import rotation_angles_deg
from sfm_shapefit.facts.json_types import RefinedSensor

if TYPE_CHECKING:
    import pycolmap

    from sfm_shapefit.base.arrays import FloatArray


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
    return {
        "camera": camera,
        "turned_deg": float(rotation_angles_deg(turn[None])[0]),
        "moved": float(np.linalg.norm(after - before)),
        "distance": float(np.linalg.norm(after)),
        "turn_sigma_deg": float(np.degrees(sigma.turn_rad)),
        "place_sigma": sigma.place,
    }


def _center(sensor_from_rig: "pycolmap.Rigid3d") -> "FloatArray":
    return np.asarray(-(sensor_from_rig.rotation.matrix().T @ sensor_from_rig.translation))


def describe_rigs(rows: Sequence[RefinedSensor]) -> list[str]:
    """Return a sentence for each refined sensor, the one that changed most first."""
    return [
        f"camera {row['camera']} turned by {row['turned_deg']:.3g} deg (+- {row['turn_sigma_deg']:.2g}) and "
        f"moved by {row['moved']:.3g} (+- {row['place_sigma']:.2g}), {row['distance']:.4g} from the reference"
        for row in sorted(rows, key=lambda row: -row["turned_deg"])
    ]
