"""From hloc's feature and match files to placed cameras.

    python examples/hloc_outputs.py IMAGES pairs.txt features.h5 matches.h5 OUT [FOCAL_LENGTH_PX]

hloc writes, per image, `features.h5[name]["keypoints"]`, and, per pair, `matches.h5[pair]["matches0"]`: for
each keypoint of the first image the index of its match in the second, or -1. These go into a COLMAP database,
where COLMAP verifies them; `global_mapping`, called as pycolmap's mappers are, averages rotations, places the
cameras and adjusts them. OUT then holds database.db and models/0, models/1, ... with a report.html each.

If hloc has made a database.db already, as its reconstruction does, none of this is needed:

    sfm-shapefit map database.db OUT

Needs h5py.
"""

import sys
from pathlib import Path

import numpy as np
import pycolmap

import sfm_shapefit

try:
    import h5py
except ModuleNotFoundError:
    sys.exit("hloc's files are read by h5py, which is not installed: pip install h5py")


def pair_key(file: h5py.File, name0: str, name1: str) -> tuple[str, bool]:
    """Return under which key hloc keeps a pair, and whether in reversed order."""
    for first, second, is_reversed in ((name0, name1, False), (name1, name0, True)):
        key = f"{first.replace('/', '-')}/{second.replace('/', '-')}"
        if key in file:
            return key, is_reversed
    raise KeyError(f"the matches hold no pair {name0} {name1}")


def write_database(
    database: Path, images: Path, pairs: list[tuple[str, str]], features: Path, matches: Path
) -> dict[str, int]:
    """Write keypoints and matches into a new COLMAP database; return the id of each image."""
    names = sorted({name for pair in pairs for name in pair})
    pycolmap.Database.open(database).close()  # makes the tables
    pycolmap.import_images(database, images, pycolmap.CameraMode.SINGLE, names)
    with (
        pycolmap.Database.open(database) as opened,
        h5py.File(features) as found,
        h5py.File(matches) as matched,
    ):
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        for name in names:
            keypoints = found[name]["keypoints"][:] + 0.5  # COLMAP's first pixel has its center at 0.5
            opened.write_keypoints(ids[name], keypoints.astype(np.float32))
        for name0, name1 in pairs:
            key, is_reversed = pair_key(matched, name0, name1)
            second = matched[key]["matches0"][:].astype(np.int64)
            indices = np.stack([np.flatnonzero(second >= 0), second[second >= 0]], axis=1)
            first_to_second = indices[:, ::-1] if is_reversed else indices
            opened.write_matches(ids[name0], ids[name1], first_to_second.astype(np.uint32))
    return ids


def set_focal_length(database: Path, focal_length_px: float) -> None:
    """Replace COLMAP's guess by what you know."""
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            camera.focal_length = focal_length_px
            camera.has_prior_focal_length = True
            opened.update_camera(camera)


def main(
    images: Path,
    pairs_file: Path,
    features: Path,
    matches: Path,
    out: Path,
    focal_length_px: float | None = None,
) -> dict[int, pycolmap.Reconstruction]:
    """Place the cameras of all images of the list of pairs; return the models by their numbers."""
    out.mkdir(parents=True)
    database = out / "database.db"
    pairs = [tuple(line.split()) for line in pairs_file.read_text().splitlines() if line.strip()]
    ids = write_database(database, images, pairs, features, matches)
    if focal_length_px is not None:
        set_focal_length(database, focal_length_px)
    pycolmap.verify_matches(database, pairs_file)

    # In hloc's own reconstruction.py the same line stands in place of pycolmap.incremental_mapping(...).
    models = sfm_shapefit.global_mapping(database, images, out / "models")
    for number, model in models.items():
        print(f"model {number}: {model.num_reg_images()} of {len(ids)} cameras")
    print(f"see {out / 'models/0/report.html'}")
    return models


if __name__ == "__main__":
    if not 6 <= len(sys.argv) <= 7:
        sys.exit(print(__doc__, file=sys.stderr) or 2)
    main(*map(Path, sys.argv[1:6]), *(float(number) for number in sys.argv[6:7]))
