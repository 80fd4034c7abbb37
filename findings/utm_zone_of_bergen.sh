#!/usr/bin/env bash
# pyproj 3.7.2, query_utm_crs_info; utm 0.9.0; pycolmap 4.2.1.
#
# Guess: pyproj's query, for which PROJ brings a database of areas of use, knows that UTM has zone 32 where
#   southwest Norway is (60.39 N, 5.32 E), and odd zones alone on Svalbard, as maps there have it.
# Seen: it names zone 31 for Bergen and 32 for a place of Svalbard where 33 is, as pycolmap does; the small
#   package utm names 32 and 33. Eastings of one place differ by 331 km.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet pyproj==3.7.2 utm==0.9.0 pycolmap==4.2.1 numpy==2.4.6
"$folder/env/bin/python" - <<'PY'
import numpy as np
import pycolmap
import utm
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info

to_utm = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84).ellipsoid_to_utm
for latitude, longitude, plain, official in ((60.39, 5.32, 31, 32), (78.2, 10.0, 32, 33)):
    found = query_utm_crs_info("WGS 84", AreaOfInterest(longitude, latitude, longitude, latitude))
    codes = [one.code for one in found]
    easting, _, zone, letter = utm.from_latlon(latitude, longitude)
    theirs, theirs_zone = to_utm(np.array([[latitude, longitude, 0.0]]))
    print(f"{latitude} N, {longitude} E: pyproj {codes}, pycolmap {theirs_zone}, utm {zone}{letter}")
    print(f"  eastings {theirs[0, 0]:.0f} of pycolmap, {easting:.0f} of utm")
    assert codes == [f"326{plain}"] and zone == official and theirs_zone == plain
    assert abs(theirs[0, 0] - easting) > 1e5
print("OK: as described")
PY
