"""Scale, origin and axes: of the input's centers, of a known distance, of position priors."""

import json
import re
import sqlite3
import struct
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sfm_shapefit import InputError, locate
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import Similarity, compose, fit_similarity, invert, median_spread, normalized
from sfm_shapefit.facts.warnings import prior_warnings
from sfm_shapefit.files.colmap.geodesy import datum_of, enu_of
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.priors import database_priors, exif_priors, table_priors
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.placement.fixed_and_rigged import find_fixed_and_rigged
from sfm_shapefit.placement.gauge import (
    distance_gauge,
    input_gauge,
    metric_gauge,
    moved_gauge,
    moved_to_priors,
    prior_gauge,
    unit_gauge,
)
from sfm_shapefit.placement.gauge_rule import GaugeRule
from sfm_shapefit.placement.prior_fit import compare_with_priors
from sfm_shapefit.refinement.anchored import refine_anchored
from sfm_shapefit.refinement.angular import plan_refinement, refine_angles
from sfm_shapefit.scene.known_positions import KnownPositions
from tests.problems import made_priors
from tests.program import run, run_refused
from tests.scenes import BUNDLED, COURTYARD, RING, read_from, rows_of

RING_MODEL = RING / "sparse" / "0"
TURN = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()


def cameras(seed, n=12):
    return np.random.default_rng(seed).standard_normal((n, 3))


TOLD = 7.0 * cameras(0) + [1.0, -2.0, 3.0]
GAUGES = {
    "unit": unit_gauge,
    "input": lambda t: input_gauge(t, TOLD),
    "metric": lambda t: metric_gauge(
        t, median_spread(t) / median_spread(TOLD), TOLD, np.arange(12) < 1, has_rigs=False
    ),
    "one distance": lambda t: distance_gauge(t, np.array([[3, 7]]), np.array([12.5]), ["a and b"]),
    "distances": lambda t: distance_gauge(t, np.array([[3, 7], [1, 2]]), np.array([2.0, 3.0]), ["a", "b"]),
    "priors": lambda t: prior_gauge(t, made_priors(TOLD @ TURN.T)),
    "moved": lambda t: moved_gauge(unit_gauge(t), t[4], TOLD[4], "e"),
}


@pytest.mark.parametrize("kind", GAUGES)
@settings(max_examples=10)
@given(log_scale=st.floats(-5.0, 5.0), shift=st.floats(-30.0, 30.0), seed=st.integers(0, 99))
def test_a_gauge_undoes_scale_and_origin_of_the_solver_and_is_none_where_it_holds(
    kind, log_scale, shift, seed
):
    t = cameras(0) + 0.01 * cameras(seed + 1)
    inner = Similarity(scale=np.exp(log_scale), rotation=np.eye(3), translation=np.full(3, shift))
    gauge, of_moved = GAUGES[kind](t), GAUGES[kind](inner.apply(t))
    placed = gauge.apply(t)
    size = np.ptp(placed) * (1.0 + abs(shift) / inner.scale)  # digits that a far origin takes
    np.testing.assert_allclose(of_moved.apply(inner.apply(t)), placed, atol=1e-6 * size)
    composed = compose(of_moved.similarity, inner)
    assert composed.scale == pytest.approx(gauge.similarity.scale, rel=1e-6)
    np.testing.assert_allclose(compose(invert(inner), inner).apply(t), t, atol=1e-9 * (1.0 + abs(shift)))
    again = GAUGES[kind](placed)
    np.testing.assert_allclose(again.apply(placed), placed, atol=1e-4 * np.ptp(placed))
    assert again.scale == gauge.scale == of_moved.scale


def test_the_input_gauge_is_recovered_without_turning_the_axes_in_spite_of_a_few_wild_cameras():
    t = cameras(8)
    gauge = input_gauge(t, 7.0 * t + [1.0, -2.0, 3.0])
    assert gauge.scale == "input"
    assert gauge.similarity.scale == pytest.approx(7.0, rel=1e-9)
    np.testing.assert_allclose(gauge.similarity.apply(t), 7.0 * t + [1.0, -2.0, 3.0], atol=1e-8)
    np.testing.assert_array_equal(gauge.similarity.rotation, np.eye(3))
    wild_input, wild_answer = 7.0 * t, t.copy()
    wild_input[3] += 1e4
    wild_answer[5] += 1e4
    assert input_gauge(wild_answer, wild_input).similarity.scale == pytest.approx(7.0, rel=1e-6)


@pytest.mark.parametrize("centers", [np.zeros((12, 3)), np.full((12, 3), 1e6), -cameras(10)])
def test_without_input_centers_or_with_contradicting_ones_the_scale_is_unit(centers):
    t = cameras(10)
    gauge = input_gauge(t, centers)
    placed = gauge.similarity.apply(t)
    assert gauge.scale == "unit"
    assert ("coincide" in gauge.statement) == (np.ptp(centers) == 0.0)
    assert gauge.similarity.scale > 0.0
    np.testing.assert_allclose(placed.mean(axis=0), 0.0, atol=1e-12)
    assert np.median(np.linalg.norm(placed, axis=1)) == pytest.approx(1.0, rel=1e-12)


def test_a_known_distance_becomes_true():
    t = cameras(1)
    placed = distance_gauge(t, np.array([[3, 7]]), np.array([12.5]), ["a and b"]).apply(t)
    assert np.linalg.norm(placed[3] - placed[7]) == pytest.approx(12.5, rel=1e-14)
    np.testing.assert_allclose(placed.mean(axis=0), 0.0, atol=1e-13)
    t[4] = t[5]  # cameras at one place
    with pytest.raises(InputError, match="a and b coincide"):
        distance_gauge(t, np.array([[4, 5]]), np.ones(1), ["a and b"])


def test_locate_makes_a_known_distance_true_and_says_so_and_names_an_unknown_image(tmp_path):
    known = ("--known-distance=0003.jpg", "0007.jpg", "42.5")
    result = run("locate", RING_MODEL, tmp_path / "out", "--json", *known)
    model = pycolmap.Reconstruction(tmp_path / "out")
    centers = {image.name: image.projection_center() for image in model.images.values()}
    assert np.linalg.norm(centers["0003.jpg"] - centers["0007.jpg"]) == pytest.approx(42.5, rel=1e-12)
    assert "0003.jpg and 0007.jpg are 42.5 apart" in json.loads(result.stdout)["scale"]
    unknown = ("--known-distance", "0003.jpg", "x.jpg", "1")
    assert "no posed image x.jpg" in run_refused("locate", RING_MODEL, tmp_path / "none", *unknown)
    database = RING_MODEL.parent.parent / "database.db"
    assert "the database has no image x.jpg" in run_refused("map", database, tmp_path / "none", *unknown)


def test_a_known_distance_of_a_camera_that_is_not_placed_says_nothing():
    model = read_model(RING_MODEL).images
    t, names = model.centers[:6], model.names

    def placed(*known):
        rule = GaugeRule(model, find_fixed_and_rigged(model), "auto", distances=known)
        return rule.choose(np.arange(6), t, None).similarity.apply(t)

    found = placed((names[1], names[4], 3.0), (names[2], names[7], 9.0))
    assert np.linalg.norm(found[1] - found[4]) == pytest.approx(3.0, rel=1e-12)
    with pytest.raises(UnsolvableError, match=f"{names[7]} could not be placed"):
        placed((names[2], names[7], 9.0))


def test_several_known_distances_are_fitted_robustly_and_say_how_well():
    rng = np.random.default_rng(2)
    ratios = []
    for seed in range(20):
        t = cameras(seed)
        pairs = rng.permuted(np.tile(np.arange(12), (8, 1)), axis=1)[:, :2]
        distances = 4.0 * np.linalg.norm(t[pairs[:, 0]] - t[pairs[:, 1]], axis=1)
        distances = distances + 0.02 * rng.standard_normal(8)
        distances[5] *= 3.0  # read in feet
        gauge = distance_gauge(t, pairs, distances, [str(k) for k in range(8)])
        assert "5 miss theirs most" in gauge.statement
        ratios.append((gauge.similarity.scale / 4.0 - 1.0) / gauge.scale_sigma)
    assert 0.3 < np.median(np.abs(ratios)) < 1.5  # 0.67 where the deviation is known exactly
    both = np.array([[0, 1], [2, 3]])
    apart = np.linalg.norm(t[both[:, 0]] - t[both[:, 1]], axis=1)
    warning = distance_gauge(t, both, apart * [1.0, 2.0], ["a", "b"]).warning
    assert "contradict one another" in warning
    assert "agree" not in warning


def test_locate_takes_several_known_distances_and_tells_each(ring, tmp_path):
    told = [(1, 4, 1.0), (2, 7, 1.0), (3, 6, 1.0), (0, 5, 2.0)]
    flags, known = [], []
    for i, j, factor in told:
        known.append(factor * 3.0 * np.linalg.norm(ring.centers[i] - ring.centers[j]))
        flags += ["--known-distance", ring.names[i], ring.names[j], known[-1]]
    facts = json.loads(run("locate", RING_MODEL, tmp_path / "out", "--json", "--no-report", *flags).stdout)
    assert "3 of 4 known distances agree" in facts["scale"]
    found = [row["found"] for row in facts["known_distances"]]
    np.testing.assert_allclose(found[:3], known[:3], rtol=1e-4)
    np.testing.assert_allclose(found[3], known[3] / 2.0, rtol=1e-4)
    options = tmp_path / "options.toml"
    rows = [[ring.names[i], ring.names[j], k] for (i, j, _), k in zip(told, known, strict=True)]
    options.write_text(f"known_distance = {json.dumps(rows)}")
    again = json.loads(run("locate", RING_MODEL, tmp_path / "two", "--json", "--config", options).stdout)
    assert again["known_distances"] == facts["known_distances"]


def test_exact_priors_give_back_scale_axes_and_origin_and_on_a_line_the_axes_stay():
    t = cameras(3)
    truth = 5.0 * t @ TURN.T + [100.0, -20.0, 3.0]
    gauge = prior_gauge(t, made_priors(truth, rows=[0, 2, 3, 7, 9]))
    np.testing.assert_allclose(gauge.apply(t), truth, atol=1e-9)
    np.testing.assert_allclose(gauge.axes, TURN, atol=1e-12)
    line = np.outer(np.arange(8.0), [1.0, 2.0, -1.0])
    gauge = prior_gauge(line, made_priors(3.0 * line + 1.0))
    assert gauge.axes is None
    assert "lie on a line" in gauge.warning
    assert gauge.similarity.scale == pytest.approx(3.0, rel=1e-9)


@pytest.mark.parametrize("sigma", [0.0, 0.02])
@pytest.mark.parametrize("count", [3, 4])
def test_few_priors_are_fitted_by_least_squares_and_none_is_called_wrong(count, sigma):
    """Seven unknowns leave a median of residuals nothing to tell noise by."""
    for seed in range(20):
        rng = np.random.default_rng(300 + seed)
        t = cameras(seed)
        measured = 5.0 * t @ TURN.T + sigma * rng.standard_normal(t.shape)
        priors = made_priors(measured, rows=np.arange(count))
        gauge = prior_gauge(t, priors)
        best = fit_similarity(t[:count], measured[:count])
        np.testing.assert_allclose(gauge.apply(t), best.apply(t), atol=1e-9)
        assert gauge.axes is not None
        assert gauge.warning == ""
        assert f"{count}, too few to check one another" in gauge.statement
        none = np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3))
        assert not len(compare_with_priors(gauge.apply(t), np.zeros(len(t)), priors, *none).wrong)


@pytest.mark.parametrize("count", [5, 6, 8])
def test_one_wrong_prior_of_five_or_more_is_named_and_has_no_part(count):
    for seed in range(10):
        rng = np.random.default_rng(400 + seed)
        t = cameras(seed)
        truth = 5.0 * t @ TURN.T
        measured = truth + 0.02 * rng.standard_normal(t.shape)
        measured[1] += [3.0, -2.0, 2.0]
        priors = made_priors(measured, rows=np.arange(count))
        placed = prior_gauge(t, priors).apply(t)
        assert np.median(np.linalg.norm(placed - truth, axis=1)) < 5 * 0.02  # by 4 right ones of 12 - 7
        none = np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3))
        assert compare_with_priors(placed, np.zeros(len(t)), priors, *none).wrong[0] == 1


def test_where_the_scale_is_known_priors_give_turn_and_shift_as_far_as_they_tell_them():
    t = cameras(3)
    known = distance_gauge(t, np.array([[0, 1]]), 2.0 * np.linalg.norm(t[:1] - t[1:2], axis=1), ["a, b"])
    truth = 2.0 * t @ TURN.T + [100.0, -20.0, 3.0]
    for rows, apart in ((np.arange(12), 1.001), (np.arange(3), 1.0)):
        gauge = moved_to_priors(known, t, made_priors(apart * truth, rows=rows))
        assert gauge.similarity.scale == known.similarity.scale
        assert gauge.scale == "distance"
        assert gauge.statement.startswith("distance: a, b are")
        moved, there = gauge.apply(t)[rows], apart * truth[rows]
        np.testing.assert_allclose(moved.mean(axis=0), there.mean(axis=0), atol=0.02)
        np.testing.assert_allclose(gauge.axes, TURN, atol=1e-6)
    one = moved_to_priors(known, t, made_priors(truth, rows=[4]))
    np.testing.assert_allclose(one.apply(t)[4], truth[4], atol=1e-12)
    assert one.axes is None
    assert "fewer than three" in one.warning


def test_where_axes_mean_nothing_priors_on_a_line_turn_the_model_onto_it():
    """As in `map`: a strip of a drone whose averaged rotations look anywhere."""
    line = np.outer(np.arange(8.0), [1.0, 2.0, -1.0])
    turned = 3.0 * line @ np.diag([-1.0, -1.0, 1.0]) + 1.0
    for rows in (np.arange(8), np.array([1, 6])):
        gauge = prior_gauge(line, made_priors(turned, rows=rows), axes_known=False)
        np.testing.assert_allclose(gauge.apply(line), turned, atol=1e-9)
        assert "about it by any angle" in gauge.warning
    with pytest.raises(InputError, match="contradict"):
        prior_gauge(line, made_priors(-line))


def test_a_fifth_of_the_priors_off_by_100_sigma_does_no_harm():
    rng = np.random.default_rng(104)
    t, sigma = cameras(4, n=60), 0.05
    truth = 5.0 * t @ TURN.T
    measured = truth + sigma * rng.standard_normal(truth.shape)
    clean = prior_gauge(t, made_priors(measured, sigma)).apply(t)
    wrong = rng.permutation(60)[:12]
    measured[wrong] += 100.0 * sigma * rng.standard_normal((12, 3))
    gauge = prior_gauge(t, made_priors(measured, sigma))
    # Least squares of 7 unknowns on 3 * 48 coordinates leaves sigma sqrt(3 * 7 / 144) = 0.38 sigma a camera.
    for placed in (clean, gauge.apply(t)):
        assert np.median(np.linalg.norm(placed - truth, axis=1)) < 2.0 * 0.38 * sigma
    agreeing = int(gauge.statement.split("; ")[1].split(" of ")[0])
    assert 44 <= agreeing <= 50  # of the 48 right ones; a wrong one may be near by chance
    assert gauge.warning == ""


@pytest.mark.parametrize("count", [12, 14, 25])
def test_nearly_half_of_the_priors_off_by_one_shift_have_no_part_and_lie_on_no_line(count):
    for seed in range(3):
        rng, t = np.random.default_rng(seed), cameras(seed, count)
        angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
        t = np.stack([np.cos(angle), np.sin(angle), 0.03 * t[:, 2]], axis=1)
        truth = 50.0 * t @ TURN.T + [7.0, -300.0, 20.0]
        told = truth + rng.normal(0.0, 0.02, t.shape)
        told[: (count - 1) // 2] += [30.0, 10.0, 5.0]
        gauge = prior_gauge(t, made_priors(told))
        assert gauge.warning == ""
        # Right ones are on half of the circle: on the other, their fit is off by several of their errors.
        assert np.abs(gauge.apply(t) - truth).max() < 10 * 0.02


@pytest.mark.parametrize(
    ("positions", "rows", "message"),
    [
        (cameras(5), [4], "a scale needs two"),
        (cameras(5), np.zeros(0, dtype=np.int64), "a scale needs two"),
        (np.full((12, 3), 4.0), None, "coincide"),
    ],
)
def test_too_few_priors_and_those_at_one_place_are_refused_and_unrelated_ones_warned_about(
    positions, rows, message
):
    with pytest.raises(InputError, match=message):
        prior_gauge(cameras(5), made_priors(positions, rows=rows))
    assert "mean nothing: are they of this scene?" in prior_gauge(cameras(7), made_priors(cameras(8))).warning


TAKEN = np.random.default_rng(11).standard_normal((10, 3)) * [50.0, 40.0, 15.0]
READINGS = {
    "with latitude and longitude swapped": lambda lla: lla[:, [1, 0, 2]],
    "with the sign of latitude or longitude changed": lambda lla: lla * [1, -1, 1],
    "with altitudes in feet": lambda lla: lla / [1.0, 1.0, 0.3048],
    "with two axes swapped, or the sign of one changed": None,
    "": lambda lla: lla,
}


@pytest.mark.parametrize("reading", READINGS)
def test_a_reading_of_the_priors_that_fits_far_better_is_named(reading):
    """Noise of 1 m in a scene of 50 m is no reason to name another one."""
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    noisy = TAKEN + np.random.default_rng(12).standard_normal(TAKEN.shape)
    lla = np.asarray(transform.enu_to_ellipsoid(noisy, 40.0, -75.0, 100.0))
    priors = made_priors(noisy[:, [1, 0, 2]])
    if READINGS[reading] is not None:
        read = READINGS[reading](lla)
        datum = datum_of(read)
        priors = replace(made_priors(enu_of(read, datum)), datum=datum)
    warning = prior_gauge(TAKEN @ TURN.T, priors).warning
    assert reading in warning
    assert bool(reading) == ("give them so" in warning)


@pytest.fixture(scope="module")
def ring():
    return read_model(RING_MODEL).images


def write_table(path, model, positions, lines=(), sep=" "):
    rows = [
        sep.join([name, *(repr(float(x)) for x in p)]) for name, p in zip(model.names, positions, strict=True)
    ]
    path.write_text("\n".join([*lines, *rows]) + "\n")
    return path


def test_a_database_given_for_a_table_of_priors_is_told_how_its_own_are_read(ring):
    with pytest.raises(InputError, match="its own pose priors are priors=database"):
        table_priors(BUNDLED / "ring8" / "database.db", ring)


def test_a_table_is_read_by_name_with_either_separator_deviations_and_latitudes(ring, tmp_path):
    path = tmp_path / "priors.txt"
    for sep in (" ", ","):
        write_table(path, ring, ring.centers, ["# comment", "elsewhere.jpg 1 2 3"], sep)
        found = table_priors(path, ring).known
        np.testing.assert_array_equal(found.positions, ring.centers)
        assert np.isnan(found.information).all()
    path.write_text(f"name,x,y,z,sx,sy,sz\n{ring.names[0]},1,2,3,0.5,0.25,2\n")
    np.testing.assert_array_equal(table_priors(path, ring).known.information, [np.diag([4.0, 16.0, 0.25])])

    names = ring.names[:3]
    path.write_text(
        f"name,lat,lon,alt\n{names[0]},48.0,11.0,500\n{names[1]},48.0,11.001,500\n{names[2]},48.001,11.0,510\n"
    )
    priors = table_priors(path, ring)
    assert priors.datum.geodetic == (48.0, 11.0, 500.0)  # medians of the three
    found = priors.known.positions
    # WGS84 at 48 N: a degree of longitude is 74628 m, of latitude 111200 m.
    np.testing.assert_allclose(found[1] - found[0], [74.628, 0.0, 0.0], atol=2e-2)
    np.testing.assert_allclose(found[2] - found[0], [0.0, 111.20, 10.0], atol=2e-2)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0003.jpg 1 2", "line 2: expected a name"),
        ("0003.jpg 1 2 x", "line 2: expected a name"),
        ("0003.jpg 1 2 inf", "line 2: coordinates must be finite"),
        ("0003.jpg 1 2 1e308", "line 2: coordinates must be finite .* below 1e"),
        ("0003.jpg 1 2 3 1e-200", "line 2: coordinates must be finite and standard deviations positive"),
        ("0003.jpg 1 2 3 -1", "line 2: coordinates must be finite and standard deviations positive"),
        ("0001.jpg 1 2 3", "line 2: 0001.jpg appears twice"),
    ],
)
def test_a_malformed_line_of_a_table_is_named(ring, tmp_path, line, message):
    path = tmp_path / "priors.txt"
    path.write_text(f"0001.jpg 0 0 0\n{line}\n")
    with pytest.raises(InputError, match=message):
        table_priors(path, ring)


def test_priors_of_other_images_and_those_that_there_are_not_are_refused(ring, tmp_path):
    path = tmp_path / "priors.txt"
    path.write_text("other.jpg 1 2 3\n")
    with pytest.raises(InputError, match="no position prior of the model's images"):
        table_priors(path, ring)
    of_database = ("--priors", "database")
    assert "no position prior" in run_refused("locate", RING_MODEL, tmp_path / "out", *of_database)
    tracks = BUNDLED / "facade9" / "sparse" / "0"
    assert "give one (--database FILE)" in run_refused("locate", tracks, tmp_path / "out", *of_database)


NEW = (
    "CREATE TABLE pose_priors (pose_prior_id INTEGER PRIMARY KEY, corr_data_id INTEGER, "
    "corr_sensor_id INTEGER, corr_sensor_type INTEGER, position BLOB, position_covariance BLOB, "
    "gravity BLOB, coordinate_system INTEGER)"
)
OLD = (
    "CREATE TABLE pose_priors (image_id INTEGER PRIMARY KEY, position BLOB, coordinate_system INTEGER, "
    "position_covariance BLOB)"
)


def database_with_priors(path, schema, rows):
    """Rows: image id, name, position, covariance by columns, coordinate system."""
    connection = sqlite3.connect(path)
    connection.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT)")
    connection.execute(schema)
    for k, (image_id, name, position, covariance, system) in enumerate(rows):
        connection.execute("INSERT INTO images VALUES (?, ?)", (image_id, name))
        xyz = np.array(position, dtype="<f8").tobytes()
        cov = None if covariance is None else np.array(covariance, dtype="<f8").tobytes()
        if schema == NEW:
            values = (k, image_id, 1, 0, xyz, cov, None, system)
        else:
            values = (image_id, xyz, system, cov)
        connection.execute(f"INSERT INTO pose_priors VALUES ({','.join('?' * len(values))})", values)
    connection.commit()
    connection.close()
    return path


@pytest.mark.parametrize("schema", [NEW, OLD])
def test_priors_of_a_database_of_any_version_are_read(ring, tmp_path, schema):
    rows = [
        (9, "0003.jpg", [1, 2, 3], np.diag([1.0, 4.0, 9.0]).ravel(), 1),
        (4, "0001.jpg", [4, 5, 6], None, 1),
        (3, "0002.jpg", [4, 5, 7], np.zeros(9), 1),  # what is not positive definite is not known
    ]
    rows += [(5, "else.jpg", [7, 8, 9], None, 1), (6, "0004.jpg", [np.nan, 0, 0], None, 1)]
    known = read_from(database_with_priors(tmp_path / "d.db", schema, rows), database_priors, ring).known
    by_name = {
        ring.names[k]: p.tolist() for k, p in zip(known.indices.tolist(), known.positions, strict=True)
    }
    assert by_name == {"0003.jpg": [1, 2, 3], "0001.jpg": [4, 5, 6], "0002.jpg": [4, 5, 7]}
    assert np.isfinite(known.information).all(axis=(1, 2)).sum() == 1
    third = [ring.names[k] for k in known.indices.tolist()].index("0003.jpg")
    np.testing.assert_array_equal(known.information[third], np.diag([1.0, 1.0 / 4.0, 1.0 / 9.0]))


def test_a_database_without_usable_priors_is_refused(ring, tmp_path):
    with pytest.raises(InputError, match="no position prior"):
        read_from(RING / "database.db", database_priors, ring)
    rows = [(1, "0001.jpg", [1, 2, 3], None, 1), (2, "0002.jpg", [4, 5, 6], None, 0)]
    with pytest.raises(InputError, match="mixes WGS84 and Cartesian"):
        read_from(database_with_priors(tmp_path / "d.db", NEW, rows), database_priors, ring)


def test_locate_turns_the_whole_model_with_its_directions_and_deviations_onto_priors(
    ring, tmp_path, ring_located
):
    quarter = Rotation.from_euler("z", 90, degrees=True).as_matrix()  # x becomes y, y becomes -x
    truth = 2.0 * ring.centers @ quarter.T + [1000.0, 0.0, -50.0]
    table = write_table(tmp_path / "priors.txt", ring, truth)
    plain, found = ring_located, locate(RING_MODEL, priors=table)
    for image_id, center in zip(ring.ids.tolist(), truth, strict=True):
        image, before = found.reconstruction.image(image_id), plain.reconstruction.image(image_id)
        apart = np.linalg.norm(before.projection_center() - ring.centers[ring.ids == image_id][0])
        assert np.linalg.norm(image.projection_center() - center) <= 2.0 * apart + 0.05
        # A turn of the world by the axes A: cam_from_world becomes R A^T.
        expected = before.cam_from_world().rotation.matrix() @ found.gauge.axes.T
        np.testing.assert_allclose(image.cam_from_world().rotation.matrix(), expected, atol=1e-12)
    before, after = (r.reconstruction.compute_mean_reprojection_error() for r in (plain, found))
    assert after == pytest.approx(before, abs=1e-5)  # exact matches: rounding alone
    ratio = found.gauge.similarity.scale / plain.gauge.similarity.scale
    for before, after in zip(plain.cameras, found.cameras, strict=True):
        x, y, z = before.sigma
        # The ring is exact, so that the turn is a quarter to 1e-6 or so, and so are the variances' shares.
        np.testing.assert_allclose(after.sigma, ratio * np.array([y, x, z]), rtol=1e-4)
        xy, xz, yz = before.correlation
        np.testing.assert_allclose(after.correlation, [-xy, -yz, xz], atol=1e-3)
    for before, after in zip(plain.pairs, found.pairs, strict=True):
        np.testing.assert_allclose(after.direction, quarter @ before.direction, atol=1e-5)


def test_priors_mend_what_directions_leave_open_and_a_fifth_of_wrong_ones_does_not_pull():
    """A drive along a line: directions with errors drift; positions known to a few centimetres do not."""
    terms, start, truth, priors = drive(sigma=0.05)
    before = np.linalg.norm(start - truth, axis=1)
    after = np.linalg.norm(refine_anchored(*terms, priors) - truth, axis=1)
    assert np.median(before) > 5.0 * np.median(after)
    assert np.median(after) < 1.538 * 0.05  # the median error of the priors themselves
    wrong = np.random.default_rng(1).permutation(len(truth))[: len(truth) // 5]
    priors.positions[wrong] += 5.0 * np.random.default_rng(2).standard_normal((len(wrong), 3))
    left = np.linalg.norm(refine_anchored(*terms, priors) - truth, axis=1)
    # A fifth fewer positions: sqrt(5 / 4) times the error, if the wrong ones have no part.
    assert np.median(left) < 1.25 * np.sqrt(5.0 / 4.0) * np.median(after)


def drive(sigma):
    """Fifty cameras in a row, each seeing the next four, placed by directions alone; priors of all."""
    rng = np.random.default_rng(5)
    n = 50
    truth = np.stack([np.arange(n), 2.0 * np.sin(np.arange(n) / 8.0), 0.3 * rng.standard_normal(n)], axis=1)
    edges = np.array([(i, j) for i in range(n) for j in range(i + 1, min(i + 5, n))])
    error = 0.01
    exact = normalized(truth[edges[:, 0]] - truth[edges[:, 1]])
    v = normalized(exact + error * rng.standard_normal(exact.shape))
    graph = ViewGraph(n, edges, v)
    covariance = np.broadcast_to(error**2 * np.eye(2), (len(edges), 2, 2))
    measured = MeasuredGraph(graph, covariance=covariance)
    found = refine_angles(measured, truth, plan_refinement(graph))
    positions = truth + sigma * rng.standard_normal(truth.shape)
    gauge = prior_gauge(found.locations, made_priors(positions, sigma))
    start = gauge.similarity.apply(found.locations)
    if gauge.axes is not None:
        positions, truth = positions @ gauge.axes, truth @ gauge.axes
    anchors = KnownPositions(np.arange(n), positions, np.broadcast_to(np.eye(3) / sigma**2, (n, 3, 3)))
    return (measured, start, found.levels_rad), start, truth, anchors


def test_a_model_with_a_datum_is_compared_with_latitudes_where_they_stand(ring, tmp_path):
    """A degree of latitude is 111.20 m at 48 N, one of longitude 74.628 m a thousandth."""
    degrees = ring.centers / [74628.0, 111200.0, 1.0]
    table = tmp_path / "gps.csv"
    rows = [
        f"{n},{48.0 + y},{11.0 + x},{500.0 + z}" for n, (x, y, z) in zip(ring.names, degrees, strict=True)
    ]
    table.write_text("\n".join(["name,lat,lon,alt", *rows]))
    run("locate", RING_MODEL, tmp_path / "out", "--priors", table, "--no-report")
    facts = json.loads(run("evaluate", tmp_path / "out", table, "--json").stdout)
    assert facts["num_common"] == len(ring.names)
    assert facts["position_error"]["max"] < 0.01
    assert all(float(row["prior_angle_deg"]) < 0.1 for row in rows_of(tmp_path / "out" / "pairs.csv"))
    higher = [f"{row.rsplit(',', 1)[0]},{float(row.rsplit(',', 1)[1]) - 2.0}" for row in rows]
    table.write_text("\n".join(["name,lat,lon,alt", *higher]))
    facts = json.loads(run("evaluate", tmp_path / "out", table, "--json").stdout)
    np.testing.assert_allclose(facts["median_offset"], [0.0, 0.0, 2.0], atol=0.01)
    assert facts["aligned_position_error"]["max"] < 0.01
    without = json.loads(run("evaluate", RING_MODEL, table, "--json").stdout)
    assert without["position_error"] is None
    assert without["aligned_position_error"]["max"] < 0.01
    shown = run("evaluate", RING_MODEL, table, "--csv", tmp_path / "errors.csv").output
    assert "no datum" in shown
    assert len((tmp_path / "errors.csv").read_text().splitlines()) == 1 + len(ring.names)
    assert "leave these out" in run("evaluate", RING_MODEL, table, "--trajectory", code=3).output
    write_table(tmp_path / "xyz.txt", ring, ring.centers + 1.0)
    plain = json.loads(run("evaluate", RING_MODEL, tmp_path / "xyz.txt", "--json").stdout)
    np.testing.assert_allclose(plain["median_offset"], [-1.0, -1.0, -1.0], atol=1e-9)


def test_locate_lets_priors_pull_and_says_by_how_much(ring, tmp_path):
    rng = np.random.default_rng(3)
    sigma = 0.01
    noisy = ring.centers + sigma * rng.standard_normal(ring.centers.shape)
    table = write_table(tmp_path / "priors.txt", ring, noisy)
    arguments = ("locate", RING_MODEL, "--priors", table, "--no-report", "--json")
    plain = json.loads(run(*arguments, tmp_path / "plain").stdout)
    assert "the priors moved cameras" not in plain["scale"]
    table.write_text("\n".join(f"{line} {sigma}" for line in table.read_text().splitlines()))
    facts = json.loads(run(*arguments, tmp_path / "out").stdout)
    assert "; the priors moved cameras by " in facts["scale"]
    assert facts["sigma_of"].endswith("relative to the position priors")
    assert not plain["sigma_of"].endswith("priors")
    run(*arguments, tmp_path / "full", "--adjust", "full")
    off = []
    for folder in ("plain", "out", "full"):
        model = pycolmap.Reconstruction(tmp_path / folder)
        centers = {image.name: image.projection_center() for image in model.images.values()}
        off.append([np.linalg.norm(centers[name] - p) for name, p in zip(ring.names, noisy, strict=True)])
    for pulled in off[1:]:
        assert np.sum(np.square(pulled)) < np.sum(np.square(off[0]))  # nearer to the priors than before


def test_priors_with_too_small_deviations_bend_no_model_and_are_told(ring, tmp_path):
    """As those of GPS; a shift to the few that fit by chance took 2 of 14 cameras from a sound model."""
    rng, stated, factor = np.random.default_rng(4), 0.05, 6.0
    off = factor * stated * rng.standard_normal(ring.centers.shape)
    table = write_table(tmp_path / "priors.txt", ring, ring.centers + off)
    table.write_text("\n".join(f"{line} {stated}" for line in table.read_text().splitlines()))
    found = locate(RING_MODEL, RING / "database.db", priors=table)
    (told,) = (warning for warning in found.warnings if "as far off as their standard deviations" in warning)
    # By the median of eight, of 17 degrees of freedom among 24, and down by a halving at most.
    assert 0.25 * factor < float(re.search(r"are ([\d.]+) times", told)[1]) < 2.0 * factor
    placed = [found.reconstruction.find_image_with_name(name).projection_center() for name in ring.names]
    fit = fit_similarity(np.array(placed), ring.centers)
    # The model keeps its shape, to a hundredth of the errors of the priors.
    assert np.abs(fit.apply(np.array(placed)) - ring.centers).max() < 0.01 * factor * stated
    assert (
        np.linalg.norm(np.mean(placed - ring.centers, axis=0))
        < 3.0 * factor * stated / len(ring.names) ** 0.5
    )


def test_priors_most_of_which_are_as_good_as_they_say_keep_their_deviations(ring, tmp_path):
    rng, stated = np.random.default_rng(6), 0.002
    off = stated * rng.standard_normal(ring.centers.shape)
    off[[0, 2, 5]] += 0.5 * rng.standard_normal((3, 3))
    table = write_table(tmp_path / "priors.txt", ring, ring.centers + off)
    table.write_text("\n".join(f"{line} {stated}" for line in table.read_text().splitlines()))
    found = locate(RING_MODEL, RING / "database.db", priors=table)
    assert not any("as far off as their standard deviations" in warning for warning in found.warnings)
    placed = [found.reconstruction.find_image_with_name(name).projection_center() for name in ring.names]
    np.testing.assert_allclose(placed, ring.centers, atol=5.0 * stated)


def test_a_wrong_prior_is_named_and_no_pair_is_blamed_for_it():
    """Cameras 10 and 11 have no prior, that of 4 is wrong, 6 is off by its own uncertainty."""
    rng = np.random.default_rng(4)
    t = cameras(4)
    truth = 5.0 * t @ TURN.T
    given = truth + 0.02 * rng.standard_normal(truth.shape)
    given[4] += [0.0, 0.6, 0.0]
    given[6] += [0.0, 0.6, 0.0]
    priors = made_priors(given, 0.02, rows=np.arange(10))
    gauge = prior_gauge(t, priors)
    pairs = np.array([(i, j) for i in range(12) for j in range(i)])
    directions = normalized(truth[pairs[:, 0]] - truth[pairs[:, 1]])
    directions[9] = np.nan
    sigmas = np.full(12, np.nan)
    sigmas[6] = 0.3
    found = compare_with_priors(gauge.apply(t), sigmas, priors, pairs, directions)
    without = (pairs >= 10).any(axis=1)
    without[9] = True
    np.testing.assert_array_equal(np.isnan(found.angles_deg), without)
    assert found.wrong.tolist() == [4]
    assert found.off[4] == pytest.approx(0.6, abs=0.06)
    (sentence,) = prior_warnings(found, [f"{k}.jpg" for k in range(12)])
    assert sentence.startswith("1 position prior is wrong, most likely: 4.jpg (0.")
    assert not list(prior_warnings(found._replace(wrong=found.wrong[:0]), []))
    everywhere = compare_with_priors(gauge.apply(t), np.full(12, np.inf), priors, pairs, directions)
    assert len(everywhere.wrong) == 0


def test_the_wrong_position_of_the_bundled_table_is_named_everywhere(tmp_path):
    out = tmp_path / "out"
    arguments = ("locate", COURTYARD / "sparse" / "0", out, "--priors", BUNDLED / "gps.csv", "--json")
    facts = json.loads(run(*arguments).stdout)
    assert list(facts["wrong_priors"]) == ["0004.jpg"]
    (warning,) = (line for line in facts["warnings"] if "prior" in line)
    assert "0004.jpg (29" in warning
    assert not re.search(r"00(15|16)\.jpg", warning)  # a false pair, and contradicted as one
    off = {row["name"]: float(row["prior_off"]) for row in rows_of(out / "cameras.csv")}
    assert max(off, key=off.get) == "0004.jpg"
    assert np.median(list(off.values())) < 0.1
    assert "0004.jpg (29" in (out / "report.html").read_text()


def exif_segment(latitude, longitude, altitude):
    """The APP1 segment of a JPEG file with a position, big-endian TIFF: IFD 0, the GPS IFD, rationals."""
    numbers = []
    for angle in (latitude, longitude):
        minutes, degrees = 60.0 * (angle % 1.0), int(angle)
        numbers += [degrees, 1, int(minutes), 1, round(60e6 * (minutes % 1.0)), 1_000_000]
    numbers += [round(1000.0 * altitude), 1000]
    start = 8 + 2 + 12 + 4 + 2 + 12 * 6 + 4
    entries = [
        struct.pack(">HHI4s", 1, 2, 2, b"N\0\0\0"),
        struct.pack(">HHII", 2, 5, 3, start),
        struct.pack(">HHI4s", 3, 2, 2, b"E\0\0\0"),
        struct.pack(">HHII", 4, 5, 3, start + 24),
        struct.pack(">HHI4s", 5, 1, 1, b"\0\0\0\0"),
        struct.pack(">HHII", 6, 5, 1, start + 48),
    ]
    tiff = struct.pack(">2sHI", b"MM", 42, 8) + struct.pack(">HHHIII", 1, 0x8825, 4, 1, 26, 0)
    tiff += struct.pack(">H", 6) + b"".join(entries) + struct.pack(">I", 0) + struct.pack(">14I", *numbers)
    return b"\xff\xe1" + struct.pack(">H", len(tiff) + 8) + b"Exif\0\0" + tiff


def test_positions_of_exif_data_are_priors(ring, tmp_path):
    assert "no position prior of the model's images" in run_refused(
        "locate", RING_MODEL, tmp_path / "none", "--priors", tmp_path
    )
    pycolmap.Bitmap.from_array(np.zeros((8, 8, 3), np.uint8)).write(tmp_path / "black.jpg")
    plain = (tmp_path / "black.jpg").read_bytes()
    for name, (x, y, z) in zip(ring.names[:6], ring.centers, strict=False):
        place = exif_segment(48.0 + (y + 10.0) / 111200.0, 11.0 + (x + 10.0) / 74628.0, 500.0 + z)
        (tmp_path / name).write_bytes(plain[:2] + place + plain[2:])
    (tmp_path / ring.names[6]).write_bytes(plain)
    found = exif_priors(tmp_path, ring)
    assert found.known.indices.tolist() == list(range(6))
    positions, truth = found.known.positions, ring.centers[:6]
    np.testing.assert_allclose(positions - positions[0], truth - truth[0], atol=0.01)
    facts = json.loads(run("locate", RING_MODEL, tmp_path / "out", "--priors", tmp_path, "--json").stdout)
    assert "EXIF data of 6 images" in facts["scale"]
    assert facts["datum"]["latitude_deg"] == pytest.approx(48.0, abs=1e-3)
