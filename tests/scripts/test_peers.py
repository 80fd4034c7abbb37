"""What we are compared with: pycolmap's mappings, Clarabel, pytheia and gtsam, and the limits of the race."""

import math
from pathlib import Path

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from benchmarks import solver
from benchmarks.real import SCENES, Errors
from harness.graphs import GraphSpec, draw, relative_error
from paper import colmap_peer as colmap
from paper import peers_on_graphs as on_graphs
from paper import peers_on_scenes as on_scenes
from paper.cone_solvers import solve_cvxpy, solve_direct
from paper.peers_on_scenes import BY_DEFAULT, POSITIONING, SAME_DIRECTIONS, Answer, checks
from sfm_shapefit import certify
from sfm_shapefit.files.colmap.quiet import quiet_log
from tests.scenes import RING, fingerprint, real_scene
from tests.scripts.test_benchmarks import call_here

SMALL = GraphSpec(family="er2", n=14, sigma=0.02, q=0.1)


def test_tracks_need_three_images_and_one_place_in_each():
    image_of = np.array([0, 0, 0, 1, 1, 1, 2, 2, 2])
    xy = np.array([[0, 0], [50, 0], [99, 0], [0, 0], [8, 0], [50, 0], [0, 0], [50, 0], [99, 0]], float)
    near = np.array([[0, 3], [0, 4], [3, 6]])  # image 1 twice, 8 px apart: one of them stays
    far = np.array([[1, 5], [5, 7], [7, 2]])  # image 0 twice, 49 px apart: dropped
    tracks = colmap.consistent_tracks(np.concatenate([near, far]), image_of, xy)
    assert [track.tolist() for track in tracks] == [[0, 3, 6]]
    assert colmap.consistent_tracks(near[:2], image_of, xy) == []  # two images


def test_a_database_is_copied_with_its_log_and_without_relative_poses_glomap_fails_with_a_reason(tmp_path):
    source, target = tmp_path / "source", tmp_path / "target"
    source.mkdir()
    target.mkdir()
    (source / "database.db").write_bytes(b"data")
    (source / "database.db-wal").write_bytes(b"log")
    before, ring = fingerprint(source), fingerprint(RING)
    assert colmap.copy_database(source / "database.db", target) == target / "database.db"
    assert fingerprint(target) == fingerprint(source) == before
    with quiet_log(), pytest.raises(RuntimeError, match="no pair of the database stores a relative pose"):
        colmap.position(RING / "database.db", RING / "sparse" / "0", colmap.SETTINGS[0])
    assert fingerprint(RING) == ring


@pytest.mark.slow
def test_glomap_loses_the_cameras_that_its_valid_pairs_do_not_tie(tmp_path):
    scene = real_scene("brighton-beach")
    given = pycolmap.Reconstruction(scene / "sparse" / "0")
    image = given.image(min(given.reg_image_ids()))
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d([1.5, 0.0, 0.0]), np.zeros(3))  # no pair of it agrees
    given.frame(image.frame_id).set_cam_from_world(image.camera_id, turn * image.cam_from_world())
    given.write(tmp_path)
    with quiet_log():
        found = colmap.position(scene / "database.db", tmp_path, colmap.SETTINGS[1])
    errors = sfm_shapefit.evaluate(found.reconstruction, scene / "sparse" / "0")
    assert sorted([*errors.names, image.name]) == sorted(one.name for one in given.images.values())
    assert errors.position.mean < 1e-3 * errors.extent  # measured: 0.6e-3; a stray camera alone adds 1e-2


def test_both_forms_of_the_rival_solve_the_program_and_the_direct_one_proves_it():
    graph = draw(SMALL).view_graph
    ours = solver.solve_ours(graph, 1e-11)
    by_cvxpy, _, _ = solve_cvxpy(graph, 1e-10)
    direct, dual, _ = solve_direct(graph, 1e-10)
    # A gap of 1e-10 leaves about its square root in locations along the flattest direction.
    assert relative_error(by_cvxpy, ours.locations) < 1e-5
    assert relative_error(direct, ours.locations) < 1e-5
    centered = direct - direct.mean(axis=0)
    assert certify(graph, centered, dual, uniqueness=False).gap < 1e-8


def answers(*rows):
    return [on_graphs.Answer(name, error, seconds) for name, error, seconds in rows]


def test_a_peer_is_beaten_by_error_or_by_time():
    ours = ("ours", 1e-3, 1.0)
    less_accurate = answers(ours, ("a", 2e-3, 0.1), ("b", 3e-3, 9.0))
    assert [check.met for check in on_graphs.checks(less_accurate)] == [True]  # none as accurate: no race
    as_accurate = answers(ours, ("a", 1e-3, 4.9), ("b", 5e-4, 50.0))
    assert [check.met for check in on_graphs.checks(as_accurate)] == [False, False]
    slower = answers(ours, ("a", 1e-3, 5.0))
    assert [check.met for check in on_graphs.checks(slower)] == [True, True]
    assert on_graphs.checks(answers(ours, ("a", math.nan, math.nan))) == []
    without_ours = answers(("ours", math.nan, math.nan), ("a", 1.0, 1.0))
    assert not on_graphs.checks(without_ours)[0].met


def test_a_peer_that_is_not_installed_is_skipped_with_a_sentence(monkeypatch):
    monkeypatch.setattr(on_graphs, "find_spec", lambda _package: None)
    peer = next(one for one in on_graphs.CONTENDERS if one.package == "gtsam")
    found = on_graphs.answer(peer, SMALL, 1)
    assert found.note == "skipped: gtsam is not installed"
    assert math.isnan(found.error)
    row = on_scenes.answer("pytheia LUD", Path(), None, "no directions", 1)
    assert row.note == "skipped: pytheia is not installed"


def test_our_contenders_place_a_bare_graph():
    for contender in on_graphs.CONTENDERS[:2]:
        problem = draw(SMALL)
        locations, _ = contender.prepare(problem.view_graph)()
        assert relative_error(locations, problem.locations) < 0.2  # noise 0.02, a tenth random


@pytest.mark.parametrize("package", ["pytheia", "gtsam"])
def test_peers_that_are_installed_point_the_right_way(package):
    pytest.importorskip(package)
    clean = GraphSpec(family="er2", n=14, q=0.0)
    problem = draw(clean)
    for contender in on_graphs.CONTENDERS:
        if contender.package == package:
            locations, _ = contender.prepare(problem.view_graph)()
            assert relative_error(locations, problem.locations) < 0.1  # a wrong sign gives 2


def errors(median, mean, missing=0):
    return Errors(median=median, mean=mean, max=9.0, num_missing=missing)


def rows(ours, peer):
    return [
        Answer(SAME_DIRECTIONS, errors(0.1, 0.1)),
        Answer(BY_DEFAULT, ours, peak_mb=512.4),
        Answer(f"{POSITIONING}, all", peer, seconds=1.0),
        Answer("another", None, note="failed: no answer"),
    ]


def test_ours_must_not_be_worse_than_the_best_peer_beyond_what_the_truth_can_tell():
    assert all(check.met for check in checks(rows(errors(1.04, 2.0), errors(1.0, 2.0))))
    median, mean = checks(rows(errors(1.06, 2.0), errors(1.0, 2.0)))
    assert not median.met
    assert mean.met
    assert checks(rows(errors(1.0, 1.0), None)) == []


@pytest.mark.slow
def test_a_real_scene_is_measured_with_ours_and_with_pycolmap(monkeypatch):
    monkeypatch.setattr(on_graphs, "call", call_here)
    folder = real_scene("Herz-Jesus-P8")
    scene = SCENES[folder.name]
    positioning = next(name for name in on_scenes.contenders() if name.startswith(POSITIONING))
    for name, limit in ((BY_DEFAULT, 0.005), (positioning, 0.1)):
        row = on_scenes.answer(name, folder, scene, "none", 200)
        assert row.error is not None, row.note
        assert row.error.median < limit
        assert row.seconds > 0.0
        assert row.peak_mb > 100.0
