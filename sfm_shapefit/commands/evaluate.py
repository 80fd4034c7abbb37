"""`evaluate`: a model's poses against a reference."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sfm_shapefit.facts.tables import model_datum
from sfm_shapefit.files.colmap.listed_poses import is_list, read_by_itself
from sfm_shapefit.files.colmap.model import ModelSource
from sfm_shapefit.files.colmap.priors import in_meters, read_positions
from sfm_shapefit.files.listed_names import named_as
from sfm_shapefit.scene.evaluation import Evaluation, PositionEvaluation, evaluate_poses, evaluate_positions
from sfm_shapefit.scene.pose_errors import NamedPoses


def evaluate(
    reconstruction: ModelSource,
    reference: ModelSource,
    *,
    thresholds: Sequence[float] = (),
    trajectory: bool = False,
) -> Evaluation:
    """Return position and rotation errors of a model against a reference, after robust alignment.

    Args:
        reconstruction, reference: results, reconstructions, model folders, or files of other programs that
            `convert` reads; cameras are matched by name.
        thresholds: position errors, in the reference's units, at which recall and its AUC are wanted too.
        trajectory: whether ATE and RPE are wanted, of the common images in the order of their names.

    Returns:
        `position` and `rotation_deg`, each with median, mean, rms and max, in the reference's units and in
        degrees; `relative_pose_aucs`, `recalls`, `trajectory`, the `worst()` cameras, `rows()` per camera,
        names of `missing` ones, and warnings.

    Raises:
        InputError: if a model cannot be read, or they have fewer than three cameras in common.
    """
    read = read_by_itself(reconstruction), read_by_itself(reference)
    poses, truth = (NamedPoses(m.images.names, m.images.rotations, m.images.centers) for m in read)
    if isinstance(reconstruction, Path | str) and is_list(reconstruction):
        poses = poses._replace(names=named_as(Path(reconstruction), poses.names, truth.names))
    elif isinstance(reference, Path | str) and is_list(reference):
        truth = truth._replace(names=named_as(Path(reference), truth.names, poses.names))
    evaluation = evaluate_poses(poses, truth, thresholds, trajectory=trajectory)
    return replace(evaluation, warnings=(*read[0].notes, *read[1].notes, *evaluation.warnings))


def evaluate_against_table(model: Path | str, table: Path | str) -> PositionEvaluation:
    """Return position errors of a model against a table of known positions, such as GPS.

    Args:
        model: a model folder. Where its locate.json has a datum, latitudes and longitudes of the table become
            meters east, north and up of that, and are compared as they stand too.
        table: `name x y z`, or columns of names and positions under a line that names them, see
            `files.colmap.position_table`.

    Raises:
        InputError: if either cannot be read, or they have fewer than three cameras in common.
    """
    posed, read = read_by_itself(Path(model)), read_positions(Path(table))
    datum = model_datum(Path(model))
    known = in_meters(read, str(table), datum)
    is_geodetic = known.datum is not None and read.datum is None
    statement = "positions as they stand, as if both had the same axes and units"
    if is_geodetic:
        statement = "meters east, north and up of the model's datum"
        if datum is None:
            statement = "meters; the model has no datum, so that only its shape is compared"
    return evaluate_positions(
        (posed.images.names, posed.images.centers),
        (known.names, known.positions),
        "; ".join([statement, *known.notes]),
        as_they_stand=datum is not None or not is_geodetic,
    )
