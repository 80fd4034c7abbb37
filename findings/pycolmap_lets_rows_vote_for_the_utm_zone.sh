#!/usr/bin/env bash
# pycolmap 4.2.1, GPSTransform.ellipsoid_to_utm; pyproj 3.7.2 for comparison.
#
# Guess: a row's easting and northing depend on that row; a batch is one continuous grid.
# Seen: the zone is the one that most rows of the call lie in, of a tie the smaller, so that a point moves by
#   hundreds of kilometers with what is converted beside it.
#   Two points 11 m apart on both sides of the equator are 10,000 km apart in the answer: the false northing is
#   decided row by row, while there is one zone for all and no hemisphere is returned.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet pycolmap==4.2.1 pyproj==3.7.2 numpy==2.4.6
"$folder/env/bin/python" - <<'PY'
import numpy as np
import pycolmap
from pyproj import Transformer

to_utm = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84).ellipsoid_to_utm
point, east = [47.0, 5.999, 400.0], [47.0, 6.001, 400.0]

alone, zone_alone = to_utm(np.array([point]))
among, zone_among = to_utm(np.array([point, east, east]))
print(f"one point alone: zone {zone_alone}, easting {alone[0, 0]:.1f}")
print(f"the same beside two others: zone {zone_among}, easting {among[0, 0]:.1f}")
assert (zone_alone, zone_among) == (31, 32)
assert abs(alone[0, 0] - 727993.5) < 0.1 and abs(among[0, 0] - 271854.4) < 0.1
assert to_utm(np.array([east, point]))[1] == 31  # a tie goes to the smaller number

south, north = to_utm(np.array([[-0.00005, 10.0, 0.0], [0.00005, 10.0, 0.0]]))[0]
print(f"11 m apart across the equator: northings {south[1]:.2f} and {north[1]:.2f}")
assert 9.9e6 < abs(south[1] - north[1]) < 1.01e7
grid = Transformer.from_crs(4326, 32632, always_xy=True)
northings = [grid.transform(10.0, latitude)[1] for latitude in (-0.00005, 0.00005)]
assert abs(northings[1] - northings[0] - 11.06) < 0.1  # one grid, as PROJ has it

print("OK: as described")
PY
