"""Rigs whose sensors are elsewhere in them than the matches inside their frames say.

The direction from one sensor to another is the same in all frames, in axes of the rig. So pairs inside frames
that know theirs tell it together, and tell that sensors have two centers where they are said to have one. An
error of the lenses does so too, by much less than a degree of parallax.
"""

from collections.abc import Iterator

import numpy as np

from sfm_shapefit.base.geometry import angle_between_deg, normalized
from sfm_shapefit.judgement.evidence import OddImages
from sfm_shapefit.judgement.limits import ALIKE_DEG, FEWEST_ALIKE, KNOWN_DEG, RIVAL_SHARE
from sfm_shapefit.judgement.reasons import Kind
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.scene.images import Images

_ONE_CENTER = 1e-6  # share of the largest offset in any rig; shorter ones are rounding
_SHARED = "a rig whose sensors have one center, where matches inside a frame have {} degrees of parallax"
_ELSEWHERE = "a place in its rig that matches inside its frame contradict by {} degrees"


def find_contradicted_rigs(images: Images, directions: PairDirections) -> Iterator[OddImages]:
    """Yield the images of two sensors of a rig that are not where the rig has them, for each such two."""
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
            cameras = np.unique(directions.pairs[taken])
            told = directions.parallax_deg[taken].mean() if is_one else off
            names = images.names_of(cameras)
            sentence = _SHARED if is_one else _ELSEWHERE
            yield OddImages.of_values(Kind.INPUT, names, np.full(len(names), told), sentence)
