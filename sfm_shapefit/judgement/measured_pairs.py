"""What one pass over the matches yields: directions of pairs, and what joins and weighs them."""

from dataclasses import dataclass

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.pairs.pair_directions import PairDirections
from sfm_shapefit.tracks.node_tracks import TrackJoiner


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredPairs:
    """What one pass over the matches yields."""

    directions: PairDirections
    """Directions of all pairs, usable or not."""
    tracks: TrackJoiner | None = None
    """Joins keypoints to points seen by three cameras or more, which may become nodes; None without."""
    checks: bool = False
    """Whether the tracks are known, and wanted, that hold together without any single match of theirs."""
    errors: list[FloatArray] | None = None
    """Samples of the errors of usable directions, (m, NUM_SAMPLES, 2) in parts, since directions that share
    keypoints err together. None where directions count as independent."""
    facts_per_match: float = 1.0
    """See `Evidence`."""
