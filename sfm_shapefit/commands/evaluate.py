"""`evaluate`: a model's poses against a reference."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sfm_shapefit.colmap.model import read_model
from sfm_shapefit.evaluation import CameraPoses, Evaluation, evaluate_poses

if TYPE_CHECKING:
    import pycolmap


def evaluate(
    reconstruction: "pycolmap.Reconstruction | Path | str",
    reference: "pycolmap.Reconstruction | Path | str",
    *,
    thresholds: Sequence[float] = (),
    trajectory: bool = False,
) -> Evaluation:
    """Return position and rotation errors of a model against a reference, after robust alignment.

    Args:
        reconstruction, reference: reconstructions or model folders; cameras are matched by name.
        thresholds: position errors, in the reference's units, at which recall and its AUC are wanted too.
        trajectory: whether ATE and RPE are wanted, of the common images in the order of their names.

    Returns:
        `position` and `rotation_deg`, each with median, mean, rms and max, in the reference's units and in
        degrees; `relative_pose_aucs`, `recalls`, `trajectory`, the `worst()` cameras, `rows()` per camera,
        names of `missing` ones, and warnings.

    Raises:
        InputError: if a model cannot be read, or they have fewer than three cameras in common.
    """
    models = read_model(reconstruction), read_model(reference)
    poses, truth = (CameraPoses(model.names, model.rotations, model.centers) for model in models)
    return evaluate_poses(poses, truth, thresholds, trajectory=trajectory)
