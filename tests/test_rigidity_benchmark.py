"""scripts/benchmark.py rigidity: pieces counted, and limits judged."""

import sys
from dataclasses import replace

import numpy as np

from tests.scenes import ROOT

sys.path.insert(0, str(ROOT / "scripts"))  # as `python scripts/benchmark.py` does

from benchmarks import rigid


def test_pieces_and_single_pairs_are_told_apart():
    edges = np.array([[0, 1], [0, 2], [1, 2], [2, 3], [3, 4], [3, 5], [4, 5]])  # two triangles and a bridge
    found = rigid.search(6, edges)
    assert (found.cameras, found.pairs, found.pieces, found.single_pairs) == (6, 7, 2, 1)
    assert found.seconds > 0.0
    assert found.peak_mb > 1.0


def test_time_and_memory_are_judged_where_there_is_a_limit():
    fast = rigid.Search(cameras=9, pairs=8, pieces=1, single_pairs=0, seconds=0.1, cpu_s=0.1, peak_mb=900.0)
    large = replace(fast, peak_mb=1200.0)
    text = rigid.section(
        {"geo-10000": fast, "er-10000, few triangles": fast, "geo-100000": large, "seq-100000": fast},
        "- none\n",
    )
    verdicts = [
        line.rsplit("|", 2)[1].strip() for line in text.splitlines() if line[:4] in ("| ge", "| er", "| se")
    ]
    assert verdicts[:4] == ["met", "no target", "**missed**: peak 1200 > 1000", "met"]
