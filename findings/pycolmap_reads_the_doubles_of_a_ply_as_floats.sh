#!/usr/bin/env bash
# pycolmap 4.2.1, Reconstruction.import_PLY and export_PLY.
#
# Guess: points are doubles in COLMAP, so that a PLY of doubles, binary or text, arrives as it is.
# Seen: import_PLY goes through float32 whatever the header says: points in UTM move by up to 0.25 m, and two
#   points 0.2 m apart become one. Nothing is said.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet pycolmap==4.2.1 numpy==2.4.6
cd "$folder"
"$folder/env/bin/python" - <<'PY'
import numpy as np
import pycolmap

points = np.array([[691000.12, 5334000.2, 520.0], [691000.12, 5334000.0, 520.0]])
rows = np.empty(2, [("xyz", "<f8", 3), ("rgb", "u1", 3)])
rows["xyz"], rows["rgb"] = points, [10, 20, 30]
head = "ply\nformat {} 1.0\nelement vertex 2\n"
head += "".join(f"property double {axis}\n" for axis in "xyz")
head += "".join(f"property uchar {color}\n" for color in ("red", "green", "blue")) + "end_header\n"
open("binary.ply", "wb").write(head.format("binary_little_endian").encode() + rows.tobytes())
text = "".join(f"{x!r} {y!r} {z!r} 10 20 30\n" for x, y, z in points.tolist())
open("text.ply", "w").write(head.format("ascii") + text)

for name in ("binary.ply", "text.ply"):
    model = pycolmap.Reconstruction()
    model.import_PLY(name)
    found = np.array([point.xyz for point in model.points3D.values()])
    print(name, found.tolist())
    assert (found[0] == found[1]).all()
    assert (found == points[1].astype(np.float32)).all()
model.export_PLY("again.ply")
assert b"property float y" in open("again.ply", "rb").read()
print("OK: as described")
PY
