"""The benchmark of what the weights of pairs are worth."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from tests.scenes import ROOT

sys.path.insert(0, str(ROOT / "scripts"))  # as `python scripts/benchmark.py` does

from benchmarks import weights

GOOD = weights.Errors(shapefit=(0.1, 0.2), placed=(0.03, 0.04))
BAD = weights.Errors(shapefit=(0.2, 0.4), placed=(0.03, 0.06))
HELPED = weights.Comparison(name="castle-P30", equal=BAD, weighted=GOOD)


def test_gains_are_those_of_the_mean_errors_and_judged_over_all_sets():
    assert HELPED.gains == pytest.approx((2.0, 1.5))
    harmed = replace(HELPED, name="ring, made 0", equal=GOOD, weighted=BAD)
    text = weights.section([HELPED, replace(harmed, weighted=GOOD)])
    assert "Gain of what is placed, all sets, geometric mean: 1.22, met." in text
    assert "Gain of ShapeFit, real sets, geometric mean: 2.00, met." in text
    missed = weights.section([harmed])
    assert "all sets, geometric mean: 0.667, **missed**: gain 0.667 < 1.00." in missed
    assert "Gain of ShapeFit, real sets: none is there." in missed


def test_a_made_scene_is_placed_with_either_weights():
    found = weights.comparison_of_made("cloud", 0)
    errors = np.array(
        [found.equal.shapefit, found.equal.placed, found.weighted.shapefit, found.weighted.placed]
    )
    assert errors.max() < 1e-3  # half a pixel of 1000, cameras some metres apart, about twenty pairs each
    assert found.equal != found.weighted
