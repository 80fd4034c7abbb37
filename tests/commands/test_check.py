"""`check MODEL`: the verdict on any COLMAP model as it stands, which is left as it is."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from sfm_shapefit.commands.check import check
from sfm_shapefit.commands.map import map_database
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.points import points_of
from sfm_shapefit.judgement.evidence import ModelEvidence
from sfm_shapefit.judgement.grade import weigh_evidence
from sfm_shapefit.judgement.image_quality import image_quality
from sfm_shapefit.judgement.reasons import Kind, ModelVerdict, Reason
from sfm_shapefit.report.drawing import PairClass
from sfm_shapefit.report.first_screen import banner
from sfm_shapefit.report.results import draw_checked
from sfm_shapefit.scene.structure import Structure
from tests.facts.test_schema import problems
from tests.judgement.made import opinion_with, place_of
from tests.program import run, run_refused
from tests.scenes import COURTYARD, PHOTOGRAPHED, RING, edit_database, fingerprint
from tests.structures import pictures_of


def test_quality_is_that_of_the_models_own_observations():
    model = read_model(RING / "sparse" / "0")
    reconstruction, images = model.reconstruction, model.images
    pictures = pictures_of(reconstruction, images)
    quality = image_quality(Structure(points_of(model.arrays, images), images, pictures))
    mean = np.sum(quality.num_points * quality.errors_px) / quality.num_points.sum()
    assert mean == pytest.approx(reconstruction.compute_mean_reprojection_error(), rel=0.05)  # by point there
    image = reconstruction.image(int(model.images.ids[3]))
    seen = [point for point in image.points2D if point.has_point3D()]
    lengths = [reconstruction.points3D[point.point3D_id].track.length() for point in seen]
    assert quality.num_points[3] == len(seen)
    assert quality.track_lengths[3] == np.median(lengths)
    camera = image.camera
    cells = {(int(8 * p.xy[0] / camera.width), int(8 * p.xy[1] / camera.height)) for p in seen}
    assert quality.coverage[3] == pytest.approx(len(cells) / 64)


def test_a_sound_model_is_good_and_a_displaced_camera_is_named(tmp_path, ring_mapped):
    found = check(RING / "sparse" / "0", second_opinion=ring_mapped)
    drawing, facts = draw_checked(found), found.facts
    assert facts.verdict.statement == "good"
    assert not (drawing.pairs.classes == PairClass.CONTRADICTS).any()
    assert " workspace " in banner(drawing, facts)["command"]

    moved, name = with_one_displaced(tmp_path / "moved")
    found = check(moved, RING / "database.db", second_opinion=ring_mapped)
    drawing, facts = draw_checked(found), found.facts
    assert facts.verdict.cameras == (name,)
    row = drawing.cameras.names.index(name)
    assert "pairs contradict its place" in drawing.cameras.reasons[row]
    assert "its reprojection error is" in drawing.cameras.reasons[row]
    wrong = drawing.pairs.cameras[drawing.pairs.classes == PairClass.CONTRADICTS]
    assert len(wrong) > 0
    assert (wrong == row).any(axis=1).all()
    assert banner(drawing, facts)["command"].startswith(
        "sfm-shapefit map "
    )  # its model has that camera right


def test_a_page_that_would_replace_another_is_refused_before_anything_is_read(tmp_path):
    (tmp_path / "page.html").touch()
    (tmp_path / "database.db").write_text("no database")
    told = ("--report", tmp_path / "page.html", "--database", tmp_path / "database.db")
    assert "exists already" in run_refused("check", RING / "sparse" / "0", *told)


def test_the_page_is_written_beside_and_nothing_is_replaced_unasked(tmp_path):
    before = fingerprint(RING)
    page = tmp_path / "ring.html"
    result = run("check", RING / "sparse" / "0", "--report", page, code=0)
    assert f"open {page}" in result.output
    assert "Share of the picture in which it sees points" in page.read_text(encoding="utf-8")
    assert "exists already" in run_refused("check", RING / "sparse" / "0", "--report", page)
    assert "is a folder; give" in run_refused("check", RING / "sparse" / "0", "--report", tmp_path)
    assert "none does not exist" in run_refused(
        "check", tmp_path / "none", "--report", page
    )  # before the page
    nowhere = tmp_path / "none" / "page.html"
    assert "does not exist; make it" in run_refused("check", RING / "sparse" / "0", "--report", nowhere)
    run("check", RING / "sparse" / "0", "--report", page, "--overwrite", code=0)
    assert fingerprint(RING) == before


def test_where_many_pairs_are_wrong_a_camera_is_weak_only_beside_the_others(tmp_path, courtyard_mapped):
    # A quarter of its pairs is wrong.
    told = run("check", COURTYARD / "truth", "--database", COURTYARD / "database.db", code=0).stdout
    assert "verdict: good" in told
    assert "weak: " not in told  # one has many false pairs, but the second opinion has it at the same place
    assert "second opinion: 25 cameras are in the same place in the model that map made" in told
    moved = pycolmap.Reconstruction(COURTYARD / "truth")
    image = moved.image(sorted(moved.reg_image_ids())[7])
    pose = image.frame.rig_from_world
    away = pose.translation + 0.002 * 15.5 * np.array([0.6, 0.0, 0.8])  # 0.2 % of the extent
    image.frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, away)
    moved.write(tmp_path)
    found = check(tmp_path, COURTYARD / "database.db", second_opinion=courtyard_mapped)
    drawing, facts = draw_checked(found), found.facts
    assert image.name in facts.verdict.cameras
    assert "its reprojection error is" in drawing.cameras.reasons[drawing.cameras.names.index(image.name)]


def test_what_map_doubts_check_does_not_call_good():
    """Houses look the same: matches speak for another rotation of two cameras, too."""
    mapped = map_database(PHOTOGRAPHED / "database.db")
    doubted = mapped.models[0].verdict.cameras
    assert doubted
    for model in (mapped, PHOTOGRAPHED / "truth"):
        found = check(model, PHOTOGRAPHED / "database.db", second_opinion=mapped)
        assert found.verdict.cameras == doubted
        assert found.facts.evidence.second.ambiguous == doubted
        assert (
            "another place or rotation has at least half as much evidence"
            in found.facts.evidence.second.statement
        )
        assert "median" not in found.facts.evidence.second.statement
        assert " workspace " in found.facts.next_step.command  # it would be placed there again
        assert banner(draw_checked(found), found.facts)["sentence"].startswith(
            "0004.jpg, 0005.jpg may be wrong"
        )
        evidence = found.facts.evidence
        unlike = replace(evidence, second=replace(evidence.second, usual=0.2, ambiguous=()))
        # Both are to be looked at, so that nothing is for the one that is checked.
        assert replace(found.facts, evidence=unlike).next_step.command.startswith("sfm-shapefit map ")


def test_a_weak_camera_that_stands_where_another_model_has_it_is_not_named(tmp_path):
    model = pycolmap.Reconstruction(RING / "sparse" / "0")
    for point_id in sorted(model.point3D_ids())[25:]:  # no image sees 30
        model.delete_point3D(point_id)
    model.write(tmp_path)
    for second_opinion, num_named in ((False, 8), (True, 0)):
        found = check(tmp_path, RING / "database.db", second_opinion=second_opinion)
        assert len(found.verdict.cameras) == num_named


def test_a_camera_that_has_two_places_in_the_other_model_is_not_confirmed(courtyard_mapped):
    located = courtyard_mapped.models[0]
    places = (place_of(located.placed.names[4], 3, 5),)
    doubtful = replace(located, evidence=ModelEvidence(places=places))
    other = replace(courtyard_mapped, models=(doubtful,))
    found = check(COURTYARD / "truth", COURTYARD / "database.db", second_opinion=other)
    assert found.facts.evidence.second.ambiguous == found.verdict.cameras == (located.placed.names[4],)


def spoiled(folder, place=None, *, points=True, num_posed=None, names=None):
    """Write ring8's model with other centers or names, or without points or poses; return its folder."""
    model = pycolmap.Reconstruction(RING / "sparse" / "0")
    ids = sorted(model.reg_image_ids())
    for image in map(model.image, ids):
        rotation, center = image.frame.rig_from_world.rotation, image.projection_center()
        center = center if place is None else place(center)
        image.frame.rig_from_world = pycolmap.Rigid3d(rotation, -rotation.matrix() @ center)
        image.name = names(image.name) if names else image.name
    for point in [] if points else list(model.points3D):
        model.delete_point3D(point)
    for image_id in ids[num_posed:] if num_posed is not None else []:
        model.deregister_frame(model.image(image_id).frame_id)
    folder.mkdir()
    model.write(folder)
    return folder


@pytest.mark.parametrize(
    ("place", "with_database", "words"),
    [
        (np.negative, False, "the pairs that agree hold only"),
        (lambda center: center * [-1.0, 1.0, 1.0], True, "the pairs that agree hold only"),
        (lambda _: np.full(3, 2.0), False, "at the same place"),
    ],
)
def test_a_wrong_model_is_not_to_be_used(tmp_path, place, with_database, words):
    database = ["--database", RING / "database.db"] if with_database else []
    model = spoiled(tmp_path / "model", place)
    told = run("check", model, *database, "--strict", "--report", tmp_path / "page.html", code=4)
    assert "verdict: do not use" in told.stdout
    assert words in told.stdout
    assert (tmp_path / "page.html").is_file()
    assert run("check", model, "--no-second-opinion", *database, "-q", code=0).output == ""


def test_a_model_that_nothing_speaks_for_does_not_pass_strict(tmp_path):
    model = RING / "sparse" / "0"
    others = run("check", model, "--database", COURTYARD / "database.db", "--strict", code=4)
    assert "do not use" in others.stdout
    alone = spoiled(tmp_path / "alone", points=False)
    judged = run("check", alone, "--strict", code=4).stdout
    assert "verdict: cannot be judged: it has no 3D points, and no database was given or found" in judged
    tracks = run("check", shutil.copytree(model, tmp_path / "tracks"), "--strict", code=4)
    assert tracks.stdout.splitlines()[2] == "verdict: good"
    assert "by its own tracks alone, which cannot show a fold" in " ".join(tracks.stderr.split())
    run("check", model, "--strict", "--no-second-opinion", "-q", code=0)
    strangers = spoiled(tmp_path / "strangers", names="other-{}".format)
    database = ("--database", RING / "database.db")
    assert "has 0 of the model's 8 images" in run_refused("check", strangers, *database)


def test_an_output_is_judged_by_the_database_that_it_names_while_that_has_its_images(tmp_path, ring_mapped):
    database = shutil.copy(RING / "database.db", tmp_path / "ring.db")
    found = replace(ring_mapped.models[0], inputs=replace(ring_mapped.models[0].inputs, database=database))
    found.write(tmp_path / "far/below/0")
    assert repr(ring_mapped) == "<MapResult: good: 8 of 8 images placed in 1 model>"
    judged = check(tmp_path / "far/below/0", second_opinion=ring_mapped).facts
    assert judged.has_matches
    assert judged.inputs.directions == f"inlier matches of {database} (which the model's locate.json names)"
    run("check", tmp_path / "far/below/0", "--strict", "--no-second-opinion", "-q", code=0)
    edit_database(database, "UPDATE images SET name = 'other_' || name WHERE image_id = 1")
    assert not check(tmp_path / "far/below/0").facts.has_matches
    Path(database).unlink()
    assert not check(tmp_path / "far/below/0").facts.has_matches


def test_an_output_names_its_database_so_that_it_is_found_from_any_folder(tmp_path, monkeypatch):
    for folder, scene in (("here", RING), ("there", COURTYARD)):
        (tmp_path / folder).mkdir()
        shutil.copy(scene / "database.db", tmp_path / folder / "matches.db")
    shutil.copytree(RING / "sparse/0", tmp_path / "here/model")
    monkeypatch.chdir(tmp_path / "here")
    Path("out/far").mkdir(parents=True)
    made = run("locate", "model", "out/far/away", "--database", "matches.db", "--no-report", code=0).stdout
    assert "matches: matches.db;" in made  # as it was typed
    monkeypatch.chdir(tmp_path / "there")  # where a database of that name is another scene's
    judged = run("check", "../here/out/far/away", "--no-second-opinion", "--json", code=0).stdout
    inputs = json.loads(judged)["inputs"]
    assert inputs["database"] == str(tmp_path / "here/matches.db")
    assert inputs["model"].startswith("/")
    said = run("check", "../here/out/far/away", "--no-second-opinion", code=0).stdout
    assert f"matches: {tmp_path / 'here/matches.db'};" in said


def test_a_model_beside_another_scenes_database_is_doubted():
    """Names are common, and so are some pairs by chance; a model's own points tie its cameras too."""
    told = check(PHOTOGRAPHED / "truth", RING / "database.db", second_opinion=False).verdict
    assert told.grade != "good"
    assert "contradict it and none agrees: is this the model's database?" in told.statement


def test_cameras_at_one_place_are_to_be_located_as_the_verdict_says():
    facts = check(COURTYARD / "sparse/0", second_opinion=False).facts
    assert facts.verdict.statement.endswith("at the same place; place them with sfm-shapefit locate")
    assert re.match(r"sfm-shapefit locate \S*courtyard/sparse/0 located --data", facts.next_step.command)


def test_a_database_that_lacks_an_image_of_the_model_is_doubted(tmp_path):
    strange = spoiled(tmp_path / "strange", names=lambda name: "other.jpg" if name == "0003.jpg" else name)
    told = check(strange, RING / "database.db", second_opinion=False).facts
    assert told.verdict.statement == "look: the database lacks 1 image: is this the model's database?"
    assert told.next_step.command == f"sfm-shapefit check {strange} --database ITS_DATABASE"


def test_a_second_opinion_of_another_shape_is_a_reason_to_look(tmp_path):
    """What nothing but the model's own points and a third of the pairs speak for."""
    images = read_model(RING / "sparse/0").images
    told = "the model that map makes of the same matches has another shape"
    for share, said in ((0.05, []), (0.4, [told])):
        evidence = ModelEvidence(second=opinion_with(usual=share))
        assert [one.sentence for one in weigh_evidence(evidence, images)] == said


def test_a_model_without_points_is_told_once_and_judged_by_its_pairs(tmp_path, ring_mapped):
    model = spoiled(tmp_path / "model", points=False)
    found = check(model, RING / "database.db", second_opinion=ring_mapped)
    assert found.verdict.statement.startswith("look: it has no 3D points")
    assert found.verdict.cameras == ()
    assert set(found.table("cameras")["reason"]) == {""}


def test_a_model_of_one_image_or_none_is_refused_in_a_sentence(tmp_path):
    for count, words in ((1, "only one image"), (0, "no image")):
        model = spoiled(tmp_path / str(count), num_posed=count)
        assert words in run_refused("check", model)
    assert "holds no COLMAP model" in run_refused("check", tmp_path)
    assert f"{tmp_path / 'missing'} does not exist" in run_refused("check", tmp_path / "missing")


def test_json_has_the_figures_and_pictures_need_a_page(tmp_path):
    facts = json.loads(run("check", RING / "sparse" / "0", "--json", code=0).stdout)
    assert problems(facts, "check") == []
    assert facts["evidence"]["second"]["num_common"] == 8
    alone = json.loads(run("check", RING / "sparse" / "0", "--json", "--no-second-opinion", code=0).stdout)
    assert alone["evidence"]["second"] is None
    assert facts["verdict"]["grade"] == "good"
    assert "--report" in run_refused("check", RING / "sparse" / "0", "--images", tmp_path)
    page = ("--report", tmp_path / "page.html", "--images", tmp_path)
    assert "has none of the images" in run_refused("check", RING / "sparse" / "0", *page)


def with_one_displaced(folder):
    """Write ring8 with one camera a unit away."""
    model = pycolmap.Reconstruction(RING / "sparse" / "0")
    image = model.image(sorted(model.reg_image_ids())[2])
    pose = image.frame.rig_from_world
    image.frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([1.0, 0.0, 0.0]))
    folder.mkdir()
    model.write(folder)
    return folder, image.name


def test_the_second_opinion_is_kept_where_asked_and_is_the_next_step(tmp_path):
    (model, name), out = with_one_displaced(tmp_path / "model"), tmp_path / "mapped"
    database, keep = ("--database", RING / "database.db"), ("--second-opinion", out)
    told = run("check", model, *database, *keep, code=0).stdout
    assert f" workspace {out}/0 " in told
    assert pycolmap.Reconstruction(out / "0").num_reg_images() == 8
    assert (out / "map.json").is_file()
    assert "exists already" in run_refused("check", model, *database, *keep)
    facts = json.loads(run("check", model, *database, *keep, "--overwrite", "--json", code=0).stdout)
    assert facts["second_opinion"] == str(out)
    assert facts["verdict"]["cameras"] == [name]
    reasons = {one["kind"]: one for one in facts["verdict"]["findings"]}
    assert all(one["images"] == [name] for one in reasons.values())
    assert "reprojection error" in reasons["points"]["sentence"]
    assert "give one" in run_refused("check", model, *database, *keep, "--no-second-opinion")
    assert "needs the database" in run_refused("check", model, "--second-opinion", tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_two_cameras_cannot_be_judged_whichever_command_is_asked(tmp_path):
    two = spoiled(tmp_path / "two", num_posed=2)
    told = run("check", two, "--strict", code=4).stdout
    assert "verdict: cannot be judged: it has two cameras only" in told
    located = run("locate", two, tmp_path / "out", "--strict", "--no-report", code=4).stdout
    assert "verdict: cannot be judged: it has two cameras only" in located
    assert (tmp_path / "out" / "locate.json").is_file()


def test_images_without_a_pose_are_no_cameras_to_look_at():
    model = pycolmap.Reconstruction(RING / "sparse" / "0")
    last = model.image(max(model.reg_image_ids()))
    model.deregister_frame(last.frame_id)
    found = check(model, second_opinion=False)
    assert (found.verdict.grade, found.verdict.cameras) == ("good", ())
    rows = {row.label: row.lines for row in found.facts.told(found.cameras, found.pairs).rows}
    assert (rows["without a pose"], rows["weak"]) == ([last.name], [])


def test_lenses_that_cannot_be_ask_for_one_lens_per_device_and_a_single_one_for_its_calibration():
    facts = check(RING / "sparse/0", second_opinion=False).facts
    odd = ModelVerdict.weigh([Reason(kind=Kind.LENS, sentence="a lens is 42 widths long")])
    anew, freed = "sfm-shapefit map IMAGES", {"intrinsics": "all"}
    for num_lenses, made, advice in ((8, {}, anew), (1, {}, "--intrinsics all"), (1, freed, anew)):
        step = replace(facts, verdict=odd, num_lenses=num_lenses, options=made).next_step
        assert advice in step.command


@pytest.fixture
def models_in_a_folder(tmp_path, monkeypatch):
    """Go to a folder with a sound model, one with two poses, one with wrong poses, and their database."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(RING / "sparse" / "0", "sound")
    shutil.copyfile(RING / "database.db", "ring.db")
    spoiled(Path("two"), num_posed=2)
    turned, rng = pycolmap.Reconstruction("sound"), np.random.default_rng(0)
    for frame in turned.frames.values():
        turn = pycolmap.Rotation3d(rng.normal(size=3))
        frame.rig_from_world = pycolmap.Rigid3d(turn * frame.rig_from_world.rotation, rng.normal(size=3))
    Path("turned").mkdir()
    turned.write("turned")


@pytest.mark.parametrize(
    "begin",
    [
        "check turned --database ring.db",
        "check turned",
        "check two --database ring.db",
        "locate turned out --database ring.db",
        "locate turned out",
        "inspect turned --database ring.db",
        "evaluate sound sound",
        "evaluate sound",
        "convert sound copy",
    ],
)
@pytest.mark.usefixtures("models_in_a_folder")
def test_no_next_step_leads_back_to_a_command_that_was_run(begin):
    """Followed to its end: what needs something that only the user has, or a workspace."""
    done, words = set(), begin.split()
    while not {"IMAGES", "ITS_DATABASE", "FILE", "DISTANCE", "workspace"} & {*words}:
        assert tuple(words) not in done
        done.add(tuple(words))
        result = run(*words)
        assert result.exit_code in (0, 4), result.output
        if result.exit_code == 4:
            break
        last = result.stdout.splitlines()[-1]
        assert last.startswith("next: sfm-shapefit ")
        words = last.removeprefix("next: sfm-shapefit ").split()
