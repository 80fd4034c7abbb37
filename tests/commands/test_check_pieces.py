"""`check` of lenses and places that cannot be, and of a folder that holds several models."""

import json
import shutil

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.files.colmap.quiet import quiet_log
from sfm_shapefit.judgement.reasons import Grade
from tests.facts.test_schema import problems
from tests.models import centers_of, posed
from tests.program import run, run_refused
from tests.scenes import RING

MODEL = RING / "sparse" / "0"
BENT = (-1.4, 2.0)  # k1, and focal length in picture widths: an endoscope's video that COLMAP misjudged


def with_own_lenses(chosen, focal=1.0):
    """The ring with a lens for each image, adjusted; those of the images `chosen` by place are bent."""
    truth, model = pycolmap.Reconstruction(MODEL), pycolmap.Reconstruction()
    for k, image_id in enumerate(sorted(truth.reg_image_ids())):
        image = truth.image(image_id)
        given = image.camera
        k1, widths = BENT if k in chosen else (0.0, focal * given.mean_focal_length() / given.width)
        lens = [widths * given.width, given.principal_point_x, given.principal_point_y, k1]
        camera = pycolmap.Camera(
            model="SIMPLE_RADIAL", width=given.width, height=given.height, params=lens, camera_id=k + 1
        )
        model.add_camera_with_trivial_rig(camera)
        copy = pycolmap.Image(name=image.name, camera_id=k + 1, image_id=image_id)
        copy.points2D = pycolmap.Point2DList([pycolmap.Point2D(point.xy) for point in image.points2D])
        model.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point in truth.points3D.values():
        model.add_point3D(point.xyz, point.track, point.color)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    with quiet_log():
        pycolmap.bundle_adjustment(model, options)
    return model


def judged(model):
    return sfm_shapefit.check(model, second_opinion=False).facts


@pytest.mark.parametrize("num", [0, 1, 4, 8])
def test_lenses_that_cannot_be_are_named_and_many_of_them_forbid_the_use(num):
    model = with_own_lenses(range(num))
    facts = judged(model)
    named = [name for one in facts.evidence.odd if one.cannot_be for name in one.images]
    assert sorted(named) == sorted(model.image(i).name for i in model.reg_image_ids())[:num]
    assert set(named) <= set(facts.verdict.cameras)
    told = [one for one in facts.verdict.findings if "impossible lens: focal length 2.00" in one.sentence]
    assert {name for one in told for name in one.images} == set(named)
    assert (Grade.DO_NOT_USE in {one.grade for one in told}) == (num > 1)
    assert problems(facts.summary(), "check") == []


def test_locate_says_the_same_of_lenses_as_check():
    found = sfm_shapefit.locate(with_own_lenses(range(2)))
    assert found.verdict.grade is Grade.DO_NOT_USE
    assert [one.cannot_be for one in found.evidence.odd] == [True]


def test_a_camera_that_flies_off_is_named_with_how_far():
    center = centers_of(pycolmap.Reconstruction(MODEL))
    spread = np.median(np.linalg.norm(center - np.median(center, axis=0), axis=1))

    def away(name, rotation, place):
        return rotation, place + (1000.0 * spread if name == "0003.jpg" else 0.0)

    facts = judged(posed(MODEL, away))
    (odd,) = facts.evidence.odd
    assert odd.images == ("0003.jpg",)
    assert "times as far out" in odd.statement
    assert facts.verdict.grade is not Grade.GOOD
    assert "0003.jpg" in facts.verdict.cameras


def pieces(folder, *models):
    for k, model in enumerate(models):
        (folder / str(k)).mkdir()
        model.write(folder / str(k))
    return folder


def test_several_models_get_one_table_and_what_contradicts_is_said(tmp_path):
    folder = pieces(tmp_path, with_own_lenses([]), with_own_lenses([], 1.5), with_own_lenses(range(8)))
    (folder / "10").mkdir()
    (folder / "10" / "images.bin").write_bytes(b"")
    strict = run("check", folder, "--json", "--strict", "--no-second-opinion", code=4)
    assert "own tracks" in strict.stderr  # for which the first would be good
    found = json.loads(strict.stdout)
    assert problems(found, "check_pieces") == []
    assert [one["folder"] for one in found["pieces"]] == [str(folder / k) for k in ("0", "1", "2", "10")]
    assert [one["keep"] for one in found["pieces"]] == [True, False, False, False]
    assert found["pieces"][2]["facts"]["verdict"]["grade"] == "do not use"
    assert found["pieces"][3]["error"]
    assert any("of 2 in 2" in one and "0.833 picture widths in 0" in one for one in found["contradictions"])
    assert any("0 and 1 have 8 images in common" in one for one in found["contradictions"])
    said = run("check", folder, "--no-second-opinion", code=0).stdout
    assert f"keep: {folder / '0'}" in said
    assert "cannot be read" in said
    assert f" workspace {folder / '0'} " in said.splitlines()[-1]


def test_where_no_model_can_be_used_nothing_is_to_be_kept(tmp_path):
    folder = pieces(tmp_path, with_own_lenses(range(8)))
    shutil.copytree(folder / "0", folder / "1")
    said = run("check", folder, "--no-second-opinion", "--strict", code=4).stdout
    assert "keep: none" in said
    assert "a single model" in run_refused("check", folder, "--report", tmp_path / "page.html")
    with pytest.raises(sfm_shapefit.InputError, match="give a folder of several"):
        sfm_shapefit.check_pieces(folder / "0")
