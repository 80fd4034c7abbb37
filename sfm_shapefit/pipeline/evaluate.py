"""`evaluate`: a model's poses against a reference."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sfm_shapefit.base.atomic_folder import MARKER
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.colmap.model import ModelSource, read_model
from sfm_shapefit.files.colmap.priors import enu_of, read_position_table
from sfm_shapefit.files.lines import text_of
from sfm_shapefit.scene.evaluation import (
    Evaluation,
    PositionEvaluation,
    evaluate_poses,
    evaluate_positions,
)
from sfm_shapefit.scene.given import Datum
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
        reconstruction, reference: results, reconstructions or model folders; cameras are matched by name.
        thresholds: position errors, in the reference's units, at which recall and its AUC are wanted too.
        trajectory: whether ATE and RPE are wanted, of the common images in the order of their names.

    Returns:
        `position` and `rotation_deg`, each with median, mean, rms and max, in the reference's units and in
        degrees; `relative_pose_aucs`, `recalls`, `trajectory`, the `worst()` cameras, `rows()` per camera,
        names of `missing` ones, and warnings.

    Raises:
        InputError: if a model cannot be read, or they have fewer than three cameras in common.
    """
    read = read_model(reconstruction).images, read_model(reference).images
    poses, truth = (NamedPoses(images.names, images.rotations, images.centers) for images in read)
    return evaluate_poses(poses, truth, thresholds, trajectory=trajectory)


def evaluate_against_table(model: Path | str, table: Path | str) -> PositionEvaluation:
    """Return position errors of a model against a table of known positions, such as GPS.

    Args:
        model: a model folder. Where its locate.json has a datum, latitudes and longitudes of the table become
            meters east, north and up of that, and are compared as they stand too.
        table: `name x y z` or, with a line that names the columns, name, latitude, longitude, altitude; see
            `files.colmap.priors.table_priors`.

    Raises:
        InputError: if either cannot be read, or they have fewer than three cameras in common.
    """
    posed, (rows, geodetic) = read_model(Path(model)), read_position_table(Path(table))
    positions = np.array([position for position, _ in rows.values()]).reshape(-1, 3)
    datum, statement = None, "positions as they stand, as if both had the same axes and units"
    if geodetic:
        datum = _datum_of(Path(model))
        statement = "meters east, north and up of the model's datum"
        if datum is None:
            statement = "meters; the model has no datum, so that only its shape is compared"
        try:
            positions = enu_of(positions, datum or Datum(*np.median(positions, axis=0).tolist()))
        except ValueError as error:
            raise InputError(f"{table}: {error}") from error
    known = (list(rows), positions)
    return evaluate_positions(
        (posed.images.names, posed.images.centers),
        known,
        statement,
        as_they_stand=datum is not None or not geodetic,
    )


def _datum_of(model: Path) -> Datum | None:
    """Return the datum that stands in locate.json beside a model, if any."""
    if not (model / MARKER).is_file():
        return None
    try:
        facts = json.loads(text_of(model / MARKER))
        found = facts.get("datum")
        return None if found is None else Datum(**found)
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{model / MARKER} cannot be read; run locate again, or remove it") from error
