"""scripts/benchmark.py onedsfm: its table, and that it is skipped without the scene."""

import math
import sys

from tests.scenes import ROOT

sys.path.insert(0, str(ROOT / "scripts"))

import benchmark
from benchmarks import onedsfm

from sfm_shapefit.refinement.options import PlacementOptions


def test_without_the_scene_the_benchmark_says_so_and_writes_nothing(tmp_path, capsys):
    out = tmp_path / "results.md"
    assert benchmark.main(["onedsfm", "--data", str(tmp_path), "--out", str(out)]) == 0
    assert "skipped: 1dsfm-Madrid_Metropolis not found" in capsys.readouterr().err
    assert not out.exists()


def test_every_run_has_options_that_exist():
    for given in onedsfm.RUNS.values():
        PlacementOptions(**given)


def test_the_table_tells_certified_answers_from_others():
    values = {"num_placed": 9, "num_dropped": 1, "wall_s": 2.0, "cpu_s": 1.0, "solve_s": 0.5, "beyond": 0.25}
    runs = [
        onedsfm.Outcome(name=name, gap=gap, quartiles_deg=(1.0, 2.0, 3.0), **values)
        for name, gap in (("default", 1e-9), ("least-squares", math.nan))
    ]
    text = onedsfm.section("9 cameras.", runs, "- Command: none\n")
    assert "| default | 9 | 1 | 2.00 (1.00) | 0.500 | 1.0e-09 | 1.00 / 2.00 / 3.00; 25% |" in text
    assert "| least-squares | 9 | 1 | 2.00 (1.00) | 0.500 | - |" in text
    assert "ShapeKick 1.2" in text
