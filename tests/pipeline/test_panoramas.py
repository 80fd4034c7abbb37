"""Panoramas: beside photographs, in rigs with them, across the seam, with marks of control points."""

import pycolmap
import pytest

import sfm_shapefit
from tests.lens_scene import camera_of_model, write_scene

MOST_OFF = 0.02  # as in tests/cli/test_every_lens.py


@pytest.mark.parametrize("prior", [False, True])
@pytest.mark.parametrize("rig", [False, True])
def test_panoramas_and_photographs_are_placed_together(tmp_path, rig, prior):
    cameras = [camera_of_model("EQUIRECTANGULAR"), camera_of_model("PINHOLE", 2)]
    cameras[0].has_prior_focal_length = prior  # which says nothing, as there is none
    truth = write_scene(tmp_path, cameras, num_frames=8, rig=rig)
    for found in (
        sfm_shapefit.map_database(tmp_path / "database.db").models[0].reconstruction,
        sfm_shapefit.locate(tmp_path / "sparse/0"),
    ):
        errors = sfm_shapefit.evaluate(found, truth)
        assert len(errors.names) == truth.num_images()
        assert errors.position.max < MOST_OFF
    averaged = sfm_shapefit.average_database(tmp_path / "database.db")
    assert averaged.num_reg_images() == truth.num_images()


def test_what_stands_at_the_seam_of_a_panorama_is_seen_from_both_sides_of_it(tmp_path):
    write_scene(tmp_path, [camera_of_model("EQUIRECTANGULAR")], behind=True)
    found = sfm_shapefit.locate(tmp_path / "sparse/0")
    truth = pycolmap.Reconstruction(tmp_path / "sparse/0")
    assert sfm_shapefit.evaluate(found, truth).position.max < MOST_OFF
    columns = [
        p.xy[0] for image in found.reconstruction.images.values() for p in image.points2D if p.has_point3D()
    ]
    assert min(columns) < 20.0
    assert max(columns) > 1180.0
    assert found.reconstruction.compute_num_observations() >= 0.99 * truth.compute_num_observations()
    assert sfm_shapefit.check(truth).quality.errors_px.max() < 1.0


def test_marks_of_control_points_count_behind_a_panorama_too(tmp_path):
    truth = write_scene(tmp_path, [camera_of_model("EQUIRECTANGULAR")], behind=True)
    lines = ["local"]
    for point in (truth.point3D(i) for i in (1, 20, 40, 60, 80)):
        for element in point.track.elements:
            image = truth.image(element.image_id)
            x, y = image.point2D(element.point2D_idx).xy
            lines.append(" ".join(map(str, (*point.xyz, x, y, image.name, f"p{point.xyz[0]:g}"))))
    (tmp_path / "marks.txt").write_text("\n".join(lines), encoding="utf-8")
    found = sfm_shapefit.map_database(tmp_path / "database.db", control_points=str(tmp_path / "marks.txt"))
    points = found.models[0].facts.control_points
    assert [(point.num_agreeing_marks, point.num_marks) for point in points] == 5 * [(6, 6)]
    for image in found.reconstruction.images.values():
        off = image.projection_center() - truth.find_image_with_name(image.name).projection_center()
        assert abs(off).max() < 3.0 * MOST_OFF  # as five points of such marks set all axes


def test_nothing_is_said_of_a_focal_length_of_panoramas(tmp_path):
    write_scene(tmp_path, [camera_of_model("EQUIRECTANGULAR"), camera_of_model("PINHOLE", 2)], num_frames=8)
    found = sfm_shapefit.map_database(tmp_path / "database.db", intrinsics="all").models[0]
    assert [row.camera for row in found.facts.intrinsics] == [2]
