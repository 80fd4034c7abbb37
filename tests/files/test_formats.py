"""Bare view graphs as text: what is read, and how malformed lines are named; `solve` on such files."""

import json

import numpy as np
import pytest

from scripts.make_data import TABLES
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.graph_text import graph_text, read_graph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.synthetic import random_graph_problem
from tests.program import run
from tests.scenes import BUNDLED

GOOD = "7 3 1 0 0\n3 -2 0 1 0\n-2 7 0 0 1\n"


def write(path, text):
    path.write_text(text)
    return path


def graph_file(path, *, d=3, n=12, weights=False, pendant=False):
    """Write a random noisy graph whose node k is called 10 k, and return its true locations."""
    problem = random_graph_problem(n, 0.8, d=d, sigma=0.001, q=0.1, seed=d)
    lines = []
    for e, ((i, j), v) in enumerate(zip(problem.edges, problem.directions, strict=True)):
        numbers = " ".join(repr(float(x)) for x in v)
        lines.append(f"{10 * i} {10 * j} {numbers}" + (f" {1 + e % 3}" if weights else ""))
    if pendant:
        lines.append(f"0 999 {' '.join(['1'] + ['0'] * (d - 1))}")
    path.write_text("# a comment\n\n" + "\n".join(lines) + "\n")
    return problem.locations


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("b.jpg a.jpg 1 0 0\nc b.jpg 0 1 0 # last\n", ["a.jpg", "b.jpg", "c"]),
        *((f"1 2 1 0 0\n2 {word} 0 1 0\n", sorted(["1", "2", word])) for word in ("--5", "-", "9" * 5000)),
    ],
)
def test_ids_are_words_and_numbers_stand_in_numerical_order(tmp_path, text, names):
    assert read_graph(write(tmp_path / "g.txt", text)).names == tuple(names)
    graph = read_graph(write(tmp_path / "g.txt", GOOD))
    assert graph.names == ("-2", "3", "7")
    np.testing.assert_array_equal(graph.edges, [[2, 1], [1, 0], [0, 2]])
    np.testing.assert_array_equal(graph.weights, 1.0)


@pytest.mark.parametrize("d", [2, 5])
@pytest.mark.parametrize("weights", [False, True])
def test_the_columns_tell_dimension_and_weights(tmp_path, d, weights):
    graph_file(tmp_path / "g.txt", d=d, weights=weights)
    graph = read_graph(tmp_path / "g.txt")
    assert graph.dimension == d
    assert (graph.weights.max() == 3.0) == weights
    assert read_graph(write(tmp_path / "g.txt", "0 1 1 0 0\n1 2 0 1 0\n")).dimension == 3  # 0 is no weight


@pytest.mark.parametrize("weighted", [False, True])
def test_a_written_graph_is_read_back_to_the_bit(tmp_path, weighted):
    problem = random_graph_problem(9, 0.9, sigma=0.1, q=0.2, seed=9)
    weights = np.linspace(0.5, 2.0, len(problem.edges)) if weighted else None
    graph = ViewGraph(9, problem.edges, problem.directions, weights, names=[f"{k}.jpg" for k in range(9)])
    again = read_graph(write(tmp_path / "g.txt", graph_text(graph)))
    assert again.names == graph.names
    for name in ("edges", "directions", "weights"):
        np.testing.assert_array_equal(getattr(again, name), getattr(graph, name))


def test_the_bundled_graph_and_tables_are_those_that_their_script_makes():
    for name, text in TABLES.items():
        if name != "graph40.txt":
            assert (BUNDLED / name).read_text() == text(), name
    ours = read_graph(BUNDLED / "graph40.txt")
    lines = TABLES["graph40.txt"]().splitlines()[1:]
    np.testing.assert_array_equal(ours.edges, [[int(word) for word in line.split()[:2]] for line in lines])
    made = [[float(word) for word in line.split()[2:]] for line in lines]
    np.testing.assert_allclose(ours.directions, made, atol=1e-14)  # another numpy may round differently


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty, so it has no lines of the form i j vx vy vz"),
        ("# nothing\n\n", "no lines of the form"),
        ("0 1 1 0 0\n\n1 2 0 1\n", "line 3: has 4 columns"),
        ("0 1 1 0 0\n1 2 0 x 1\n", "line 2: 'x' is not a number"),
        ("0 1 1 0 0\n1 2 0 nan 1\n", "line 2: has a number that is not finite"),
        ("0 1 1 0 0\n1 2 0 2 0\n", "line 2: has no unit direction"),
        ("0 1 1 0 0 1\n1 2 0 1 0 -1\n", "line 2: has a weight that is not positive"),
        ("1 2 1 0 0 1\n2 3 0 1 0 1e308\n", "line 2: has a weight beyond"),
        ("1 2 1 0 0 1\n2 3 0 1 0 1e-300\n", "line 2: has a weight beyond"),
        ("0 1 1 0 0\n2 2 0 1 0\n", "line 2: joins a node with itself"),
        ("0 1\n", "line 1: expected i j and a direction"),
        ("0 1 1 0 0\n1 0 1 0 0\n", "cancel"),
    ],
)
def test_malformed_files_are_refused_by_line(tmp_path, text, words):
    with pytest.raises(InputError, match=words) as raised:
        read_graph(write(tmp_path / "g.txt", text))
    assert "g.txt" in str(raised.value)


@pytest.mark.parametrize("d", [2, 3, 5])
def test_solve_places_a_bare_graph(tmp_path, d):
    truth = graph_file(tmp_path / "g.txt", d=d, pendant=True)
    before = (tmp_path / "g.txt").read_bytes()
    # Newton's kernels for five dimensions take ten seconds to compile; they are tested in solver/.
    (tmp_path / "options.toml").write_text('solver = "conic"' if d > 3 else "", encoding="utf-8")
    config = ("--config", tmp_path / "options.toml")
    result = run("solve", tmp_path / "g.txt", tmp_path / "out", "--json", *config, code=0)
    facts = json.loads(result.stdout)
    assert (facts["num_images"], facts["num_placed"], facts["dimension"]) == (13, 12, d)
    assert facts["solve"]["gap"] <= 1e-8
    assert (tmp_path / "g.txt").read_bytes() == before
    written = {path.name for path in (tmp_path / "out").iterdir()}
    in_space = {"covariances.csv"} if d == 3 else set()
    assert written == {"locate.json", "cameras.csv", "pairs.csv", "report.html"} | in_space

    header, *lines = (tmp_path / "out" / "cameras.csv").read_text().splitlines()
    rows = {line.split(",")[0]: dict(zip(header.split(","), line.split(","), strict=True)) for line in lines}
    assert rows["999"]["reason"] == "pendant: joined by a single pair to 0"
    axes = ["x", "y", "z"][:d] if d <= 3 else [f"x{k + 1}" for k in range(d)]
    found = np.array([[float(rows[str(10 * k)][axis]) for axis in axes] for k in range(12)])
    shapes = [t - t.mean(axis=0) for t in (found, truth)]
    shapes = [t / np.linalg.norm(t) for t in shapes]
    assert np.linalg.norm(shapes[0] - shapes[1]) < 0.02  # 0.001 rad of noise on 50 directions


def test_missing_and_binary_files_are_refused_and_a_graph_that_determines_nothing_exits_with_4(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_graph(tmp_path / "nowhere.txt")
    (tmp_path / "binary").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="not a readable"):
        read_graph(tmp_path / "binary")
    run("solve", write(tmp_path / "g.txt", "0 1 1 0 0\n1 2 0 1 0\n"), tmp_path / "out", code=4)
    assert not (tmp_path / "out").exists()
