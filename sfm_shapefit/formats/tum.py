"""Poses as plain text: the TUM RGB-D trajectory format, and a CSV; both written.

    TUM   timestamp tx ty tz qx qy qz qw      world_from_camera: the centre, and R^T as a quaternion
    CSV   name,x,y,z,qw,qx,qy,qz              the centre, and cam_from_world as in COLMAP's images.txt

Camera axes are COLMAP's in both (z forward, y down), as in TUM's own data. The timestamp is the number
that is an image's name without folder and suffix, as in TUM's data (1305031102.175304.png), if all names
are different numbers; otherwise the position of the image in the order of names, from 0. Lines are in the
order of timestamps.

Source: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012; its file formats.
"""

import csv
import io
import math
from pathlib import PurePosixPath

from sfm_shapefit.formats.scene import SceneFile, quaternion_from_rotation


def tum_text(scene: SceneFile) -> str:
    """Return the posed images as a trajectory; numbers round-trip."""
    lines = []
    for stamp, k in sorted(zip(_timestamps(scene.names), range(len(scene.names)), strict=True), key=_by_time):
        w, x, y, z = quaternion_from_rotation(scene.rotations[k].T).tolist()
        numbers = [*scene.centers[k].tolist(), x, y, z, w]
        lines.append(" ".join([stamp, *(repr(number + 0.0) for number in numbers)]))
    return "# timestamp tx ty tz qx qy qz qw\n" + "".join(f"{line}\n" for line in lines)


def poses_csv(scene: SceneFile) -> str:
    """Return the posed images as a CSV; numbers round-trip."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["name", "x", "y", "z", "qw", "qx", "qy", "qz"])
    for name, rotation, center in zip(scene.names, scene.rotations, scene.centers, strict=True):
        quaternion = quaternion_from_rotation(rotation).tolist()
        writer.writerow([name, *(repr(number + 0.0) for number in [*center.tolist(), *quaternion])])
    return stream.getvalue()


def _by_time(item: tuple[str, int]) -> tuple[float, int]:
    return float(item[0]), item[1]


def _timestamps(names: tuple[str, ...]) -> list[str]:
    """Return the timestamp of each image, as text."""
    stems = [PurePosixPath(name).stem for name in names]
    if len(set(stems)) == len(stems) and all(map(_is_time, stems)):
        return stems
    position = {name: k for k, name in enumerate(sorted(names))}
    return [str(position[name]) for name in names]


def _is_time(stem: str) -> bool:
    """Return whether a name is a plain decimal number."""
    digits = stem.replace(".", "", 1)
    return digits.isascii() and digits.isdigit() and math.isfinite(float(stem))
