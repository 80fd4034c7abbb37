"""`check MODEL --images FOLDER`: pictures asked where there is no database, on drawn photographs."""

import shutil

import numpy as np
import pycolmap
import pytest

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.commands.check import check
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.judgement.chosen_pairs import Shared, choose_pairs
from sfm_shapefit.judgement.reasons import Grade
from sfm_shapefit.synthetic import RenderOptions, SceneOptions, WorkspaceOptions, make_rendered_scene
from sfm_shapefit.synthetic.rendered_workspace import write_rendered_workspace
from tests.program import run, run_refused
from tests.scenes import RING, fingerprint

OPTIONS = SceneOptions(shape="facade", num_images=8, image_width=240, image_height=180, focal_length_px=210.0)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """A folder with photographs and their true poses, without points or database."""
    folder = tmp_path_factory.mktemp("drawn") / "scene"
    write_rendered_workspace(make_rendered_scene(OPTIONS), folder, WorkspaceOptions(database=False))
    return folder


def moved(folder, names, shift):
    """The model with some cameras shifted."""
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    for image in model.images.values():
        if image.name in names:
            pose = image.frame.rig_from_world
            image.frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + shift)
    return model


def test_poses_alone_are_good_by_their_pictures_and_nothing_is_written(drawn):
    before = fingerprint(drawn)
    result = run("check", drawn / "sparse" / "0", "--images", drawn / "images", "--no-second-opinion", code=0)
    assert "verdict: good" in result.output
    assert "8 of 8 pictures in" in result.output
    assert "near in pose" in result.output
    assert f"map {drawn / 'images'} mapped" in result.output  # the next step knows the folder
    assert fingerprint(drawn) == before


def test_a_camera_that_was_moved_is_named_and_a_part_that_was_is_not_to_be_used(drawn):
    names = sorted(path.name for path in (drawn / "images").iterdir())
    alone = check(moved(drawn, names[3:4], [0.5, 0.0, 0.0]), images=drawn / "images", second_opinion=False)
    assert alone.verdict.cameras == (names[3],)
    part = check(moved(drawn, names[:3], [1.0, 0.5, 0.0]), images=drawn / "images", second_opinion=False)
    assert part.verdict.is_bad
    assert part.facts.inputs.database is None  # it was made for this run alone


def test_sides_that_are_alike_make_a_sound_model_one_to_look_at_and_a_folded_one_no_better(tmp_path):
    size = {"image_width": 320, "image_height": 240, "focal_length_px": 280.0}
    tower = make_rendered_scene(
        SceneOptions(shape="ring", num_images=14, seed=3, **size), RenderOptions(repeated_fraction=0.5)
    )
    write_rendered_workspace(tower, tmp_path / "tower", WorkspaceOptions(database=False))
    model, images = tmp_path / "tower" / "sparse" / "0", tmp_path / "tower" / "images"
    sound = check(model, images=images, second_opinion=False).verdict
    assert sound.grade is Grade.LOOK
    assert "neighbors do not" in sound.reasons[0]
    folded = pycolmap.Reconstruction(model)
    quarter = pycolmap.Rigid3d(pycolmap.Rotation3d(np.sqrt([0.0, 0.0, 0.5, 0.5])), np.zeros(3))
    for image in list(folded.images.values())[7:]:  # half of the cameras a quarter around the tower
        image.frame.rig_from_world = image.frame.rig_from_world * quarter
    assert check(folded, images=images, second_opinion=False).verdict.grade is not Grade.GOOD


def test_pictures_of_another_size_or_shape_or_lost_are_counted(drawn, tmp_path):
    names = sorted(path.name for path in (drawn / "images").iterdir())
    inner = tmp_path / "half"
    inner.mkdir()
    for name in names[2:]:
        picture = pycolmap.Bitmap.read(drawn / "images" / name, True)
        picture.rescale(270, 202)
        picture.write(inner / name)
    (inner / names[2]).write_bytes(b"no picture")
    narrow = pycolmap.Bitmap.read(drawn / "images" / names[3], True)
    narrow.rescale(180, 270)
    narrow.write(inner / names[3])
    found = check(drawn / "sparse" / "0", images=tmp_path, second_opinion=False)  # in a subfolder
    directions = found.facts.inputs.directions
    assert directions.startswith("4 of 8 pictures")
    for part in ("2 missing", "1 unreadable", "1 of another shape"):
        assert part in directions
    assert not found.verdict.cameras  # who was not asked is not weak


def test_names_of_any_bytes_and_with_spaces_are_asked(drawn, tmp_path):
    model, images = moved(drawn, [], np.zeros(3)), tmp_path / "images"
    shutil.copytree(drawn / "images", images)
    for image, name in zip(model.images.values(), (b"a b.jpg", b"b\xff.jpg"), strict=False):
        (images / image.name).rename(images / name.decode("utf-8", "surrogateescape"))
        image.name = name
    found = check(model, images=images, second_opinion=False)
    assert found.facts.inputs.directions.startswith("8 of 8 pictures")
    assert found.verdict.statement == "good"


def test_what_cannot_be_asked_is_said_in_one_sentence(drawn, tmp_path):
    model = drawn / "sparse" / "0"
    assert "has no two pictures of this model (8 missing)" in run_refused(
        "check", model, "--images", tmp_path
    )
    assert "is no folder" in run_refused("check", model, "--images", tmp_path / "none")
    assert "name their folder" in run_refused("check", model, "--max-minutes", "1")
    beside = run_refused("check", RING / "sparse" / "0", "--images", drawn / "images")
    assert "its matches are used and the images are not matched anew" in beside
    with pytest.raises(InputError, match="max_minutes"):
        check(model, images=drawn / "images", max_minutes=-1.0)


def test_when_the_minutes_are_over_the_rest_is_not_asked(drawn, monkeypatch):
    monkeypatch.setattr("sfm_shapefit.files.colmap.picture_matches._PICTURES_AT_ONCE", 4)
    monkeypatch.setattr("sfm_shapefit.files.colmap.picture_matches._PAIRS_AT_ONCE", 2)
    found = check(drawn / "sparse" / "0", images=drawn / "images", max_minutes=1e-6, second_opinion=False)
    assert "4 of 8 pictures (4 not asked)" in found.facts.inputs.directions
    assert "2 of 6 chosen pairs" in found.facts.inputs.directions


def test_pairs_are_chosen_across_the_weakest_link_and_between_alike_pictures():
    images = read_model(RING / "sparse" / "0").images
    count, rng = images.num_images, np.random.default_rng(0)
    described = [rng.integers(0, 256, (60, 128)) for _ in range(count)]
    described[5] = described[0]  # far apart, and the same picture
    halves = np.array([(i, j) for i in range(count) for j in range(i + 1, count) if (i < 4) == (j < 4)])
    chosen = choose_pairs(images, Shared(halves, np.full(len(halves), 100)), described)
    pairs = list(map(tuple, chosen.pairs.tolist()))
    assert len(set(pairs)) == len(pairs) == len(chosen.reasons)
    assert all(i < j for i, j in pairs)
    assert (0, 5) in pairs
    across = [pair for pair, reason in zip(pairs, chosen.reasons, strict=True) if reason == "seams"]
    assert across
    assert all((i < 4) != (j < 4) for i, j in across)
    assert {tuple(pair) for pair in pairs} >= {(0, 1), (4, 5)}
