#!/usr/bin/env bash
# viewgraphforge 1.0.0 (ViewGraphBench), write_g2o.
#
# Guess: the information of an edge's translation, divided by its squared length, says how well the direction is
#   known; the generator draws directions with a standard deviation of their own, which it knows.
# Seen: by default (metric=True) one isotropic number holds the error of the length, 5 % of it by default, and that
#   of the direction. Standard deviations by the file are 23 times those of the directions in the median, and all
#   alike where these differ tenfold. Only metric=False, where translations have length 1, has the directions' own.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet viewgraphforge==1.0.0 numpy==2.4.6
cd "$folder"
"$folder/env/bin/python" - <<'PY'
import numpy as np
from viewgraphforge.config import load_config
from viewgraphforge.generate import generate_graph
from viewgraphforge.io.g2o import write_g2o
from viewgraphforge.splits import expand_config

job = next(job for job in expand_config(load_config("full"), ["bench_outliers"]) if job.params["family"] == "orbit")
graph = generate_graph(dict(job.params) | {"store_observations": False, "store_points": False}, seed=7)
own = graph.arrays["edge_sigma_dir"]


def told(metric):
    write_g2o(graph, "graph.g2o", init="gt", metric=metric)
    rows = [line.split() for line in open("graph.g2o") if line.startswith("EDGE_SE3:QUAT")]
    numbers = np.array([[float(word) for word in row[3:]] for row in rows])
    return 1.0 / np.sqrt(numbers[:, 7]) / np.linalg.norm(numbers[:, :3], axis=1)


ratio = told(True) / own
spread = [float(np.subtract(*np.log(np.quantile(sigmas, [0.9, 0.1])))) for sigmas in (own, told(True))]
print(f"{len(own)} pairs, metric: told / own, median {np.median(ratio):.1f}, 90 % {np.quantile(ratio, 0.9):.1f}")
print(f"factor between the 90 and 10 % quantiles: own {np.exp(spread[0]):.1f}, told {np.exp(spread[1]):.1f}")
again = told(False) / own
print(f"unit length: told / own, {again.min():.3f} to {again.max():.3f}")
assert np.median(ratio) > 5.0 and spread[1] < 0.5 * spread[0]
assert np.abs(again - 1.0).max() < 1e-3
print("OK: as described")
PY
