"""The benchmark beside peers: its limits, its one table, and its quick mode."""

import math
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from tests.scenes import ROOT, real_scene

sys.path.insert(0, str(ROOT / "scripts"))

import benchmark
from benchmarks import graph_peers, peers, real_peers
from benchmarks.kept import KeptAnswers
from benchmarks.real import Errors
from benchmarks.real_peers import BY_DEFAULT, MAPPING, POSITIONING, SAME_DIRECTIONS, Row, checks


def errors(median, mean, missing=0):
    return Errors(median=median, mean=mean, max=9.0, num_missing=missing)


def rows(ours, peer):
    return [
        Row(name=SAME_DIRECTIONS, errors=errors(0.1, 0.1)),
        Row(name=BY_DEFAULT, errors=ours, peak_mb=512.4),
        Row(name=f"{POSITIONING}, all", errors=peer, seconds=1.0),
        Row(name=f"{MAPPING}, all", errors=errors(0.01, 0.01)),
        Row(name="another", note="failed: no answer"),
    ]


def test_ours_must_not_be_worse_than_the_best_peer_beyond_what_the_truth_can_tell():
    assert all(check.met for check in checks(rows(errors(1.04, 2.0), errors(1.0, 2.0))))
    median, mean = checks(rows(errors(1.06, 2.0), errors(1.0, 2.0)))
    assert not median.met
    assert mean.met


def test_answers_of_an_interrupted_comparison_are_kept_and_not_asked_again(tmp_path):
    file, asked = tmp_path / "kept.json", []

    def ask(median):
        asked.append(median)
        return Row(name="ours", errors=errors(median, 2.0), cpu_s=0.25)

    first = KeptAnswers(file, {"limit": 1})
    first.get("one", lambda: ask(1.0))
    again = KeptAnswers(file, {"limit": 1})
    assert "one" in again
    assert "two" not in again
    row = peers._row(again.get("one", lambda: ask(3.0)))
    assert row.errors == errors(1.0, 2.0)
    assert row.cpu_s == 0.25
    assert math.isnan(row.seconds)  # unknown stays unknown
    assert asked == [1.0]
    assert len(again.loads) == 1
    with pytest.raises(ValueError, match="other settings; delete it or give another --cache"):
        KeptAnswers(file, {"limit": 2})


def test_without_peers_there_is_no_limit():
    assert checks(rows(errors(1.0, 1.0), None)) == []


def test_the_table_has_error_time_and_memory_and_says_why_there_is_no_answer():
    graph = graph_peers.Compared(
        name="er2-9",
        num_cameras=9,
        num_edges=20,
        answers=(
            graph_peers.Answer(name="ours", ours=True, error=1e-3, seconds=0.5, cpu_s=0.4, peak_mb=300.0),
            graph_peers.Answer(name="gtsam", ours=False, note="skipped: gtsam is not installed"),
        ),
    )
    text = peers.section(
        [graph], {"castle-P30": rows(errors(1.0, 2.0, 3), errors(1.0, 2.0))}, "- Command: none\n", 9.0
    )
    assert "| er2-9 (20 pairs) | ours | 0.00100 | 0.500 (0.400) | 300 |  |" in text
    assert "| er2-9 (20 pairs) | gtsam | - | - | - | skipped: gtsam is not installed |" in text
    assert "1.00 / 2.00 / 9.00 (3 missing) | - | 512 |" in text
    assert "failed: no answer" in text
    assert "**2 of 2 limits met**" in text


def test_a_peer_of_scenes_that_is_not_installed_is_skipped_with_a_sentence(monkeypatch):
    monkeypatch.setattr(real_peers, "find_spec", lambda _package: None)
    row = real_peers.answer("pytheia LUD", Path(), None, "no directions", 1)
    assert row.note == "skipped: pytheia is not installed"


def test_a_set_without_directions_is_a_failure_of_the_peers_that_need_them(monkeypatch):
    monkeypatch.setattr(real_peers, "find_spec", lambda _package: object())
    row = real_peers.answer("gtsam with Huber", Path(), None, "the model is broken", 1)
    assert row.note == "failed: the model is broken"


def test_peers_see_the_cameras_of_the_model_by_name(monkeypatch):
    folder = real_scene("fountain-P11")
    edges = np.array([[0, 1], [1, 2], [2, 0]])
    directions = real_peers.Directions(np.array([4, 2, 7]), edges, np.eye(3), np.ones(3))
    contender = graph_peers.Contender(
        name="fixed", prepare=lambda _: lambda: (np.arange(9.0).reshape(3, 3), "done"), package="x"
    )
    monkeypatch.setattr(real_peers, "GRAPH_CONTENDERS", (contender,))
    found = real_peers._solved("fixed", directions, folder)
    assert found.names == ("0004.jpg", "0002.jpg", "0007.jpg")
    assert found.peak_mb > 10.0


@pytest.mark.slow
def test_the_quick_mode_writes_the_section_with_a_row_per_contender(tmp_path, capsys):
    assert benchmark.main(["peers", "--quick", "--out", str(tmp_path / "results.md")]) == 0
    text = (tmp_path / "results.md").read_text()
    assert text.count("\n| er2-20 (") == len(graph_peers.CONTENDERS)
    for package in ("pytheia", "gtsam"):
        assert (f"skipped: {package} is not installed" in text) == (find_spec(package) is None)
    assert "failed" not in text
    assert str(ROOT) not in text


@pytest.mark.slow
def test_a_real_scene_is_measured_with_ours_and_with_pycolmap():
    folder = real_scene("Herz-Jesus-P8")
    scene = peers.SCENES[folder.name]
    positioning = next(name for name in real_peers.contenders() if name.startswith(POSITIONING))
    for name, limit in ((BY_DEFAULT, 0.005), (positioning, 0.1)):
        row = real_peers.answer(name, folder, scene, "none", 200)
        assert row.errors is not None, row.note
        assert row.errors.median < limit
        assert row.seconds > 0.0
        assert row.peak_mb > 100.0
