"""The answer does not depend on how a graph is written down."""

import numpy as np

from sfm_shapefit.commands.place import place_graph_file


def test_the_order_of_a_graphs_lines_does_not_matter(tmp_path):
    rng = np.random.default_rng(5)
    centers = rng.normal(size=(30, 3))
    pairs = np.array([(i, j) for i in range(30) for j in range(i) if rng.random() < 0.4])
    baselines = centers[pairs[:, 0]] - centers[pairs[:, 1]]
    baselines += 0.03 * rng.standard_normal(baselines.shape)
    units = baselines / np.linalg.norm(baselines, axis=1, keepdims=True)
    located = []
    for order, flip in ((np.arange(len(pairs)), 0.0), (rng.permutation(len(pairs)), 0.5)):
        lines = []
        for e in order.tolist():
            (i, j), v = (pairs[e], units[e]) if rng.random() >= flip else (pairs[e][::-1], -units[e])
            lines.append(f"{i} {j} {' '.join(map(repr, v.tolist()))}\n")
        (tmp_path / "graph.txt").write_text("".join(lines))
        located.append(place_graph_file(tmp_path / "graph.txt").placement.locations)
    assert np.abs(located[0] - located[1]).max() <= 1e-12 * np.ptp(located[0], axis=0).max()
