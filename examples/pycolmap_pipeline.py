"""A pycolmap pipeline with `sfm_shapefit.locate` as the step that places the cameras.

    images -> features -> matches, verified -> rotations -> locate -> bundle adjustment

    python examples/pycolmap_pipeline.py IMAGES OUT [FOCAL_LENGTH_PX]

OUT then holds database.db, located/ (the model with report.html and tables) and sparse/0, adjusted.
Matching and bundle adjustment are pycolmap's, and may be exchanged for yours (`sfm_shapefit.global_mapping`
is all of it after matching, in one call). To try it on drawn images:

    sfm-shapefit synth drawn --shape facade --num-images 8 --images
    python examples/pycolmap_pipeline.py drawn/images result 1000
"""

import sys
from pathlib import Path

import pycolmap

import sfm_shapefit


def match(images: Path, database: Path, focal_length_px: float | None) -> None:
    """Detect keypoints in all images, match all pairs, and verify them geometrically."""
    pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.SINGLE)
    if focal_length_px is not None:  # else COLMAP's guess stays: calibrate if you can
        with pycolmap.Database.open(database) as opened:
            for camera in opened.read_all_cameras():
                camera.focal_length = focal_length_px
                camera.has_prior_focal_length = True
                opened.update_camera(camera)
    pycolmap.match_exhaustive(
        database, verification_options=pycolmap.TwoViewGeometryOptions(compute_relative_pose=True)
    )


def main(images: Path, out: Path, focal_length_px: float | None = None) -> pycolmap.Reconstruction:
    """Run the pipeline and return the adjusted model."""
    out.mkdir(parents=True)
    database = out / "database.db"
    match(images, database, focal_length_px)

    # Rotations may be a degree off where the lens distorts and nobody said so: pairs then correct them.
    averaged = sfm_shapefit.average_database(database)
    found = sfm_shapefit.locate(averaged, database, rotations=1.0)
    found.write(out / "located")
    print(f"verdict: {found.verdict.statement}")
    for warning in found.warnings:
        print(f"warning: {warning}")

    adjusted = pycolmap.Reconstruction(found.reconstruction)  # the seed stays as it is
    pycolmap.bundle_adjustment(adjusted)
    (out / "sparse" / "0").mkdir(parents=True)
    adjusted.write(out / "sparse" / "0")
    report = out / "located" / "report.html"
    print(f"{adjusted.num_reg_images()} cameras, {adjusted.num_points3D()} points; see {report}")
    return adjusted


if __name__ == "__main__":
    if not 3 <= len(sys.argv) <= 4:
        sys.exit(print(__doc__, file=sys.stderr) or 2)
    main(Path(sys.argv[1]), Path(sys.argv[2]), *(float(number) for number in sys.argv[3:4]))
