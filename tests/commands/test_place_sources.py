"""`solve` on 1DSfM folders, and what its objectives and formats write."""

import json
import re
from collections import Counter
from itertools import chain

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sfm_shapefit
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import fit_similarity, normalized
from sfm_shapefit.commands.place import place_graph_file
from sfm_shapefit.files.graph_text import graph_text, read_graph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.synthetic import random_graph_problem
from tests.files.test_onedsfm_format import egs_text, folder_with, rots_text, scene, write_scene
from tests.program import run
from tests.repeated_scenes import four_alike_sides
from tests.scenes import BUNDLED, real_scene, rows_of


def solve(*arguments, code=0):
    return run("solve", *arguments, code=code)


def centers_of(out):
    rows = [row for row in rows_of(out / "cameras.csv") if row["placed"] == "true"]
    return {row["name"]: [float(row[axis]) for axis in "xyz"] for row in rows}


def worst_error(found, truth):
    """Largest distance after similarity alignment, as a share of the truth's extent."""
    similarity = fit_similarity(found, truth)
    return np.linalg.norm(similarity.apply(found) - truth, axis=1).max() / np.ptp(truth, axis=0).max()


@pytest.mark.parametrize("averaged", [True, False])
def test_a_1dsfm_folder_is_placed_from_given_or_averaged_rotations(tmp_path, averaged):
    source, _, centers = write_scene(tmp_path / "in", n=9)
    given = [] if averaged else ["--rotations", source / "rots.txt"]
    solve(source, tmp_path / "out", *given)
    found = centers_of(tmp_path / "out")
    facts = json.loads((tmp_path / "out" / "locate.json").read_text())
    assert list(found) == [str(10 * k) for k in range(9)]
    assert worst_error(np.array(list(found.values())), centers) < 1e-6  # averaging stops at its own tolerance
    assert ("9 of 9 rotations averaged" in facts["inputs"]["directions"]) == averaged
    assert facts["residuals_deg"]["quantile_90"] < 1e-4


def test_pairs_whose_rotation_contradicts_the_cameras_are_left_out_and_counted(tmp_path):
    rotations, centers = scene(n=9)
    lines = egs_text(rotations, centers).splitlines()
    wrong = scene(n=9, seed=99)
    lines[0] = egs_text(*wrong).splitlines()[0]
    source = folder_with(tmp_path / "in", EGs="\n".join(lines), rots=rots_text(rotations))
    arguments = [source, "--rotations", source / "rots.txt"]
    solve(arguments[0], tmp_path / "out", *arguments[1:])
    facts = json.loads((tmp_path / "out" / "locate.json").read_text())
    assert "1 of 36 pairs contradict them by more than 10 deg" in facts["inputs"]["directions"]
    assert facts["num_pairs"] == 35
    solve(arguments[0], tmp_path / "all", *arguments[1:], "--max-rotation-error", "180")
    assert json.loads((tmp_path / "all" / "locate.json").read_text())["num_pairs"] == 36


def test_neither_order_nor_orientation_of_lines_matters_and_reversed_directions_give_the_same_scene(tmp_path):
    graph, rng = read_graph(BUNDLED / "graph40.txt"), np.random.default_rng(5)
    v = normalized(graph.directions + 0.03 * rng.standard_normal(graph.directions.shape))
    order, flip = rng.permutation(graph.num_edges), rng.random((graph.num_edges, 1)) < 0.5
    edges = np.where(flip, graph.edges[:, ::-1], graph.edges)[order]
    flipped = np.where(flip, -v, v)[order]
    locations = []
    for pairs, directions, is_reversed in (
        (graph.edges, v, False),
        (edges, flipped, False),
        (edges, -flipped, True),
    ):
        text = graph_text(ViewGraph(graph.num_nodes, pairs, directions, names=graph.names))
        (tmp_path / "g.txt").write_text(text)
        found = place_graph_file(tmp_path / "g.txt", reverse=is_reversed)
        locations.append(found.placement.locations)
    plain, shuffled, turned = locations
    assert np.abs(shuffled - plain).max() <= 1e-12 * np.ptp(plain, axis=0).max()
    np.testing.assert_array_equal(turned, shuffled)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["graph.txt", "--rotations", "rots.txt"], "needs? no rotations"),
        (["EGs.txt", "--reverse"], "leave out --reverse"),
        (["EGs.txt", "--rotations", "wrong.txt"], "agrees with those of the cameras"),
    ],
)
def test_options_that_do_not_fit_the_source_are_refused(tmp_path, arguments, words):
    rotations, centers = scene()
    folder_with(
        tmp_path,
        EGs=egs_text(rotations, centers),
        rots=rots_text(rotations),
        wrong=rots_text(scene(seed=7)[0]),
        graph="0 1 1 0 0\n1 2 0 1 0\n0 2 0.6 0.8 0\n",
    )
    paths = [tmp_path / a if a.endswith(".txt") else a for a in arguments]
    result = solve(paths[0], tmp_path / "out", *paths[1:], code=3)
    assert re.search(words, " ".join(result.stderr.split()))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("objective", ["auto", "shapefit", "lud"])
def test_every_objective_writes_the_same_files_with_a_certificate(tmp_path, objective):
    problem = random_graph_problem(14, 0.9, sigma=0.001, seed=5)
    (tmp_path / "g.txt").write_text(graph_text(problem.view_graph))
    solve(tmp_path / "g.txt", tmp_path / "out", "--objective", objective, "--quiet")
    facts = json.loads((tmp_path / "out" / "locate.json").read_text())
    found = centers_of(tmp_path / "out")
    order = np.array([found[str(k)] for k in range(14)])
    assert worst_error(order, problem.locations) < 0.01  # noise of 0.001
    assert facts["solve"]["status"] == "converged"
    assert all(row["dual_norm"] != "" for row in rows_of(tmp_path / "out" / "pairs.csv"))


@pytest.mark.parametrize("confused", [0.5, 0.8])
def test_relative_rotations_unfold_a_scene_of_four_equal_sides(confused):
    scene = four_alike_sides(confused, seed=2)
    bare = sfm_shapefit.place(scene.graph)
    placed = sfm_shapefit.place(scene.graph, rotations=scene.relative, num_matches=scene.num_matches)
    assert worst_error(bare.locations, scene.centers[bare.cameras]) > 0.1
    assert len(placed.cameras) == len(scene.centers)
    # Noise of 0.002 a direction, of pairs as long as half the radius, 14 a camera.
    assert worst_error(placed.locations, scene.centers) < 0.005
    assert np.isin(placed.graph.edges, scene.graph.edges[scene.num_matches == 200]).all()


def test_no_pair_leaves_where_rotations_alone_would_fold_the_scene():
    scene = four_alike_sides(0.3, seed=0)
    folded = sfm_shapefit.average_rotations(scene.graph.edges, scene.relative)
    assert folded.share > np.mean(scene.num_matches == 200)
    placed = sfm_shapefit.place(scene.graph, rotations=scene.relative)
    assert placed.graph.num_edges == scene.graph.num_edges
    assert worst_error(placed.locations, scene.centers) < 0.005


def test_rotations_that_agree_change_no_bit_and_bad_ones_are_refused():
    problem = random_graph_problem(14, 0.9, sigma=0.001, seed=5)
    graph, same = problem.view_graph, np.tile(np.eye(3), (problem.view_graph.num_edges, 1, 1))
    plain, given = sfm_shapefit.place(graph), sfm_shapefit.place(graph, rotations=same)
    np.testing.assert_array_equal(given.locations, plain.locations)
    for words, options in [
        ("rotations have shape", {"rotations": same[1:]}),
        ("has no rotation matrix", {"rotations": 2.0 * same}),
        ("weights have shape", {"rotations": same, "num_matches": [1.0]}),
        ("give rotations, too", {"num_matches": np.ones(graph.num_edges)}),
    ]:
        with pytest.raises(InputError, match=words):
            sfm_shapefit.place(graph, **options)


def relative_poses_text(scene, counts):
    """GLOMAP's text of a scene, with a count of matches behind each line or without."""
    lines = []
    toward = -np.einsum("eab,eb->ea", scene.rotations[scene.graph.edges[:, 0]], scene.graph.directions)
    for (i, j), turn, to_second, count in zip(
        scene.graph.edges, scene.relative, toward, scene.num_matches, strict=True
    ):
        numbers = [*np.roll(Rotation.from_matrix(turn).as_quat(), 1), *(-turn @ to_second)]
        lines.append(f"{i} {j} {' '.join(map(repr, map(float, numbers)))}{f' {count}' if counts else ''}\n")
    return "".join(lines)


def test_counts_behind_relative_poses_unfold_a_scene_and_are_told(tmp_path):
    scene, found = four_alike_sides(0.5, seed=1), []
    for counts in (False, True):
        (tmp_path / "poses.txt").write_text(relative_poses_text(scene, counts))
        solve(tmp_path / "poses.txt", tmp_path / f"out{counts}")
        centers = centers_of(tmp_path / f"out{counts}")
        truth = scene.centers[[int(name) for name in centers]]
        found.append(worst_error(np.array(list(centers.values())), truth))
    folded, right = found
    assert folded > 0.1
    assert right < 0.005
    facts = json.loads((tmp_path / "outTrue" / "locate.json").read_text())
    assert "48 of 48 rotations averaged by the numbers of matches" in facts["inputs"]["directions"]


@pytest.mark.slow
def test_the_published_1dsfm_scene_is_placed_end_to_end(tmp_path):
    """Its 120 images of most pairs; all of it is a benchmark."""
    scene = real_scene("1dsfm-Madrid_Metropolis")
    lines = (scene / "EGs.txt").read_text().splitlines()
    pairs = [line.split()[:2] for line in lines]
    kept = dict(Counter(chain.from_iterable(pairs)).most_common(120))
    part = [line for line, pair in zip(lines, pairs, strict=True) if kept.keys() >= set(pair)]
    solve(folder_with(tmp_path / "in", EGs="\n".join(part)), tmp_path / "out")
    facts = json.loads((tmp_path / "out" / "locate.json").read_text())
    assert facts["num_placed"] > 108
    assert facts["solve"]["status"] == "converged"
    assert facts["residuals_deg"]["quantile_50"] < 5.0
