"""Evidence for tests: how many matches support pairs, and which pairs contradict the given rotations."""

import numpy as np

from sfm_shapefit.measured import Evidence


def make_evidence(num_pairs, support=100, against=(), against_support=50, errors=None):
    """Return the evidence of pairs of a support each, and of pairs against the rotations."""
    against = np.array(against, dtype=np.int64).reshape(-1, 2)
    return Evidence(
        support=np.full(num_pairs, support),
        contradicting=against,
        contradicting_support=np.full(len(against), against_support),
        errors=errors,
    )
