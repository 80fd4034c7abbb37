#!/usr/bin/env bash
# evo 1.38.1, sync.associate_trajectories.
#
# Guess: associating two trajectories by time pairs each pose at most once, the nearest first.
# Seen: each stamp of the shorter trajectory takes the nearest of the longer one, which may be taken again and
#   again: three poses within the tolerance of one are all paired with it, that pose counts three times in
#   every error, and the associated trajectory has the same stamp three times.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet evo==1.38.1 numpy==2.4.6
HOME="$folder" "$folder/env/bin/python" - <<'PY'
import numpy as np
from evo.core import metrics, sync, trajectory


def made(stamps, x):
    positions = np.column_stack([x, np.zeros(len(x)), np.zeros(len(x))])
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (len(x), 1))
    return trajectory.PoseTrajectory3D(positions, turns, np.array(stamps))


reference = made([0.0, 0.004, 0.008, 5.0], [0.0, 1.0, 2.0, 3.0])
estimate = made([0.0, 1.0, 2.0, 3.0, 5.0], [0.0, 9.0, 9.0, 9.0, 3.0])
first, second = sync.associate_trajectories(reference, estimate, max_diff=0.01)
print("stamps", first.timestamps.tolist(), "with", second.timestamps.tolist())
assert second.timestamps.tolist() == [0.0, 0.0, 0.0, 5.0]
error = metrics.APE(metrics.PoseRelation.translation_part)
error.process_data((first, second))
print("errors", error.error.tolist())
assert error.error.tolist() == [0.0, 1.0, 2.0, 0.0]
print("OK: as described")
PY
