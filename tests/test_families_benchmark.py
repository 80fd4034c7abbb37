"""scripts/benchmark.py graphs: the oracle, the limits, and what is said of them."""

import argparse
import dataclasses
import sys

import numpy as np
import pytest

from tests.scenes import ROOT

sys.path.insert(0, str(ROOT / "scripts"))  # as `python scripts/benchmark.py` does

import benchmark
from benchmarks import families
from benchmarks.graphs import GraphSpec, relative_error

CHAIN = families.Problem(spec=GraphSpec(family="seqv", n=60, degree=16.0, sigma=0.01), over_oracle=1.3)


def test_the_oracle_is_where_the_sum_of_squares_is_stationary():
    one = families.drawn(CHAIN, 0)
    t = families.oracle(one)
    right = one.right > 0.0
    edges, v = one.graph.edges[right], one.graph.directions[right]

    def cost(x):
        d = x[edges[:, 0]] - x[edges[:, 1]]
        return np.sum((d / np.linalg.norm(d, axis=1)[:, None] - v) ** 2)

    rng = np.random.default_rng(0)
    for _ in range(5):
        shift = 1e-4 * rng.standard_normal(t.shape)
        # At a minimum both ways lead up; elsewhere the linear part, of either sign, is the larger one.
        assert cost(t + shift) > cost(t) < cost(t - shift)
    assert relative_error(t, one.truth) > 1e-4  # and it has left the truth


def test_a_node_with_one_right_direction_does_not_stop_the_oracle():
    one = families.drawn(CHAIN, 1)
    ends = np.flatnonzero((one.graph.edges == 7).any(axis=1))
    right = one.right.copy()
    right[ends[1:]] = 0.0
    t = families.oracle(dataclasses.replace(one, right=right))
    np.testing.assert_array_equal(t[7], one.truth[7])


def test_a_trial_of_each_kind_is_measured():
    trial = families.measure(CHAIN, 0)
    assert trial.placed == pytest.approx(trial.over_oracle * trial.oracle)
    assert trial.over_oracle < 2.0
    assert trial.kept <= 60
    street = families.Problem(spec=GraphSpec(family="street", n=30), error=0.1)
    assert families.measure(street, 0).placed < 0.1


def trial(**changes):
    values = dict.fromkeys(("shapefit", "lud", "placed", "oracle"), 0.01)
    values |= {"over_oracle": 1.0, "mean_over_median": 1.2, "kept": 9, "seconds": 1.0}
    return families.Trial(**(values | changes))


def test_medians_are_checked_and_the_worst_mean_over_median():
    problem = dataclasses.replace(CHAIN, below_lud=True, seconds=2.0, error=0.05)
    trials = [trial(), trial(over_oracle=9.0, placed=9.0, seconds=9.0), trial()]
    assert all(check.met for check in families.checks(problem, trials))
    trials[1] = trial(mean_over_median=3.1)
    assert [check.name for check in families.checks(problem, trials) if not check.met] == ["mean / median"]
    worse = [trial(placed=0.06, over_oracle=1.4, seconds=3.0)] * 3
    assert [check.met for check in families.checks(problem, worse)] == [False, False, False, False, True]


def test_problems_are_chosen_by_the_beginning_of_their_names():
    assert families.problems("seq-300") == ["seq-300 exact, q 0.1", "seq-300"]
    with pytest.raises(argparse.ArgumentTypeError, match="unknown problem x; known: er2-100"):
        families.problems("er2,x")


def test_the_command_writes_its_section_and_skips_madrid_without_data(tmp_path, monkeypatch, capsys):
    madrid = families.PROBLEMS["Madrid, q 0.3 on few"]
    monkeypatch.setattr(families, "PROBLEMS", {"small": CHAIN, "Madrid": madrid})
    arguments = ["graphs", "--problems", "small,Madrid", "--seeds", "1", "--data", str(tmp_path)]
    assert benchmark.main([*arguments, "--out", str(tmp_path / "results.md")]) == 0
    assert "Madrid: skipped" in capsys.readouterr().err
    text = (tmp_path / "results.md").read_text()
    assert "| small |" in text
    assert "<!-- end graphs -->" in text
