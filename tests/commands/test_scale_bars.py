"""Scale bars between points set the scale or check it; what is wrong with them is said."""

import json
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from typer.testing import CliRunner

import sfm_shapefit
from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.place_errors import errors_of_points
from sfm_shapefit.adjustment.scale_bars import fit_scale_bars, pooled_noise
from sfm_shapefit.adjustment.shared_errors import estimate_center_errors
from sfm_shapefit.adjustment.solve import adjust
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.cli import app
from sfm_shapefit.commands.write import WRITERS
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.scale_bars import read_scale_bars
from sfm_shapefit.scene.given import ScaleBars
from sfm_shapefit.scene.images import Images
from tests.adjustment.made import ring_problem
from tests.pipeline.made import keep_few_matches
from tests.scenes import RING, copied, edit_database

SCALE = 2.5
BARS = 0.3 * np.array(
    [[[1, 1, 0], [-1, 1, 0]], [[1, -1, 0], [-1, -1, 0]], [[0, 0, 1], [0, 1, -1]], [[1, 0, 1], [-1, 0, -1]]]
)


@pytest.fixture(scope="module")
def ring():
    return pycolmap.Reconstruction(RING / "sparse" / "0")


def lines_of(ring, names=("B0", "B1", "B2", "CHK-3"), longer=(0.0, 0.0, 0.0, 0.0), sigma=0.001):
    """Return the marks of the bars, each some longer than it is when the ring is 2.5 times as large."""
    lines = []
    for name, more, ends in zip(names, longer, BARS, strict=True):
        length = SCALE * float(np.linalg.norm(ends[0] - ends[1])) + more
        for end, point in zip(("left", "right"), ends, strict=True):
            for image in sorted(ring.images.values(), key=lambda image: image.name):
                u, v = (float(value) for value in image.project_point(point))
                lines.append(f"{length!r} {sigma} {u!r} {v!r} {image.name} {name} {end}")
    return lines


def written(folder, lines):
    path = folder / "bars.txt"
    path.write_text("\n".join(["# length, sigma, pixels, image, bar, end", *lines]) + "\n")
    return str(path)


def sizes(model):
    """The largest distance of two cameras."""
    centers = np.array([one.projection_center() for one in model.images.values() if one.has_pose])
    return float(np.linalg.norm(centers[:, None] - centers, axis=2).max())


def test_bars_set_the_scale_and_a_check_bar_says_so(ring, tmp_path):
    path = written(tmp_path, lines_of(ring, longer=(0.0, 0.0, 0.0, 0.02)))
    found = sfm_shapefit.locate(ring, RING / "database.db", scale_bars=path)
    assert sizes(found.reconstruction) == pytest.approx(SCALE * sizes(ring), rel=1e-3)
    assert found.gauge.scale == "scale bars"
    assert found.gauge.statement.startswith(f"scale bars: 4 bars of {path}; 3 of 3 agree, the scale is known")
    centers = {image.name: image.projection_center() for image in found.reconstruction.images.values()}
    at = found.gauge.apply(found.placement.locations)
    np.testing.assert_allclose(at, [centers[row.name] for row in found.cameras], atol=0.02)
    rows = {row["name"]: row for row in found.summary()["scale_bars"]}
    assert [rows[name]["use"] for name in rows] == ["control"] * 3 + ["check"]
    assert rows["CHK-3"]["error"] == pytest.approx(-0.02, abs=2e-3)
    assert abs(rows["B0"]["error"]) < 2e-3
    # The scale is as certain as three lengths known to 1 mm, and the marks' floor, make it.
    lengths = np.array([rows[name]["known"] for name in ("B0", "B1", "B2")])
    assert found.gauge.scale_sigma >= 0.9 * np.sum((lengths / 0.001) ** 2) ** -0.5
    assert found.lengths.has_scale
    assert found.lengths.half_width >= 1.96 * 0.9 * found.gauge.scale_sigma * found.lengths.length


def test_a_bar_that_contradicts_the_others_sets_nothing_and_two_are_told(ring, tmp_path):
    path = written(tmp_path, lines_of(ring, longer=(0.0, 0.5, 0.0, 0.0), names=("B0", "B1", "B2", "B3")))
    found = sfm_shapefit.locate(ring, RING / "database.db", scale_bars=path)
    assert sizes(found.reconstruction) == pytest.approx(SCALE * sizes(ring), rel=1e-3)
    assert [row.use for row in found.scale_bars] == ["control", "unused", "control", "control"]
    assert "3 of 4 agree" in found.gauge.statement
    said = (
        f"{path}, line 18: 1 scale bar contradicts the others: the model makes B1 0.5 shorter than it is told"
    )
    assert any(warning.startswith(said) for warning in found.warnings)
    two = written(tmp_path, lines_of(ring, longer=(0.0, 0.5, 0.0, 0.0))[:32])
    found = sfm_shapefit.locate(ring, RING / "database.db", scale_bars=two)
    assert any("2 scale bars contradict one another" in warning for warning in found.warnings)
    assert found.gauge.scale_sigma > 0.1  # half of the 29 % by which they differ


def test_map_takes_them_and_names_a_bar_without_a_mark(ring, tmp_path):
    path = written(tmp_path, lines_of(ring))
    found = sfm_shapefit.map_database(
        RING / "database.db", scale_bars=path, known_distance=("0001.jpg", "0002.jpg", 1.0)
    )
    assert sizes(found.reconstruction) == pytest.approx(SCALE * sizes(ring), rel=1e-3)
    assert any(
        "known distances were not used for the scale, which is that of the scale bars" in w
        for w in found.models[0].warnings
    )


def test_models_that_are_joined_take_the_scale_of_bars_between_them(ring, tmp_path):
    """Each model shows one end of a bar: images up to the fourth the left one, the others the right one."""
    database = edit_database(copied(RING, tmp_path) / "database.db", keep_few_matches(4, 6))
    lines = [one for one in lines_of(ring) if ("right" in one) == (one.split()[4] > "0004.jpg")]
    found = sfm_shapefit.map_database(database, scale_bars=written(tmp_path, lines), points="never")
    assert {model.gauge.scale for model in found.models} == {"unit"}
    (joined,) = found.joined
    assert sizes(joined.reconstruction) == pytest.approx(SCALE * sizes(ring), rel=1e-3)
    assert [bar.name for bar in joined.facts.scale_bars] == ["B0", "B1", "B2", "CHK-3"]
    assert max(abs(bar.error) for bar in joined.facts.scale_bars) < 2e-3


def test_where_something_else_sets_the_scale_they_check_it(ring, tmp_path):
    (tmp_path / "names.txt").write_text("0001.jpg\n0002.jpg\n0003.jpg\n")
    path = written(tmp_path, lines_of(ring))
    found = sfm_shapefit.locate(ring, RING / "database.db", scale_bars=path, fix=str(tmp_path / "names.txt"))
    assert found.gauge.scale == "fixed"
    assert {row.use for row in found.scale_bars} == {"check"}
    assert any(
        "scale bars were not used for the scale, which is that of the fixed cameras; they differ by 150 %"
        in w
        for w in found.warnings
    )


def test_truth_is_within_95_percent_as_often_as_that():
    """Of 40 draws of 5 check bars 190 are expected inside; those of a draw share its errors of the scale.

    Were all independent, 7 fewer or more would be more than two sigmas.
    """
    exact = ring_problem(np.random.default_rng(0), 8, 150, noise_px=0.0, share=0.8)
    rng, options = np.random.default_rng(1), AdjustmentOptions(loss_scale_px=None)
    ends = rng.choice(150, (8, 2), replace=False)
    truth = np.linalg.norm(exact.points[ends[:, 0]] - exact.points[ends[:, 1]], axis=1)
    inside, scores, sigma = 0, [], 0.002
    for _ in range(40):
        pixels = exact.pixels + 0.4 * rng.standard_normal(exact.pixels.shape)
        solved = adjust(replace(exact, pixels=pixels), options).problem
        errors = estimate_center_errors(solved, options)
        images = Images.listed(
            [f"{k}" for k in range(8)],
            (solved.rotations, solved.centers),
            solved.lens_of_camera,
            solved.lenses,
        )
        seen = solved.points_seen, solved.cameras_seeing
        places = errors_of_points(images, errors.draws, solved.points, seen, errors.noise_px)
        bars = made_bars(truth + sigma * rng.standard_normal(8), sigma)
        apart = places.apart(ends)
        fit = fit_scale_bars(bars, apart)
        assert fit is not None
        apart = apart.in_scale(fit.errors, fit.scale)
        off = (apart.lengths - truth)[3:] / apart.sigmas[3:]
        inside += int(np.sum(np.abs(off) < 1.96))
        scores.append(off)
    assert 183 <= inside <= 197
    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1.0, abs=0.1)


def made_bars(lengths, sigma):
    none = np.zeros(0, dtype=np.int64)
    names = tuple(f"{k}" for k in range(len(lengths)))
    return ScaleBars(
        names=(),
        points=none,
        images=none,
        pixels=np.zeros((0, 2)),
        statement="",
        bars=names,
        lengths=lengths,
        sigmas=np.full(len(lengths), sigma),
        is_check=np.arange(len(lengths)) >= 3,
        places=names,
    )


def test_few_marks_are_taken_for_as_good_as_keypoints_until_they_say_otherwise():
    points = np.array([0, 0, 1, 1])
    assert pooled_noise(np.zeros(4), points, 0.5) == pytest.approx(0.5 * np.sqrt(3.0 / 5.0))
    assert pooled_noise(np.full(4, 5.0), points, 0.5) > 4.0
    assert pooled_noise(np.full(400, 0.2), np.arange(400) // 8, 0.5) == pytest.approx(0.16, rel=0.1)


def line(image="0001.jpg", *, bar="B0", end="left", numbers="2 0.001 100 100"):
    return f"{numbers} {image} {bar} {end}"


GOOD = [line(image, end=end) for end in ("left", "right") for image in ("0001.jpg", "0002.jpg")]


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ([], "has no scale bar; a line is the length of a bar, its standard deviation"),
        ([*GOOD, "2 0.001 100 100 0003.jpg B0"], "line 6: expected the length of a bar"),
        ([*GOOD, line(bar="B1", numbers="0 0.001 1 1")], "line 6: a bar has a length above 0, and a"),
        ([*GOOD, line(bar="B1", numbers="2 0 1 1")], "below the length, in the output's units; got 2 and 0"),
        ([*GOOD, line(bar="B1", numbers="2 1e-31 1 1")], "a standard deviation above 1e-30 and below"),
        ([*GOOD, line(bar="B1", numbers="nan 1 1 1")], "line 6: numbers must be finite"),
        ([*GOOD, line("0003.jpg", numbers="3 0.001 1 1")], "line 6: B0 has other numbers than in line 2"),
        ([*GOOD, f"{line('0003.jpg')} check"], "line 6: B0 has another role than in line 2"),
        ([*GOOD, GOOD[0]], "line 6: B0 left is marked twice in 0001.jpg; keep one of its marks"),
        (GOOD[:2], "line 2: B0 has 1 end, left; a scale bar has two"),
        ([*GOOD, line(end="top")], "line 2: B0 has 3 ends, left, right, top; a scale bar has two"),
        (GOOD[:3], "line 4: the end right of B0 is marked in one image; mark it in another"),
        ([one.replace(".jpg", ".png") for one in GOOD], "has no mark in an image of the model, such"),
        (
            [*GOOD, line("0003.jpg", numbers="2 0.001 5000 100")],
            "line 6: the mark of B0 left, (5000, 100), is outside 0003.jpg, a picture of",
        ),
    ],
)  # fmt: skip
def test_a_file_that_cannot_serve_is_refused_by_its_line(ring, tmp_path, lines, said):
    path = tmp_path / "bars.txt"
    path.write_text("\n".join(["# a comment", *lines]))
    with pytest.raises(InputError) as refused:
        read_scale_bars(path, read_model(ring).images)
    assert said in str(refused.value)
    assert str(refused.value).startswith(str(path))


def test_bars_and_ends_with_blanks_are_told_apart(ring, tmp_path):
    views = (("0001.jpg", 100), ("0002.jpg", 110))
    ends = (("a", "b c"), ("a", "d"), ("a b", "c"), ("a b", "d"))
    rows = ["\t".join(("2", "0.001", str(x), "100", image, *end)) for end in ends for image, x in views]
    (tmp_path / "bars.txt").write_text("\n".join(rows))
    known = read_scale_bars(tmp_path / "bars.txt", read_model(ring).images)
    assert known.bars == ("a", "a b")
    assert known.points.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]


def test_bars_that_make_a_model_one_point_are_refused(ring, tmp_path):
    short = [" ".join(("1e-13", "1e-16", *one.split()[2:])) for one in lines_of(ring)]
    with pytest.raises(InputError, match=r"bars make the model .*e-1. times as large, so small that its cam"):
        sfm_shapefit.locate(ring, RING / "database.db", scale_bars=written(tmp_path, short))


def test_lengths_that_are_none_are_told(ring):
    with pytest.raises(InputError, match=r"0001.jpg and 0001.jpg are one place, and no length"):
        sfm_shapefit.evaluate_lengths(ring, [("0001.jpg", "0001.jpg")])
    few = pycolmap.Reconstruction(ring)
    for point in sorted(few.points3D)[1:]:
        few.delete_point3D(point)
    found = sfm_shapefit.evaluate_lengths(few, [("0001.jpg", "0002.jpg")])
    assert found.lengths == []
    unknown = "nothing is known of the error of the distance of 0001.jpg and 0002.jpg"
    assert found.warnings[-1].startswith(unknown)
    with pytest.raises(sfm_shapefit.UnsolvableError, match=unknown):
        WRITERS.length(few, "0001.jpg", "0002.jpg")


def test_a_result_tells_a_length_as_evaluate_does_whether_it_was_adjusted_or_not(
    ring, ring_located, ring_mapped, tmp_path
):
    ends = ("0001.jpg", "0004.jpg")
    plain = sfm_shapefit.locate(ring, RING / "database.db", adjust="none")
    for found in (plain, ring_located, ring_mapped):
        centers = [found.reconstruction.find_image_with_name(name).projection_center() for name in ends]
        told = found.length(*ends)
        assert told.length == pytest.approx(np.linalg.norm(centers[0] - centers[1]))
        assert str(told).startswith(f"{told.length:.8f} ± "[:6])
        assert " units (95 %)" in str(told)
        assert str(told).endswith("; the scale is open")
    scaled = sfm_shapefit.map_database(RING / "database.db", scale_bars=written(tmp_path, lines_of(ring)))
    told = scaled.length(*ends)  # of the largest model, with what it knows of its scale
    assert told.has_scale
    assert told == scaled.models[0].length(*ends)
    assert "open" not in str(told)
    checked = sfm_shapefit.check(ring, RING / "database.db")
    assert checked.length(*ends) == sfm_shapefit.evaluate_lengths(ring, [ends]).lengths[0].length
    with pytest.raises(InputError, match="no posed image nobody"):
        plain.length("0001.jpg", "nobody.jpg")


def test_a_model_whose_cameras_stand_in_one_place_is_told_of_without_errors(ring):
    turned = pycolmap.Reconstruction(ring)
    for image in turned.images.values():
        turn = image.cam_from_world().rotation
        image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(turn, np.zeros(3)))
    assert sfm_shapefit.evaluate_lengths(turned).usual is None


def test_a_bar_whose_marks_do_not_agree_is_named(ring, tmp_path):
    found = sfm_shapefit.locate(ring, RING / "database.db", scale_bars=written(tmp_path, GOOD))
    assert found.gauge.scale == "input"
    assert found.scale_bars[0].use == "unused"
    assert any("line 2: B0 is of no use: an end lacks agreeing marks in two" in w for w in found.warnings)


def test_evaluate_and_check_compare_with_bars_and_tell_lengths(ring, tmp_path):
    bars, model = written(tmp_path, lines_of(ring)), str(RING / "sparse" / "0")
    command = ["evaluate", model, "--scale-bars", bars, "--length", "0001.jpg", "0004.jpg", "--json"]
    told = json.loads(CliRunner().invoke(app, command).stdout)
    centers = [ring.find_image_with_name(name).projection_center() for name in ("0001.jpg", "0004.jpg")]
    assert told["lengths"][0]["length"]["length"] == pytest.approx(np.linalg.norm(centers[0] - centers[1]))
    assert {bar["use"] for bar in told["scale_bars"]} == {"check"}
    assert [bar["found"] * SCALE for bar in told["scale_bars"]] == pytest.approx(
        [bar["known"] for bar in told["scale_bars"]], rel=1e-4
    )
    assert "4 scale bars contradict the model" in told["warnings"][0]
    told = CliRunner().invoke(app, ["evaluate", model]).stdout
    assert "a length of" in told
    assert "worst direction" in told
    command = ["check", model, "--scale-bars", bars, "--json", "--no-second-opinion"]
    assert len(json.loads(CliRunner().invoke(app, command).stdout)["scale_bars"]) == 4
    for more, said, code in (
        (["--length", "0001.jpg", "nobody.jpg"], "no posed image nobody.jpg", 3),
        ([model, "--length", "0001.jpg", "0002.jpg"], "are of MODEL alone; leave REF out", 2),
    ):
        done = CliRunner().invoke(app, ["evaluate", model, *more])
        assert done.exit_code == code
        assert said in " ".join(done.output.replace("│", " ").split())


@pytest.mark.parametrize("ends", [("0001.jpg", "0004.jpg"), "0001.jpg", 17, [(1, 2, 3)]])
def test_ends_that_are_no_list_of_pairs_are_refused(ends):
    with pytest.raises(InputError, match="ends must be a list of pairs of places"):
        sfm_shapefit.evaluate_lengths(RING / "sparse/0", ends)


def test_without_points_errors_are_not_known_and_lengths_refused():
    poses = sfm_shapefit.average_database(RING / "database.db")
    found = sfm_shapefit.evaluate_lengths(poses)
    assert found.usual is None
    assert "their errors are not known" in str(found.told())
    with pytest.raises(sfm_shapefit.UnsolvableError, match="whose images observe 3D points"):
        sfm_shapefit.evaluate_lengths(poses, [("0001.jpg", "0004.jpg")])
