#!/usr/bin/env bash
# gtsam 4.3.0, writeG2o and readG2o.
#
# Guess: a graph that is written and read again is the same, to the digits of a double or nearly so.
# Seen: all numbers have six significant digits. Poses in UTM come back with northings rounded to 10 m: two
#   cameras 2.7 m apart have the same northing, and an edge that fitted exactly has an error of many sigmas.
#   Nothing is said, and there is no argument for the digits.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet gtsam==4.3.0 numpy==2.4.6
cd "$folder"
"$folder/env/bin/python" - <<'PY'
import gtsam
import numpy as np

centers = np.array([[691000.123, 5334567.456, 520.789], [691001.987, 5334569.456, 520.789]])
values, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
for k, center in enumerate(centers):
    values.insert(k, gtsam.Pose3(gtsam.Rot3.Ypr(0.1 * k, 0.2, 0.3), center))
noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
graph.add(gtsam.BetweenFactorPose3(0, 1, values.atPose3(0).between(values.atPose3(1)), noise))
assert graph.error(values) < 1e-12

gtsam.writeG2o(graph, values, "graph.g2o")
lines = open("graph.g2o").read().splitlines()
print("\n".join(lines[:2]))
assert lines[0].split()[2:5] == ["691000", "5.33457e+06", "520.789"]

graph, again = gtsam.readG2o("graph.g2o", True)
moved = [np.abs(again.atPose3(k).translation() - center).max() for k, center in enumerate(centers)]
apart = np.linalg.norm(again.atPose3(1).translation() - again.atPose3(0).translation())
print(f"moved by up to {max(moved):.3f} m; 2.73 m apart became {apart:.2f} m; error {graph.error(again):.0f}")
assert 2.0 < max(moved) < 3.0 and abs(apart - 2.0) < 1e-6 and graph.error(again) > 100.0
print("OK: as described")
PY
