#!/usr/bin/env bash
# gtsam 4.3.0, Rot3 of a matrix with determinant -1.
#
# Guess: Rot3 refuses a reflection, as scipy's Rotation does, or brings it to the nearest rotation.
# Seen: it is kept as it is, and its logarithm is exactly 0, that of the identity. A factor between a pose and
#   its mirror image has no rotation error at all, although the matrices differ by 2 in an entry: mirrored
#   cameras, as a forgotten change of handedness gives them, look perfect to the optimizer.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet gtsam==4.3.0 numpy==2.4.6 scipy==1.17.1
"$folder/env/bin/python" - <<'PY'
import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

for axis in range(3):
    mirror = np.eye(3)
    mirror[axis, axis] = -1.0
    taken = gtsam.Rot3(mirror)
    assert np.linalg.det(taken.matrix()) == -1.0
    assert (gtsam.Rot3.Logmap(taken) == 0.0).all()
    pose = gtsam.Pose3(taken, np.zeros(3))
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
    factor = gtsam.PriorFactorPose3(0, gtsam.Pose3(), noise)
    values = gtsam.Values()
    values.insert(0, pose)
    print(f"axis {axis}: logarithm {gtsam.Rot3.Logmap(taken)}, error of a prior {factor.error(values)}")
    assert factor.error(values) == 0.0
    try:
        Rotation.from_matrix(mirror)
    except ValueError:
        continue
    raise SystemExit("scipy takes a reflection now")
print("OK: as described")
PY
