"""The benchmark of real scenes beside peers: its limits and its table."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

from benchmarks import real_peers
from benchmarks.real import Errors
from benchmarks.real_peers import BY_DEFAULT, SAME_DIRECTIONS, Row, checks, section

SHARED = Path(__file__).parents[1].parent / "shared" / "data"


def errors(median, mean, missing=0):
    return Errors(median=median, mean=mean, max=9.0, num_missing=missing)


def rows(ours, peer):
    return [
        Row(name=SAME_DIRECTIONS, errors=errors(0.1, 0.1)),
        Row(name=BY_DEFAULT, errors=ours),
        Row(name="a peer", errors=peer, seconds=1.0),
        Row(name="another", note="failed: no answer"),
    ]


def test_ours_must_not_be_worse_than_the_best_peer_beyond_what_the_truth_can_tell():
    assert all(check.met for check in checks(rows(errors(1.04, 2.0), errors(1.0, 2.0))))
    median, mean = checks(rows(errors(1.06, 2.0), errors(1.0, 2.0)))
    assert not median.met
    assert mean.met


def test_without_peers_there_is_no_limit():
    assert checks(rows(errors(1.0, 1.0), None)) == []


def test_the_table_says_who_is_missing_and_why_there_is_no_answer():
    text = section({"castle-P30": rows(errors(1.0, 2.0, 3), errors(1.0, 2.0))}, "- Command: none\n")
    assert "1.00 / 2.00 / 9.00 (3 missing)" in text
    assert "failed: no answer" in text
    assert "**2 of 2 limits met**" in text


@pytest.mark.slow
def test_a_real_scene_is_measured_with_ours():
    folder = SHARED / "Herz-Jesus-P8"
    if not folder.is_dir():
        pytest.skip("the real scenes are not there")
    found, seconds, _ = real_peers.measure(BY_DEFAULT, folder, real_peers.SCENES["Herz-Jesus-P8"])
    assert found.median < 0.005
    assert seconds > 0.0
