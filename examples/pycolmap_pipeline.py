"""A pycolmap pipeline with `sfm_shapefit.locate` as the step that places the cameras.

    images -> features -> matches, verified -> rotations -> locate -> bundle adjustment

    python examples/pycolmap_pipeline.py IMAGES OUT [FOCAL_LENGTH_PX]

OUT then holds database.db, located/ (the seeded model with report.html and tables) and sparse/0, adjusted.
Matching and bundle adjustment are pycolmap's, and may be exchanged for yours (`sfm_shapefit.map_database` is
all of it after matching, in one call). To try it on drawn images:

    sfm-shapefit synth drawn --shape facade --num-images 8 --images
    python examples/pycolmap_pipeline.py drawn/images result 500
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


def average_rotations(database: Path) -> pycolmap.Reconstruction:
    """Return a model whose rotations are averaged over the verified pairs; its centers mean nothing."""
    relative = sfm_shapefit.relative_rotations(database)
    sound = relative.are_sound()
    averaged = sfm_shapefit.average_rotations(
        relative.pairs[sound],
        relative.rotations[sound],
        relative.information[sound],
        num_images=len(relative.names),
        weights=(relative.num_matches * relative.weight_shares)[sound],
    )
    print(averaged.statement)
    with pycolmap.Database.open(database) as opened:
        cache = pycolmap.DatabaseCache.create(opened, pycolmap.DatabaseCacheOptions(min_num_matches=15))
    model = pycolmap.Reconstruction()
    model.load(cache)
    for name, is_in, rotation in zip(relative.names, averaged.registered, averaged.rotations, strict=True):
        image = model.find_image_with_name(name)
        if is_in and image is not None:
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), [0.0, 0.0, 0.0])
            model.frame(image.frame_id).set_cam_from_world(image.camera_id, pose)
            model.register_frame(image.frame_id)
    return model


def main(images: Path, out: Path, focal_length_px: float | None = None) -> pycolmap.Reconstruction:
    """Run the pipeline and return the adjusted model."""
    out.mkdir(parents=True)
    database = out / "database.db"
    match(images, database, focal_length_px)
    rotations = average_rotations(database)

    # Averaged rotations are a few tenths of a degree off; the adjustment after placing finds that out itself.
    found = sfm_shapefit.locate(rotations, database)
    sfm_shapefit.write_result(found, out / "located")
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
    main(Path(sys.argv[1]), Path(sys.argv[2]), *(float(number) for number in sys.argv[3:4]))
