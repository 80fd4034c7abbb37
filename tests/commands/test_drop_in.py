"""What other pipelines call has pycolmap's signature and answer, and results serve as models."""

import inspect
import re
import shutil

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.synthetic.fixtures import assert_reconstruction_near
from tests.scenes import BUNDLED, COURTYARD, PHOTOGRAPHED, RING


def test_global_mapping_is_called_and_answers_as_pycolmaps(tmp_path):
    theirs = re.findall(r"(\w+): ", pycolmap.global_mapping.__doc__.partition(" -> ")[0])
    assert list(inspect.signature(sfm_shapefit.global_mapping).parameters) == [*theirs, "others"]
    out = tmp_path / "models"
    out.mkdir()  # as scripts do for pycolmap
    models = sfm_shapefit.global_mapping(PHOTOGRAPHED / "database.db", "", out)
    assert list(models) == [0]
    assert isinstance(models[0], pycolmap.Reconstruction)
    assert_reconstruction_near(models[0], PHOTOGRAPHED / "truth", max_median_error=0.02)
    assert_reconstruction_near(out / "0", models[0], max_error=1e-12)
    theirs = pycolmap.GlobalPipelineOptions()
    theirs.num_threads, theirs.min_model_size = 1, 17
    with pytest.raises(sfm_shapefit.UnsolvableError, match="needs 17"):
        sfm_shapefit.global_mapping(RING / "database.db", "", out, theirs)
    sfm_shapefit.global_mapping(RING / "database.db", "", out, {"adjust": "none"})  # replaces what it wrote
    assert pycolmap.Reconstruction(out / "0").num_reg_images() == 8
    with pytest.raises(TypeError, match="did you mean min_trust"):
        sfm_shapefit.global_mapping(RING / "database.db", "", out, {"min_trsut": 0.5})


def test_lenses_that_pycolmap_is_to_keep_are_kept_and_options_without_counterpart_are_named(tmp_path):
    guessed = tmp_path / "database.db"
    shutil.copyfile(RING / "database.db", guessed)
    with pycolmap.Database.open(guessed) as database:
        for camera in database.read_all_cameras():
            camera.has_prior_focal_length, camera.params = False, camera.params * [1.02, 1.02, 1.0, 1.0]
            database.update_camera(camera)
        focal = camera.focal_length_x
    globally, grown = pycolmap.GlobalPipelineOptions(), pycolmap.IncrementalPipelineOptions()
    globally.random_seed, globally.mapper.bundle_adjustment.ceres.use_gpu = 3, False  # need nothing here
    globally.mapper.bundle_adjustment.refine_focal_length = False
    grown.ba_refine_focal_length = grown.ba_refine_extra_params = grown.multiple_models = False
    models = [sfm_shapefit.global_mapping(guessed, "", tmp_path / "free")]
    models.append(sfm_shapefit.global_mapping(guessed, "", tmp_path / "global", globally))
    with pytest.warns(UserWarning, match=r"have no effect: multiple_models=False; help"):
        models.append(sfm_shapefit.global_mapping(guessed, "", tmp_path / "grown", grown, input_path=""))
    fixed = pycolmap.IncrementalPipelineOptions(constant_cameras={camera.camera_id}, constant_rigs={1})
    models.append(sfm_shapefit.global_mapping(guessed, "", tmp_path / "fixed", fixed))
    fixed.constant_cameras = {camera.camera_id + 1}
    with pytest.raises(InputError, match="lacks 1 camera of the database, such as"):
        sfm_shapefit.global_mapping(guessed, "", tmp_path / "fixed", fixed)
    free, *held = [next(iter(model[0].cameras.values())).focal_length_x for model in models]
    assert held == [focal, focal, focal]
    assert abs(free - focal) > 0.01 * focal


def test_priors_and_gravity_of_the_database_are_taken_where_pycolmap_is_to_take_them(tmp_path):
    measured = tmp_path / "database.db"
    shutil.copyfile(RING / "database.db", measured)
    truth = pycolmap.Reconstruction(RING / "sparse/0")
    with pycolmap.Database.open(measured) as database:
        for image in database.read_all_images():
            known = truth.find_image_with_name(image.name)
            down = known.cam_from_world().rotation.matrix() @ [0.0, 0.0, -1.0]
            prior = pycolmap.PosePrior(position=2.0 * known.projection_center(), gravity=down)
            prior.coordinate_system, prior.corr_data_id = (
                pycolmap.PosePriorCoordinateSystem.CARTESIAN,
                image.data_id,
            )
            database.write_pose_prior(prior)
    placed, upright = pycolmap.IncrementalPipelineOptions(), pycolmap.GlobalPipelineOptions()
    placed.use_prior_position = upright.mapper.rotation_averaging.use_gravity = True
    model = sfm_shapefit.global_mapping(measured, "", tmp_path / "placed", placed)[0]
    for image in model.images.values():
        known = 2.0 * truth.find_image_with_name(image.name).projection_center()
        np.testing.assert_allclose(image.projection_center(), known, atol=1e-3)
    model = sfm_shapefit.global_mapping(measured, "", tmp_path / "upright", upright)[0]
    for image in model.images.values():
        up = truth.find_image_with_name(image.name).cam_from_world().rotation.matrix()[:, 2]
        np.testing.assert_allclose(image.cam_from_world().rotation.matrix()[:, 2], up, atol=1e-4)


@pytest.mark.parametrize(
    ("kind", "options", "others", "message"),
    [
        (InputError, pycolmap.GlobalPipelineOptions(image_names=["a.jpg"]), {}, "image_names is not taken"),
        (
            TypeError,
            pycolmap.BundleAdjustmentOptions(),
            {},
            "options must be .*got a BundleAdjustmentOptions",
        ),
        (TypeError, sfm_shapefit.LocateOptions(), {}, "options must be MapOptions.*got a LocateOptions"),
        (TypeError, None, {"input_path": "sparse"}, "takes no input_path: no model is continued; `locate"),
        (TypeError, None, {"next_image_callback": print}, "takes no next_image_callback: .*`progress`"),
        (TypeError, None, {"ouput": None}, "takes no ouput: it has no such argument"),
    ],
)
def test_options_and_arguments_that_would_be_ignored_are_refused(tmp_path, kind, options, others, message):
    with pytest.raises(kind, match=message):
        sfm_shapefit.global_mapping(RING / "database.db", "", tmp_path / "out", options, **others)
    assert not (tmp_path / "out").exists()


def test_average_database_is_a_model_with_rotations_alone():
    model = sfm_shapefit.average_database(COURTYARD / "database.db")
    truth = pycolmap.Reconstruction(COURTYARD / "truth")
    assert (model.num_reg_images(), model.num_points3D()) == (25, 0)
    turns = []
    for image in model.images.values():
        assert np.linalg.norm(image.projection_center()) == 0.0
        right = truth.find_image_with_name(image.name).cam_from_world().rotation
        turns.append((image.cam_from_world().rotation.inverse() * right).matrix())
    off_deg = [np.degrees(pycolmap.Rotation3d(turns[0].T @ turn).angle()) for turn in turns]
    assert np.median(off_deg) < 1.0


def test_a_result_serves_wherever_a_model_does(tmp_path, ring_located, ring_mapped):
    found, mapped = ring_located, ring_mapped
    assert found.verdict.grade == "good"
    assert sfm_shapefit.evaluate(found, RING / "sparse/0").position.max < 1e-6
    checked = sfm_shapefit.check(found, second_opinion=mapped)
    assert checked.facts.inputs.database == str(found.database)  # not the tracks, which agree more easily
    assert sfm_shapefit.inspect(found).num_images == 8
    assert sfm_shapefit.convert(found, tmp_path / "poses.csv") == tmp_path / "poses.csv"
    assert len(sfm_shapefit.bundle_adjust(found).frame_ids) == 8
    assert len(sfm_shapefit.bundle_adjust(RING / "sparse/0").frame_ids) == 8
    assert sfm_shapefit.locate(found).reconstruction.num_reg_images() == 8
    assert sfm_shapefit.evaluate(mapped, found).position.max < 1e-4
    assert sfm_shapefit.evaluate(mapped.models[0], found).position.max < 1e-4


def test_a_graph_is_placed_from_its_file_and_is_no_model():
    placed = sfm_shapefit.place(BUNDLED / "graph40.txt")
    assert len(placed.cameras) == 40
    with pytest.raises(sfm_shapefit.InputError, match="or a result; got PlacedGraph"):
        sfm_shapefit.evaluate(placed, RING / "sparse/0")


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: sfm_shapefit.locate(42), "a model is a folder, a reconstruction or a result; got int"),
        (lambda: sfm_shapefit.locate(RING / "database.db"), "in Python `map_database`, makes a model"),
        (lambda: sfm_shapefit.map_database(RING / "sparse"), "with `match_images`"),
        (lambda: sfm_shapefit.map_database(RING, images="x"), r"written: found\.write\(folder, images="),
        (
            lambda: sfm_shapefit.workspace(RING / "sparse/0", RING, "o", mask_path="no"),
            "no is no folder.*masks",
        ),
        (lambda: sfm_shapefit.match_images(RING, "o", mask_path="no"), "no is no folder.*masks"),
    ],
)
def test_what_cannot_serve_is_refused_in_words_of_python(call, said):
    with pytest.raises((sfm_shapefit.InputError, TypeError), match=said):
        call()


def test_a_mapped_result_is_no_list_of_models(ring_mapped):
    with pytest.raises(sfm_shapefit.InputError, match="in a list; those of `map_database` are its `models`"):
        sfm_shapefit.join(ring_mapped)


def test_results_write_themselves_and_show_at_most_twenty_attributes(tmp_path, ring_mapped):
    found, mapped = sfm_shapefit.locate(RING / "sparse/0"), ring_mapped
    checked = sfm_shapefit.check(RING / "sparse/0", second_opinion=mapped)
    for result in (found, mapped):
        assert len(dir(result)) <= 20
        assert all(hasattr(result, name) for name in dir(result))
        assert not any(name.startswith("_") for name in dir(result))
    assert found.write(tmp_path / "out") == tmp_path / "out"
    assert mapped.write(str(tmp_path / "models"), report=False) == tmp_path / "models"
    assert pycolmap.Reconstruction(tmp_path / "out").num_reg_images() == 8
    assert not (tmp_path / "models/0/report.html").exists()
    found.reconstruction.deregister_frame(found.reconstruction.image(1).frame_id)
    found.write(tmp_path / "out", overwrite=True)
    assert pycolmap.Reconstruction(tmp_path / "out").num_reg_images() == 7
    for name, result in {"found": found, "mapped": mapped, "checked": checked}.items():
        assert result.report(tmp_path / f"{name}.html") == tmp_path / f"{name}.html"
        assert "report" in (tmp_path / f"{name}.html").read_text(encoding="utf-8")
        with pytest.raises(InputError, match="exists already"):
            result.report(tmp_path / f"{name}.html")
    with pytest.raises(InputError, match="none of the images"):
        found.report(tmp_path / "pictures.html", images=tmp_path)


def test_a_result_of_map_has_what_its_largest_model_has_and_each_model_is_as_of_locate(ring_mapped):
    (model,) = ring_mapped.models
    assert isinstance(model, sfm_shapefit.LocateResult)
    assert (ring_mapped.cameras, ring_mapped.pairs) == (model.cameras, model.pairs)
    assert ring_mapped.verdict.grade == model.verdict.grade == "good"
    assert list(ring_mapped.table("cameras")["name"]) == [row.name for row in model.cameras]
    assert model.averaging.registered.all()
    assert sfm_shapefit.evaluate(ring_mapped, RING / "sparse" / "0").position.max < 1e-3
    assert max(len(repr(one)) for one in (ring_mapped, model)) < 80


def test_what_only_the_method_needs_of_a_pair_stands_apart_and_in_the_table(ring_mapped, tmp_path):
    pair = ring_mapped.pairs[0]
    assert "scores" not in repr(pair)
    assert 0.0 < pair.scores.posterior <= 1.0
    columns = ring_mapped.table("pairs")
    ring_mapped.write(tmp_path / "out", report=False)
    header = (tmp_path / "out" / "0" / "pairs.csv").read_text().splitlines()[0].split(",")
    assert list(columns) == header
    scores = {"weight", "dual_norm", "leverage", "triplet_score", "matched_share", "pair_score", "posterior"}
    assert scores <= {*header}
    assert columns["posterior"][0] == pair.scores.posterior
    assert columns["posterior"].dtype == float
