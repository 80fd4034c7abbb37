"""Standard deviations from pairs that share keypoints."""

import numpy as np
import pytest

import sfm_shapefit
from sfm_shapefit.pipeline import measure
from tests.scenes import COURTYARD, RING


@pytest.mark.parametrize(
    ("folder", "limit"),
    [(RING / "sparse" / "0", "_MAX_SAMPLED_PAIRS"), (COURTYARD / "truth", "_MOST_PAIRS")],
)
def test_independent_pairs_count_what_their_tracks_say_once(folder, limit, monkeypatch):
    database = (RING if folder.is_relative_to(RING) else COURTYARD) / "database.db"

    def sizes():
        found = sfm_shapefit.locate(folder, database, adjust="none")
        return np.linalg.norm([row.sigma for row in found.cameras if row.placed], axis=1)

    sampled = sizes()
    monkeypatch.setattr(measure, limit, 0)
    counted = sizes()
    assert 0.75 < np.median(counted / sampled) < 1.25
    assert (counted != sampled).all()
