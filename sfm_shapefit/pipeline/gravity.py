"""Gravity in `map`: read first, a term of the averaging, and at the end what turns the model upright."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from sfm_shapefit.files.colmap.gravity import database_gravity, table_gravity
from sfm_shapefit.files.colmap.sqlite_file import DatabaseFile
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.pipeline.seed import Seeded, turn_about_origin
from sfm_shapefit.rotations.average import check_pairs
from sfm_shapefit.rotations.averaged import AveragedRotations
from sfm_shapefit.rotations.gravity import (
    FEWEST_GRAVITIES,
    down_of,
    judge_gravity,
    turn_upright,
    with_gravity,
)
from sfm_shapefit.rotations.options import GRAVITY_OF_DATABASE
from sfm_shapefit.scene.given import Gravity
from sfm_shapefit.scene.images import Images

_NAMED = 3


def read_gravity(file: DatabaseFile, images: Images, source: str) -> Gravity | None:
    """Return the gravities of images, if they are wanted.

    Raises:
        InputError: as the readers.
    """
    if not source:
        return None
    if source == GRAVITY_OF_DATABASE:
        return database_gravity(file, images)
    return table_gravity(Path(source), images)


def refine_with_gravity(
    averaged: AveragedRotations, relative: RelativeRotations, gravity: Gravity
) -> AveragedRotations:
    """Return averaged rotations of frames refined on their pairs and gravities together."""
    supports = relative.weight_shares * relative.num_matches
    given, _ = check_pairs(
        relative.pairs, relative.rotations, relative.information, supports, len(averaged.registered)
    )
    return with_gravity(averaged, given, gravity)


def turn_model_upright(seeded: Seeded, gravity: Gravity | None) -> tuple[Seeded, tuple[str, ...]]:
    """Return a model turned so that z points up, unless something else set its axes, and what to warn of."""
    if gravity is None:
        return seeded, ()
    images, members = seeded.images, np.flatnonzero(seeded.images.is_posed)
    rotations = images.rotations[members]
    own = gravity.among(members)
    if len(own.indices) < FEWEST_GRAVITIES:
        few = f"{len(own.indices)} of the placed images have a gravity, and two are needed"
        return seeded, (f"{few} to turn the model upright",)
    turn = turn_upright(down_of(rotations, own))
    off, wrong = judge_gravity(rotations @ turn.T, own)
    warnings = []
    if wrong.any():
        worst = np.flatnonzero(wrong)[np.argsort(-off[wrong], kind="stable")]
        names = [images.names[members[own.indices[k]]] for k in worst[:_NAMED].tolist()]
        warnings.append(
            f"the gravities of {len(worst)} of {len(wrong)} images contradict their rotations and have no "
            f"part: above all those of {', '.join(names)}, by up to {np.degrees(off[worst[0]]):.0f} deg"
        )
    if seeded.gauge.axes is not None:
        return seeded, tuple(warnings)
    statement = f"{seeded.gauge.statement}; z up by {int(np.sum(~wrong))} of {len(wrong)} gravities"
    gauge = replace(seeded.gauge, axes=turn, statement=statement)
    return seeded.moved(turn_about_origin(turn), gauge), tuple(warnings)
