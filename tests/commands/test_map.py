"""`map`: from a database alone to models, one for each component, with rotations the matches agree with."""

import dataclasses
import json

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

import sfm_shapefit
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.facts.intrinsics import describe_intrinsics
from sfm_shapefit.facts.scene import describe_line, describe_loops
from sfm_shapefit.files.colmap.merge import merge_models
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.pair_list import read_pair_list
from sfm_shapefit.pipeline import examination as evidence
from sfm_shapefit.pipeline.relative_rotations import measure_rotations
from sfm_shapefit.report.drawing import PairClass
from sfm_shapefit.report.first_screen import banner
from sfm_shapefit.report.results import draw_joined
from sfm_shapefit.synthetic import SceneOptions, layouts, make_scene
from sfm_shapefit.synthetic.workspace import write_workspace
from tests.abuse import determinism
from tests.facts.test_schema import problems
from tests.models import by_name, write_priors
from tests.pipeline.made import PAIR, keep_few_matches
from tests.program import run
from tests.scenes import COURTYARD, RING, copied, edit_database, fingerprint, rows_of

PAIRS = "DELETE FROM two_view_geometries WHERE"
ACROSS = f"(pair_id / {PAIR} <= 4) != (pair_id % {PAIR} <= 4)"
"""Pairs between the first four images of the ring and the others."""
FAST = {"points": "never"}


def changed(scene, folder, *statements):
    """A copy of a scene's database after some SQL."""
    return edit_database(copied(scene, folder) / "database.db", *statements)


@pytest.fixture(scope="module")
def by_pairs():
    """The courtyard, placed by pairs alone."""
    before = fingerprint(COURTYARD)
    found = sfm_shapefit.map_database(COURTYARD / "database.db", sfm_shapefit.MapOptions(**FAST))
    assert fingerprint(COURTYARD) == before
    return found


def test_the_courtyard_is_mapped_from_its_database_alone(tmp_path, by_pairs):
    found = by_pairs
    (model,) = found.models
    assert (found.num_placed, found.left_out, found.warnings) == (25, {}, ())
    errors = sfm_shapefit.evaluate(model.reconstruction, COURTYARD / "truth")
    assert errors.position.max < 0.005 * errors.extent  # measured 0.0007; a quarter of the pairs is false
    assert errors.rotation_deg.max < 0.2
    sfm_shapefit.write_result(found, tmp_path / "out")
    assert read_model(tmp_path / "out" / "0").images.num_images == 25
    assert (tmp_path / "out" / "0" / "cameras.csv").is_file()
    facts = json.loads((tmp_path / "out" / "map.json").read_text())
    assert facts["num_placed"] == facts["models"][0]["num_placed"] == 25
    # The pairs whose baselines were made false are told by the matches that are missing in their overlap.
    pairs = {name: np.array(column) for name, column in model.table("pairs").items()}
    false = pairs["residual_deg"] > 10.0
    assert false.sum() > 30
    assert np.nanmax(pairs["pair_score"][false]) < np.nanmedian(pairs["pair_score"][~false])
    assert not (tmp_path / "out" / "0" / "doubtful_pairs.csv").exists()


def test_used_pairs_of_tiny_scores_are_listed_and_can_be_left_out(tmp_path, by_pairs):
    found = by_pairs
    located = found.models[0]
    scores, row = located.scores.copy(), next(r for r in located.pairs if r.verdict == "inlier")
    names = [(pair.name1, pair.name2) for pair in located.pairs]
    scores[names.index((row.name1, row.name2)), 1] = 1e-4
    model = dataclasses.replace(located, scores=scores)
    sfm_shapefit.write_result(dataclasses.replace(found, models=(model,)), tmp_path / "out")
    listed = tmp_path / "out" / "0" / "doubtful_pairs.csv"
    assert read_pair_list(listed, model.averaged_names) == {(row.name1, row.name2)}


def test_priors_set_scale_origin_and_axes_of_the_component_that_has_them(tmp_path):
    truth = read_model(RING / "sparse" / "0").images
    turn = Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix()
    positions = by_name(truth, 2.0 * truth.centers @ turn.T + 100.0)
    table = write_priors(tmp_path / "priors.txt", {name: positions[name] for name in truth.names[4:]})
    found = sfm_shapefit.map_database(changed(RING, tmp_path, f"{PAIRS} {ACROSS}"), priors=table, **FAST)
    scales = {}
    for model in found.models:
        scales[model.averaged_names[0] in truth.names[:4]] = model.gauge.scale
        if model.gauge.scale == "prior":
            images = model.reconstruction.images.values()
            off = [image.projection_center() - positions[image.name] for image in images if image.has_pose]
            # Half a pixel, as far as the placement alone is off; the scene is 20 units across.
            assert len(off) == 4
            assert model.gauge.statement.endswith("origin and axes: theirs")  # there are none of an input
            assert np.abs(off).max() < 0.05
    assert scales == {True: "unit", False: "prior"}


def test_what_is_noteworthy_of_priors_is_told_once_for_all_components(tmp_path):
    truth = read_model(RING / "sparse" / "0").images
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    geodetic = np.asarray(transform.enu_to_ellipsoid(10.0 * truth.centers, 47.3, 8.5, 400.0))
    table = write_priors(tmp_path / "priors.txt", by_name(truth, geodetic))  # no header says what it has
    path = changed(RING, tmp_path, f"{PAIRS} {ACROSS}")
    found = sfm_shapefit.map_database(path, priors=table, join="never", **FAST)
    assert len(found.models) == 2
    told = [*found.warnings, *(warning for model in found.models for warning in model.warnings)]
    assert sum("taken for latitude and longitude in degrees" in warning for warning in told) == 1
    for model in found.models:
        assert model.gauge.datum is not None
        errors = sfm_shapefit.evaluate(model.reconstruction, RING / "sparse" / "0")
        assert errors.ref_from_model.scale == pytest.approx(0.1, rel=0.01)


def test_priors_that_set_no_scale_of_one_component_do_not_refuse_the_others(tmp_path):
    truth = read_model(RING / "sparse" / "0").images
    # The receiver of the first four said the same place all the time.
    positions = np.where(np.arange(8)[:, None] < 4, truth.centers[0], truth.centers)
    table = write_priors(tmp_path / "priors.txt", by_name(truth, positions))
    path = changed(RING, tmp_path, f"{PAIRS} {ACROSS}")
    found = sfm_shapefit.map_database(path, priors=table, join="never", **FAST)
    assert "join" not in found.timings_s
    scales = {model.averaged_names[0] in truth.names[:4]: model for model in found.models}
    assert {is_first: one.gauge.scale for is_first, one in scales.items()} == {True: "unit", False: "prior"}
    assert found.joins == ()
    said = "the scale is not that of position priors: the position priors coincide"
    assert any(warning.startswith(said) for warning in scales[True].warnings)


def test_the_command_adjusts_prints_one_object_and_replaces_only_its_own_output(tmp_path):
    database = RING / "database.db"
    arguments = ["map", database, tmp_path / "out", "--adjust", "full", "--points", "never", "--json"]
    facts = json.loads(run(*arguments, code=0).stdout)
    assert facts["models"][0]["located"]["bundle_adjustment"]["final_error_px"] < 1.0
    errors = sfm_shapefit.evaluate(tmp_path / "out" / "0", RING / "sparse" / "0")
    assert len(errors.names) == 8
    assert errors.position.max < 0.005 * errors.extent
    run(*arguments, code=3)
    run(*arguments, "--overwrite", code=0)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("precious")
    run("map", database, tmp_path / "mine", "--overwrite", code=3)
    run("map", tmp_path / "missing.db", tmp_path / "o", code=3)
    assert not (tmp_path / "o").exists()


def test_the_adjusted_first_placement_is_as_good_as_the_matches_allow(tmp_path):
    """All tracks of so few images are adjusted, as in bundle adjustment: the likeliest answer, but for the
    loss. Averaged rotations are that of pairs, each of which sees its own matches only: every track of k
    images is cut into pairs, and no two of them need agree on a point."""
    size = {"num_images": 10, "num_points": 400, "max_pairs_per_image": 6, "max_keypoints_per_image": 200}
    write_workspace(make_scene(SceneOptions(shape="facade", seed=2, **size)), tmp_path / "made")

    def errors(**options):
        found = sfm_shapefit.map_database(tmp_path / "made" / "database.db", min_trust=0.0, **options)
        compared = sfm_shapefit.evaluate(found.models[0].reconstruction, tmp_path / "made" / "sparse" / "0")
        assert len(compared.names) == 10
        return compared.position.rms, compared.rotation_deg.rms

    coarse, adjusted, likeliest = errors(adjust="none"), errors(), errors(adjust="full")
    for k in range(2):
        assert adjusted[k] < 1.1 * likeliest[k]
        assert adjusted[k] < coarse[k] / 1.5


def test_images_that_see_few_points_are_left_out_with_the_reason_unless_pixels_confirm_them(
    tmp_path, monkeypatch, ring_mapped
):
    everyone = ring_mapped.models[0]
    model = everyone.reconstruction
    counts = {image.name: image.num_points3D for image in model.images.values()}
    assert everyone.kept.all()
    assert everyone.few_points == {}
    poorest = min(counts, key=counts.get)
    limit = counts[poorest] + 1
    found = sfm_shapefit.map_database(RING / "database.db", min_points_per_image=limit).models[0]
    assert found.few_points == {}
    assert {image.name: image.num_points3D for image in found.reconstruction.images.values()} == counts
    monkeypatch.setattr(evidence, "ask_pixels", lambda *given: np.zeros_like(given[-1]))
    out = tmp_path / "out"
    told = run("map", RING / "database.db", out, "--min-points-per-image", limit, "--json", code=0).stdout
    # The others have enough without the observations that the poorest takes along.
    assert json.loads(told)["models"][0]["located"]["few_points"] == {poorest: counts[poorest]}
    written = read_model(out / "0").reconstruction
    kept = {written.image(k).name: written.image(k).num_points3D for k in written.reg_image_ids()}
    assert kept == {name: count for name, count in counts.items() if name != poorest}
    reasons = {row["name"]: row["reason"] for row in rows_of(out / "0" / "cameras.csv")}
    assert [name for name, reason in reasons.items() if reason] == [poorest]
    assert f"{counts[poorest]} points" in reasons[poorest]


def test_threads_repetition_and_hashes_change_no_byte(tmp_path):
    flags = ("--adjust", "full")
    assert list(determinism.differing_files(RING, tmp_path, command="map", always=flags)) == []


@pytest.mark.parametrize("stage", ["relative rotations", "locate"])
def test_whoever_watches_may_cancel_in_any_stage(stage):
    seen = []

    def cancel(name, _done, _total):
        seen.append(name)
        if name == stage:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sfm_shapefit.map_database(RING / "database.db", progress=cancel)
    assert seen[-1] == stage


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--rotations", "held"], "--rotations is an option of locate"),
        (["--fix", "solved"], "--fix is an option of locate"),
        (["--sequence", "none"], "--sequence is a key of --config: sequence = ..."),
        (["--no-refine"], "--no-refine is a key of --config: refine = ..."),
        (["--rigs", "free", "--adjust", "none"], "--rigs free needs an adjustment"),
        (["--min-points-per-image", "-1"], "--min-points-per-image must be"),
    ],
)
def test_what_map_cannot_be_told_is_refused_in_one_sentence(tmp_path, flags, words):
    said = run("map", RING / "database.db", tmp_path / "out", *flags, code=2).stderr
    assert words in said
    assert "Traceback" not in said
    assert list(tmp_path.iterdir()) == []


def test_pairs_that_are_to_be_left_out_take_no_part_anywhere_nor_with_workers(tmp_path, dask_client):
    truth = read_model(RING / "sparse" / "0").images
    listed, ids = [(0, 1), (4, 3)], truth.ids.tolist()
    gone = [f"pair_id = {ids[min(pair)] * PAIR + ids[max(pair)]}" for pair in listed]
    without = tmp_path / "without.csv"
    without.write_text("\n".join(f"{truth.names[i]},{truth.names[j]}" for i, j in listed))
    database = changed(RING, tmp_path / "edited", f"{PAIRS} {' OR '.join(gone)}")
    left_out = {"without": str(without), "client": dask_client}
    given = sfm_shapefit.map_database(RING / "database.db", **left_out, **FAST).models[0]
    gone = sfm_shapefit.map_database(database, **FAST).models[0]
    np.testing.assert_array_equal(given.directions.pairs, gone.directions.pairs)
    assert len(given.directions.pairs) > 0
    centers = [found.table("cameras")["x"] for found in (given, gone)]
    np.testing.assert_array_equal(*centers)


def test_pairs_of_fixed_images_are_left_out_with_workers_too(tmp_path, dask_client):
    model, database, names = RING / "sparse" / "0", RING / "database.db", tmp_path / "names.txt"
    fixed = read_model(model).images.names[:3]
    names.write_text("\n".join(fixed))
    shared = sfm_shapefit.locate(model, database, fix=str(names), client=dask_client)
    alone = sfm_shapefit.locate(model, database, fix=str(names))
    assert len(shared.directions.pairs) > 0
    assert not np.isin(shared.directions.pairs, range(3)).all(axis=1).any()
    np.testing.assert_array_equal(shared.directions.pairs, alone.directions.pairs)
    centers = [found.table("cameras")["x"] for found in (shared, alone)]
    np.testing.assert_array_equal(*centers)


def assert_same_bits(shared, serial, folder):
    """Model and tables, as they are written."""
    for found, out in ((shared, folder / "shared"), (serial, folder / "serial")):
        sfm_shapefit.write_result(found, out, report=False)
        for named in out.rglob("*.json"):  # which have timings
            named.unlink()
    written = sorted(path.name for path in (folder / "serial" / "0").iterdir())
    assert {"cameras.csv", "images.bin", "pairs.csv", "points3D.bin"} <= set(written)
    for name in written:
        assert (folder / "shared" / "0" / name).read_bytes() == (folder / "serial" / "0" / name).read_bytes()


def test_workers_change_no_bit(tmp_path, courtyard_mapped, dask_client):
    shared = sfm_shapefit.map_database(COURTYARD / "database.db", client=dask_client)
    assert_same_bits(shared, courtyard_mapped, tmp_path)


def test_a_loop_that_the_frames_between_contradict_is_refused_told_and_used_nowhere(tmp_path, monkeypatch):
    size = {"num_images": 16, "num_points": 900, "max_pairs_per_image": 15, "max_keypoints_per_image": 300}
    write_workspace(make_scene(SceneOptions(shape="ring", seed=2, **size)), tmp_path / "made")
    database = tmp_path / "made" / "database.db"

    def with_a_false_loop(*given):
        found = measure_rotations(*given)
        turn = Rotation.from_euler("y", 60.0, degrees=True).as_matrix()
        rotations, counts = found.rotations.copy(), found.num_matches.copy()
        far = found.pairs[:, 1] - found.pairs[:, 0] == 15
        assert far.sum() == 1
        rotations[far], counts[far] = turn, 300
        # Without pairs between, the first and the last frame are beyond the reach of all.
        kept = far | (found.pairs[:, 1] - found.pairs[:, 0] <= 3)
        return dataclasses.replace(found, rotations=rotations, num_matches=counts).subset(kept)

    monkeypatch.setattr("sfm_shapefit.pipeline.components.measure_rotations", with_a_false_loop)
    found = sfm_shapefit.map_database(database, sequence="names", **FAST)
    (loop,) = found.models[0].loops
    names = found.models[0].averaged_names
    assert (loop.first, loop.second, loop.num_refused) == ((names[0],) * 2, (names[15],) * 2, 1)
    assert [0, 15] not in found.models[0].directions.pairs.tolist()
    sfm_shapefit.write_result(found, tmp_path / "out")
    assert json.loads((tmp_path / "out" / "0" / "locate.json").read_text())["loops"][0]["num_refused"] == 1
    assert "1 is not used, as the images between contradict it (sequence=none uses all)" in str(
        found.told.rows
    )
    assert '"refused"]' in (tmp_path / "out/0/report.html").read_text()
    assert describe_loops(found.models[0].facts.loops).endswith(f"{names[0]} to {names[15]}")
    blind = sfm_shapefit.map_database(database, sequence="none", **FAST)
    assert (blind.num_video_frames, blind.models[0].loops) == (0, ())
    assert [0, 15] in blind.models[0].directions.pairs.tolist()


def test_a_straight_drive_is_placed_by_points_and_says_how_sure_lengths_are(tmp_path, monkeypatch):
    drawn = layouts.LAYOUTS["drive"]

    def straight(*given):
        layout = drawn(*given)
        return dataclasses.replace(layout, centers=layout.centers * [1.0, 0.0, 0.0] + [0.0, 0.0, 1.5])

    def street(x):
        along, left = np.tile([[1.0, 0.0, 0.0]], (len(x), 1)), np.tile([[0.0, 1.0, 0.0]], (len(x), 1))
        return along * x[:, None], along, left

    monkeypatch.setattr(layouts, "street", street)
    monkeypatch.setitem(layouts.LAYOUTS, "drive", straight)
    write_workspace(make_scene(SceneOptions(shape="drive", num_images=8, seed=2)), tmp_path / "made")
    located = sfm_shapefit.map_database(tmp_path / "made" / "database.db").models[0]
    errors = sfm_shapefit.evaluate(located.reconstruction, tmp_path / "made" / "sparse" / "0")
    assert errors.position.max < 0.01 * errors.extent
    assert 1e-5 < located.line_sigma < 0.01
    said = describe_line(located.summary()["line_sigma"])
    assert f"known to {100.0 * located.line_sigma:.2g}% of its length" in said


def test_pairs_are_left_out_of_databases_only(tmp_path):
    listed = tmp_path / "without.txt"
    listed.write_text("0000.jpg 0001.jpg\n")
    with pytest.raises(InputError, match="of a database only"):
        sfm_shapefit.locate(RING / "sparse" / "0", directions="tracks", without=str(listed))


@pytest.mark.parametrize("name", ["second/'||name", "clip_'||image_id||'.jpg'"])
def test_a_folder_or_a_clip_none_of_whose_images_can_be_placed_is_one_line(tmp_path, name):
    lost = " OR ".join(f"pair_id / {PAIR} = {k} OR pair_id % {PAIR} = {k}" for k in (6, 7, 8))
    path = changed(RING, tmp_path, f"{PAIRS} {lost}")
    edit_database(path, f"UPDATE images SET name = '{name} WHERE image_id >= 6")
    place, first = ("second/", "second/0006.jpg") if "/" in name else ("clip_*.jpg", "clip_6.jpg")
    said = run("map", path, tmp_path / "out", "--no-report", code=0).stdout
    assert f"in no model: all 3 images of {place}, {first} for one: no matches: fewer than" in said
    assert said.count("in no model:") == 1


def told_under(found, label):
    """Return the lines that a terminal has under a label."""
    return [line for row in found.told.rows if row.label == label for line in row.lines]


def test_components_become_models_of_their_own_and_single_images_are_named(tmp_path):
    lonely = f"pair_id / {PAIR} = 8 OR pair_id % {PAIR} = 8"
    path = changed(RING, tmp_path, f"{PAIRS} {ACROSS} OR {lonely}")
    found = sfm_shapefit.map_database(path, sfm_shapefit.MapOptions(**FAST, min_trust=0.0))
    assert [model.averaged_names for model in found.models] == [
        tuple(f"{k:04d}.jpg" for k in group) for group in ((1, 2, 3, 4), (5, 6, 7))
    ]
    assert list(found.left_out) == ["0008.jpg"]
    assert "no matches" in found.left_out["0008.jpg"]
    assert any(line.startswith("0008.jpg: no matches") for line in told_under(found, "in no model"))
    others = {row.name for row in found.cameras if not row.placed} - set(found.models[0].not_placed)
    assert others <= {row.name for row in found.models[1].cameras if row.placed}
    assert found.models[0].verdict.statement == "good"
    assert found.verdict.statement == "look: 43% of the images are in another model"
    sfm_shapefit.write_result(found, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["0", "1", "map.json"]


def wrong_focal_length(factor):
    """A statement that makes a factor's worth of the focal length of the ring's camera COLMAP's guess."""
    params = np.array([1000.0 * factor, 1000.0 * factor, 600.0, 450.0], dtype="<f8").tobytes().hex()
    return f"UPDATE cameras SET params = x'{params}', prior_focal_length = 0"


def test_a_guessed_focal_length_is_found_and_told(tmp_path):
    path = changed(RING, tmp_path, wrong_focal_length(0.85))
    before = path.read_bytes()
    found = sfm_shapefit.map_database(path, **FAST)
    assert path.read_bytes() == before
    located = found.models[0]
    (row,) = located.summary()["intrinsics"]
    told = row["origin"], row["decided_by"], row["given_focal_px"], row["num_images"]
    assert told == ("a guess", "adjusted", 850.0, 8)
    assert row["focal_px"] == pytest.approx(1000.0, rel=1e-3)
    assert 0.0 < row["focal_sigma_px"] < 20.0
    assert row["parameters"] == located.reconstruction.camera(1).params.tolist()
    errors = sfm_shapefit.evaluate(located.reconstruction, RING / "sparse" / "0")
    assert errors.position.max < 1e-3 * errors.extent
    (line,) = describe_intrinsics(located.facts.intrinsics)
    assert line.startswith("camera 1 (0001.jpg and 7 more): focal length 850.0 px (a guess) became 1,000.")
    assert "(+17.6%) by adjustment" in line


def test_a_focal_length_that_is_not_to_be_refined_stays_and_is_named(tmp_path):
    path = changed(RING, tmp_path, wrong_focal_length(1.01))
    found = sfm_shapefit.map_database(path, intrinsics="held", **FAST)
    located = found.models[0]
    assert located.reconstruction.camera(1).params.tolist() == [1010.0, 1010.0, 600.0, 450.0]
    assert any(
        "0001.jpg and 7 more) kept a focal length that was never" in warning for warning in located.warnings
    )
    assert located.summary()["intrinsics"][0]["decided_by"] == "held"


@pytest.mark.parametrize("wrong", [False, True])
def test_models_are_joined_by_matches_too_few_for_pairs_and_not_by_wrong_ones(tmp_path, wrong):
    database = changed(RING, tmp_path, keep_few_matches(4, 6, wrong=wrong))
    taped = ("0001.jpg", "0008.jpg", 3.0)  # from one model to the other
    found = sfm_shapefit.map_database(database, sfm_shapefit.MapOptions(**FAST), known_distance=(taped,))
    (told,) = found.joins
    assert [len(model.averaged_names) for model in found.models] == [4, 4]
    assert [warning for warning in found.warnings if "0001.jpg and 0008.jpg is of no use" in warning] == (
        [f"the known distance of 0001.jpg and 0008.jpg is of no use: {APART}"] if wrong else []
    )
    sfm_shapefit.write_result(found, tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    facts = json.loads((tmp_path / "out" / "1" / "locate.json").read_text())
    assert facts["join"]["statement"] == told.statement
    assert facts["join"] == json.loads((tmp_path / "out" / "map.json").read_text())["joins"][0]
    assert json.loads((tmp_path / "out" / "0" / "locate.json").read_text())["join"] is None
    assert ("joined_0" in names) == (told.join is not None) == (not wrong)
    assert found.told.folders == (*([] if wrong else ["joined_0"]), "0", "1")
    if wrong:
        assert "model 1 is not joined to model 0: " in told.statement
        return
    whole = read_model(tmp_path / "out" / "joined_0")
    errors = sfm_shapefit.evaluate(whole.reconstruction, RING / "sparse" / "0")
    assert len(errors.names) == 8
    assert errors.position.max < 1e-5 * errors.extent  # the keypoints are exact
    assert errors.rotation_deg.max < 1e-3
    models = [model.reconstruction for model in found.models]
    assert whole.reconstruction.num_points3D() == sum(model.num_points3D() for model in models)
    same = [(min(models[0].point3D_ids()), min(models[1].point3D_ids()))]
    merged, renamed, new = merge_models(*models, told.join.to_from_piece, same)
    assert merged.num_points3D() == whole.reconstruction.num_points3D() - 1
    assert renamed[same[0][0]] == new[same[0][1]]
    check_joined_folder(tmp_path / "out" / "joined_0", found)


# One of the pairs between the first images and the others stays: it tells the turn, and no scale.
KEEP_ONE = f"{PAIRS} {ACROSS} AND pair_id != {1 * PAIR + 8}"


def test_a_second_rigid_piece_is_a_model_and_what_keeps_it_apart_is_told(tmp_path):
    found = sfm_shapefit.map_database(changed(RING, tmp_path, KEEP_ONE), **FAST)
    assert [int(model.kept.sum()) for model in found.models] == [4, 4]
    placed = {row.name for model in found.models for row in model.cameras if row.placed}
    assert len(placed) == found.num_placed == 8
    assert not found.left_out
    # The images of the other are not missing in either, but not there: neither is all of the scene.
    verdicts = [model.verdict for model in found.models]
    assert [verdict.grade for verdict in verdicts] == ["look", "look"]
    assert all("of the images are in another model" in verdict.reasons[-1] for verdict in verdicts)
    (told,) = found.joins
    assert "1 pair of images cannot tell how large it is and where" in told.reason
    sfm_shapefit.write_result(found, tmp_path / "out")
    for folder in ("0", "1"):
        assert read_model(tmp_path / "out" / folder).images.num_images == 4
    reasons = {
        row["reason"] for row in rows_of(tmp_path / "out" / "1" / "cameras.csv") if row["placed"] == "false"
    }
    assert reasons == {"in a larger piece, to which this one is not rigidly tied"}


APART = "they are in models 0 and 1, which are not joined"


def check_joined_folder(folder, found):
    """A joined model says of itself what others do, and its commands work."""
    (joined,) = found.joined
    drawing, facts = draw_joined(joined), joined.facts
    assert facts.summary() == json.loads((folder / "locate.json").read_text("utf-8"))
    assert problems(facts.summary(), "joined") == []
    assert facts.known_distances[0].found == pytest.approx(3.0)
    assert "0001.jpg and 0008.jpg are 3 apart" in facts.scale
    assert facts.joins[0].statement == found.joins[0].statement
    rows = [row for model in found.models for row in model.cameras]
    assert dict(zip(drawing.cameras.names, drawing.cameras.trust.tolist(), strict=True)) == {
        row.name: row.trust for row in rows
    }
    # The errors of the join come on top of what its models know, all in the units of the known distance.
    together = {row.name: row for row in found.joined[0].cameras}
    scales, own = [], []
    for model in found.models:
        (first, *_, last) = ours = model.cameras
        apart = [
            np.subtract(two.center, one.center)
            for one, two in ((first, last), (together[first.name], together[last.name]))
        ]
        scales.append(np.linalg.norm(apart[1]) / np.linalg.norm(apart[0]))
        own.append({row.name: np.sum(np.square(row.sigma)) * scales[-1] ** 2 for row in ours})
    of_join = (scales[0] * found.joins[0].join.center_sigma) ** 2
    for variances, more in zip(own, (0.0, of_join), strict=True):
        for name, variance in variances.items():
            assert np.sum(np.square(together[name].sigma)) == pytest.approx(
                variance + more, rel=1e-4, abs=0.0
            )
    assert len(drawing.pairs.classes) > sum(len(model.pairs) for model in found.models)
    assert not (drawing.pairs.classes == PairClass.CONTRADICTS).any()
    assert (folder / "report.html").is_file()
    assert banner(drawing, facts)["command"].startswith("sfm-shapefit workspace ")  # its models are adjusted


def test_models_are_joined_by_position_priors_unless_that_is_not_wanted(tmp_path):
    truth, out = read_model(RING / "sparse" / "0").images, tmp_path / "out"
    database = changed(RING, tmp_path, f"{PAIRS} {ACROSS}")
    table = write_priors(tmp_path / "priors.txt", by_name(truth, truth.centers))
    arguments = ("map", database, out, "--points", "never", "--no-report")
    run(*arguments, "--priors", table)
    (told,) = json.loads((out / "map.json").read_text())["joins"]
    assert "model 1 is joined to model 0 by position priors of 4 and 4 cameras" in told["statement"]
    errors = sfm_shapefit.evaluate(out / "joined_0", RING / "sparse" / "0")
    assert errors.position.max < 1e-3 * errors.extent
    assert "not joined" in run(*arguments, "--overwrite").output
    told = json.loads((out / "map.json").read_text())
    assert not any("priors" in warning for warning in told["warnings"])  # it has none
    edit_database(
        database,
        "INSERT INTO pose_priors (pose_prior_id, corr_data_id, corr_sensor_id, corr_sensor_type, position, "
        "coordinate_system) VALUES (1, 1, 1, 0, x'00', 1)",
    )
    run(*arguments, "--overwrite")
    assert "join no models: " in json.loads((out / "map.json").read_text())["warnings"][-1]
    facts = json.loads(run(*arguments, "--overwrite", "--join", "never", "--json", "--priors", table).stdout)
    assert facts["joins"] == []
    assert not (out / "joined_0").exists()


@pytest.mark.parametrize(("image", "value"), [(1, -1e6), (3, 100.0), (None, 100.0)])
def test_keypoints_that_are_all_at_one_place_cost_their_image_alone(tmp_path, image, value):
    def put(connection):
        for number, rows, cols in connection.execute("SELECT image_id, rows, cols FROM keypoints").fetchall():
            data = np.full((rows, cols), value, dtype="<f4").tobytes()
            if image in (None, number):
                connection.execute("UPDATE keypoints SET data = ? WHERE image_id = ?", (data, number))

    path = edit_database(copied(RING, tmp_path) / "database.db", put)
    if image is None:
        with pytest.raises(UnsolvableError):
            sfm_shapefit.map_database(path)
        return
    mapped = sfm_shapefit.map_database(path)
    assert mapped.num_placed == 7
    assert [row.name for row in mapped.models[0].cameras if not row.placed] == [f"{image:04}.jpg"]
