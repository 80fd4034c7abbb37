"""Layouts of COLMAP's binary model files, all little-endian; counts are uint64 unless noted.

    cameras   count, then  id u32, model i32, width u64, height u64, params f64 each
    images    count, then  id u32, qw qx qy qz tx ty tz f64, camera u32, name to NUL,
                           count, then  x y f64, point3D id u64 (all ones: none)
    points3D  count, then  id u64, x y z f64, r g b u8, error f64, count, then  image u32, point2D u32
    rigs      count, then  id u32, count u32, reference sensor (type i32, id u32), and for each further
                           sensor  type i32, id u32, has_pose u8, and then qw .. tz f64 if it has
    frames    count, then  id u32, rig u32, qw .. tz f64, count u32, then  type i32, sensor u32, data u64

Source: https://colmap.github.io/format.html, "Sparse reconstruction".
"""

import struct

import numpy as np

NO_POINT = np.uint64(2**64 - 1)  # id of a point; COLMAP writes it where a keypoint observes none

COUNT = struct.Struct("<Q")
CAMERA = struct.Struct("<IiQQ")
IMAGE = struct.Struct("<I7dI")
RIG = struct.Struct("<II")
SENSOR_ID = struct.Struct("<iI")
HAS_POSE = struct.Struct("<B")
POSE = struct.Struct("<7d")
FRAME = struct.Struct("<II7dI")
FRAME_DATA = struct.Struct("<iIQ")
POINT = struct.Struct("<Q3d3BdQ")
POINT2D = np.dtype([("xy", "<f8", 2), ("point3d_id", "<u8")])
POINT3D = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])
