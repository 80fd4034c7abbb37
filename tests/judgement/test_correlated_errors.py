"""Standard deviations from pairs that share keypoints."""

import numpy as np
import pytest

import sfm_shapefit
from sfm_shapefit.pipeline import measure
from tests.scenes import RING


@pytest.mark.parametrize("limit", ["_MAX_SAMPLED_PAIRS", "_MOST_PAIRS"])
def test_independent_pairs_count_what_their_tracks_say_once(limit, monkeypatch):
    def sizes():
        found = sfm_shapefit.locate(RING / "sparse" / "0", adjust="none")
        return np.linalg.norm([row.sigma for row in found.cameras if row.placed], axis=1)

    sampled = sizes()
    monkeypatch.setattr(measure, limit, 0)
    counted = sizes()
    assert 0.75 < np.median(counted / sampled) < 1.25
    assert (counted != sampled).all()
