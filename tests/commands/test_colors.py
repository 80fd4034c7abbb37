"""Points have the colors of the pictures that see them, as pycolmap's own have."""

import cv2
import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from tests.program import run
from tests.scenes import RING

GRAIN = 8  # pixels of a color; noise of single pixels would make all means gray


@pytest.fixture
def pictures(tmp_path):
    """Return a folder with a picture of noise for each image of the ring, one of them half as large."""
    rng, folder = np.random.default_rng(0), tmp_path / "pictures"
    folder.mkdir()
    model = pycolmap.Reconstruction(RING / "sparse/0")
    for image in model.images.values():
        camera = model.camera(image.camera_id)
        noise = rng.integers(
            1, 256, (camera.height // GRAIN + 1, camera.width // GRAIN + 1, 3), dtype=np.uint8
        )
        noise = noise.repeat(GRAIN, axis=0).repeat(GRAIN, axis=1)[: camera.height, : camera.width]
        assert cv2.imwrite(str(folder / image.name), noise)
    return folder


def colors_of(model):
    return {k: tuple(point.color.tolist()) for k, point in model.points3D.items()}


def test_the_colors_of_written_models_are_those_of_pycolmap(ring_mapped, pictures, tmp_path):
    assert {*colors_of(ring_mapped.models[0].reconstruction).values()} == {(0, 0, 0)}
    ring_mapped.write(tmp_path / "out", images=pictures)
    written = pycolmap.Reconstruction(tmp_path / "out/0")
    theirs = pycolmap.Reconstruction(written)
    theirs.extract_colors_for_all_images(pictures)
    assert len({*colors_of(written).values()}) > 100
    assert colors_of(written) == colors_of(theirs)
    models = sfm_shapefit.global_mapping(RING / "database.db", pictures, tmp_path / "models")
    assert colors_of(models[0]) == colors_of(pycolmap.Reconstruction(tmp_path / "models/0"))
    assert len({*colors_of(models[0]).values()}) > 100


def test_smaller_pictures_give_the_colors_of_the_same_places(ring_located, pictures, tmp_path):
    whole, half = tmp_path / "whole", tmp_path / "half"
    ring_located.write(whole, images=pictures)
    for file in pictures.iterdir():
        picture = cv2.imread(str(file))
        cv2.imwrite(str(file), cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    ring_located.write(half, images=pictures)
    one, other = (
        np.array([*colors_of(pycolmap.Reconstruction(f)).values()], dtype=float) for f in (whole, half)
    )
    correlation = np.corrcoef(one.ravel(), other.ravel())[0, 1]
    assert correlation > 0.9  # places elsewhere are independent


def test_missing_and_broken_pictures_are_told_and_points_have_the_colors_of_the_others(pictures, tmp_path):
    names = sorted(path.name for path in pictures.iterdir())
    (pictures / names[0]).unlink()
    (pictures / names[1]).write_bytes(b"no picture")
    done = run("map", RING / "database.db", tmp_path / "out", "--images", pictures, code=0)
    assert f"warning: {pictures} lacks 1 of 8 images: is it the right folder?" in done.stdout
    assert f"warning: 1 picture in {pictures} cannot be read: {names[1]}" in done.stdout
    assert "colors:" not in done.stdout
    model = pycolmap.Reconstruction(tmp_path / "out/0")
    ids = {image.image_id for image in model.images.values() if image.name in names[:2]}
    for point in model.points3D.values():
        seen = {element.image_id for element in point.track.elements}
        assert bool(point.color.any()) == bool(seen - ids)
    said = run("map", RING / "database.db", tmp_path / "bare", code=0).stdout
    assert "colors: the points have none; --images FOLDER takes them from the images\n" in said


def test_colors_of_the_input_stay_and_a_model_that_the_user_changed_is_colored_as_it_is(pictures, tmp_path):
    found = sfm_shapefit.map_database(RING / "database.db").models[0]
    model = pycolmap.Reconstruction(found.reconstruction)
    for point in model.points3D.values():
        point.color = np.array([1, 2, 3], dtype=np.uint8)
    found = sfm_shapefit.locate(model, RING / "database.db")
    found.write(tmp_path / "kept", images=pictures)
    kept = colors_of(pycolmap.Reconstruction(tmp_path / "kept"))
    assert (1, 2, 3) in kept.values()
    assert (0, 0, 0) not in kept.values()
    found = sfm_shapefit.map_database(RING / "database.db").models[0]
    gone = min(found.reconstruction.point3D_ids())
    found.reconstruction.delete_point3D(gone)
    found.write(tmp_path / "changed", images=pictures)
    changed = colors_of(pycolmap.Reconstruction(tmp_path / "changed"))
    assert gone not in changed
    assert (0, 0, 0) not in changed.values()
    assert {*colors_of(found.reconstruction).values()} == {(0, 0, 0)}  # the user's stays as it is


def test_joined_models_have_colors(pictures, tmp_path):
    model = pycolmap.Reconstruction(RING / "sparse/0")
    parts = []
    for left_out in ((1, 2), (5, 6)):
        part = pycolmap.Reconstruction(model)
        for image_id in left_out:
            part.deregister_frame(part.image(image_id).frame_id)
        for point in part.points3D.values():
            point.color = np.zeros(3, dtype=np.uint8)
        parts.append(part)
    joined = sfm_shapefit.join(parts, RING / "database.db")
    joined.write(tmp_path / "joined", images=pictures)
    assert (0, 0, 0) not in colors_of(pycolmap.Reconstruction(tmp_path / "joined")).values()
