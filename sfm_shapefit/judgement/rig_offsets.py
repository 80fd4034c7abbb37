"""Rigs whose sensors are elsewhere in them than the matches inside their frames say.

The direction from one sensor to another is the same in all frames, in axes of the rig. So pairs inside frames
that know theirs tell it together, and tell that sensors have two centers where they are said to have one. An
error of the lenses does so too, by much less than a degree of parallax.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, distinct
from sfm_shapefit.base.geometry import angle_between_deg, mean_rotation_l1, normalized, rotation_angles_deg
from sfm_shapefit.base.wording import first_of
from sfm_shapefit.judgement.evidence import OddImages
from sfm_shapefit.judgement.limits import ALIKE_DEG, FEWEST_ALIKE, KNOWN_DEG, RIVAL_SHARE
from sfm_shapefit.judgement.reasons import Kind
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import FOCAL

_ONE_CENTER = 1e-6  # share of the largest offset in any rig; shorter ones are rounding
_SHARED = "a rig whose sensors have one center, where matches inside a frame have {} degrees of parallax"
_ELSEWHERE = "a place in its rig that matches inside its frame contradict by {} degrees"


class _Contradiction(NamedTuple):
    """Two sensors of a rig that are not where the rig has them."""

    lenses: tuple[int, int]
    measured: FloatArray
    """(3,) unit direction to the first from the second, in axes of the rig, by the matches inside frames."""
    stated: FloatArray
    """(3,) the same as the rig has it, with its length; about 0 where they are said to have one center."""
    is_one: bool
    """Whether they are."""
    told_deg: float
    """Angle between the two directions, or parallax inside frames where the rig has one center."""
    cameras: IntArray
    """(k,) images that say so."""


def find_contradicted_rigs(images: Images, directions: PairDirections) -> Iterator[OddImages]:
    """Yield the images of two sensors of a rig that are not where the rig has them, for each such two."""
    for one in _find_contradictions(images, directions):
        names, sentence = images.names_of(one.cameras), _SHARED if one.is_one else _ELSEWHERE
        yield OddImages.of_values(Kind.INPUT, names, np.full(len(names), one.told_deg), sentence)


def measured_offsets(images: Images, directions: PairDirections) -> FloatArray:
    """Return the translations (l, 3) of sensors_from_rig, contradicted ones in the measured directions.

    Their lengths are those of the rig. A sensor that shares no matches with the reference stays.
    """
    sensors, translations = images.sensors, images.sensors.translations.copy()
    for one in _find_contradictions(images, directions):
        offset = np.linalg.norm(one.stated) * one.measured
        for (lens, other), center in zip((one.lenses, one.lenses[::-1]), (offset, -offset), strict=True):
            if sensors.is_reference[other] and not one.is_one:
                translations[lens] = -sensors.rotations[lens] @ center
    return translations


def turn_sensors(images: Images, relative: RelativeRotations) -> tuple[Images, str]:
    """Turn sensors in their rigs as matches inside frames do that contradict these; and say which, a clause.

    A sensor turns about its own center. One that shares no matches with the reference stays.
    """
    sensors = images.sensors
    rotations = _measure_turns(images, relative)
    turns = rotations @ sensors.rotations.transpose(0, 2, 1)
    turned = np.flatnonzero((rotations != sensors.rotations).any(axis=(1, 2))).tolist()
    if not turned:
        return images, ""
    told = [f"camera {images.lenses[k].id} by {rotation_angles_deg(turns[k]):.0f} degrees" for k in turned]
    clause = f"matches inside frames turn {first_of(told)} from where the rig has it, and are followed"
    return images.with_sensors(rotations, np.einsum("lab,lb->la", turns, sensors.translations)), clause


def _measure_turns(images: Images, relative: RelativeRotations) -> FloatArray:
    """Return the rotations (l, 3, 3) of sensors_from_rig, contradicted ones as matches inside frames say.

    An angle is known as well as the focal length of the lens that it is seen through.
    """
    sensors, rotations = images.sensors, images.sensors.rotations.copy()
    focal_sigmas = [lens.sigmas[FOCAL] for lens in images.lenses if lens.sigmas]
    inside = np.flatnonzero((np.ptp(images.frame_of[relative.pairs], axis=1) == 0) & relative.are_sound())
    lenses = images.lens_of[relative.pairs[inside]]
    for side in (0, 1):
        is_asked = sensors.is_reference[lenses[:, side]] & ~sensors.is_reference[lenses[:, 1 - side]]
        for lens in distinct(lenses[is_asked, 1 - side]).tolist():
            rows = inside[is_asked & (lenses[:, 1 - side] == lens)]
            turns = relative.rotations[rows] if side == 0 else relative.rotations[rows].transpose(0, 2, 1)
            mean, given = mean_rotation_l1(turns), sensors.rotations[lens]
            alike = rotation_angles_deg(turns.transpose(0, 2, 1) @ mean) <= ALIKE_DEG
            limit = ALIKE_DEG + max(focal_sigmas, default=0.0) * rotation_angles_deg(given)
            is_known = alike.sum() >= max(FEWEST_ALIKE, RIVAL_SHARE * len(rows))
            if is_known and rotation_angles_deg(given.T @ mean) > limit:
                rotations[lens] = mean
    return rotations


def _find_contradictions(images: Images, directions: PairDirections) -> Iterator[_Contradiction]:
    inside = np.flatnonzero(np.ptp(images.frame_of[directions.pairs], axis=1) == 0)
    pairs = directions.pairs[inside]
    lenses, which = np.unique(images.lens_of[pairs], axis=0, return_inverse=True)
    rig_from_world = (
        images.sensors.rotations[images.lens_of[pairs[:, 0]]].transpose(0, 2, 1)
        @ images.rotations[pairs[:, 0]]
    )
    measured = np.einsum("kab,kb->ka", rig_from_world, directions.directions[inside])
    known = (directions.sigma_deg()[inside] <= KNOWN_DEG) & (directions.parallax_deg[inside] >= KNOWN_DEG)
    places = -np.einsum("lba,lb->la", images.sensors.rotations, images.sensors.translations)
    longest = np.linalg.norm(places, axis=1).max(initial=0.0)
    for k, (first, second) in enumerate(lenses.tolist()):
        rows = np.flatnonzero(known & (which == k))
        if len(rows) < max(FEWEST_ALIKE, RIVAL_SHARE * np.count_nonzero(which == k)):
            continue
        mean, stated = normalized(measured[rows].mean(axis=0)), places[first] - places[second]
        alike = angle_between_deg(measured[rows], np.broadcast_to(mean, (len(rows), 3))) <= ALIKE_DEG
        off = angle_between_deg(mean, normalized(stated))
        is_one = np.linalg.norm(stated) <= _ONE_CENTER * longest
        if np.mean(alike) > RIVAL_SHARE and (is_one or off > ALIKE_DEG):
            taken = inside[rows[alike]]
            told = float(directions.parallax_deg[taken].mean() if is_one else off)
            cameras = np.unique(directions.pairs[taken])
            yield _Contradiction((first, second), mean, stated, bool(is_one), told, cameras)
