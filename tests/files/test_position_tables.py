"""Tables of positions of other programs, pose-prior JSON and pose priors of any database."""

import json
import sqlite3

import numpy as np
import pycolmap
import pytest

from sfm_shapefit import InputError, locate
from sfm_shapefit.commands.evaluate import evaluate_against_table
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.files.colmap.priors import MissingPriorsError, database_priors, exif_priors, table_priors
from tests.scenes import RING, read_from

MODEL = RING / "sparse" / "0"
EARTH = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
SIGMAS = np.diag([0.02, 0.02, 0.05]) ** 2


@pytest.fixture(scope="module")
def ring():
    return read_model(MODEL).images


def on_earth(ring, latitude=47.3, longitude=8.5):
    """Latitudes, longitudes and altitudes of the ring's cameras, ten times as far apart."""
    return np.asarray(EARTH.enu_to_ellipsoid(10.0 * ring.centers, latitude, longitude, 400.0))


def write(path, ring, cells, header="", separator=","):
    """Write a table; cells are those of each image after its name."""
    rows = [separator.join([name, *map(str, row)]) for name, row in zip(ring.names, cells, strict=True)]
    path.write_text("\n".join([*([header] if header else []), *rows]) + "\n", encoding="utf-8")
    return path


def assert_placed(priors, ring, tolerance=1e-3):
    """Assert that positions are the ring's but for a shift; axes of another datum turn by 1e-5."""
    apart, truth = priors.known.positions, 10.0 * ring.centers[priors.known.indices]
    np.testing.assert_allclose(apart - apart[0], truth - truth[0], atol=tolerance)


def sexagesimal(degrees, letter):
    minutes = 60.0 * (degrees % 1.0)
    return f'"{int(degrees)} deg {int(minutes)}\' {60.0 * (minutes % 1.0):.9f}"" {letter}"'


def with_comma(row):
    return [repr(float(value)).replace(".", ",") for value in row]


LATITUDE, LONGITUDE, ALTITUDE = 0, 1, 2
LON_LAT = [LONGITUDE, LATITUDE, ALTITUDE]
ACCURATE = [0.02, 0.05]
HEADERS = {
    "exiftool": ("SourceFile,GPSLatitude,GPSLongitude,GPSAltitude", ",", lambda g: g),
    "exiftool, words": (
        "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude",
        ",",
        lambda g: [sexagesimal(g[0], "N"), sexagesimal(g[1], "E"), f"{g[2]:.6f} m Above Sea Level"],
    ),
    "exiftool, signs apart": (
        "SourceFile,GPSLatitude,GPSLatitudeRef,GPSLongitude,GPSLongitudeRef,GPSAltitude,ImageHeight,Make",
        ",",
        lambda g: [g[0], "N", g[1], "East", g[2], 3000, "DJI"],
    ),
    "Metashape": (
        '# CoordinateSystem: GEOGCS["WGS 84"]\n'
        "#Label,X/Longitude,Y/Latitude,Z/Altitude,Accuracy_X/Y_(m),Accuracy_Z_(m)",
        ",",
        lambda g: [*g[LON_LAT], *ACCURATE],
    ),
    "Pix4D": (
        "imagename,latitude [decimal degrees],longitude [decimal degrees],altitude [meter],"
        "accuracy horizontal [meter],accuracy vertical [meter]",
        ",",
        lambda g: [*g, *ACCURATE],
    ),
    "Mission Planner": (
        "#name latitude/Y longitude/X height/Z yaw pitch roll SAlt",
        " ",
        lambda g: [*g, 10.0, 0.0, -5.0, 0.0],
    ),
    "DJI": (
        "Name,Latitude,Longitude,AbsAlt,RltAlt,Pitch,Roll,Yaw,StdHorizon,StdHeight,Q,Date,Time",
        ",",
        lambda g: [*g, 50.0, 0, 0, 0, *ACCURATE, 1, "2026:05:01", "10:00:00"],
    ),
    "drone log": ("image;lon_deg;lat_deg;alt_m", ";", lambda g: with_comma(g[LON_LAT])),
    "flight log": ("#name,longitude,latitude,altitude", ",", lambda g: g[LON_LAT]),
    "flight log, x and y": ("#name,x,y,alt", ",", lambda g: g[LON_LAT]),
    "tabs": ("#name\tutc\tlongitude\tlatitude\theight", "\t", lambda g: [0, *g[LON_LAT]]),
    "OpenDroneMap": ("EPSG:4326", " ", lambda g: g[LON_LAT]),
    "OpenDroneMap, accuracies": ("EPSG:4326", " ", lambda g: [*g[LON_LAT], 0, 0, 0, *ACCURATE, "label"]),
    "OpenDroneMap, UTM": ("WGS84 UTM 32N", " ", lambda g: EARTH.ellipsoid_to_utm(g[None])[0][0]),
    "no header": ("", " ", lambda g: g),
    "no header, with accuracies": ("# lat lon", " ", lambda g: [*g, 0.02, 0.02, 0.05]),
}
WITH_ACCURACIES = {"Metashape", "Pix4D", "DJI", "OpenDroneMap, accuracies", "no header, with accuracies"}


@pytest.mark.parametrize("program", HEADERS)
def test_a_table_is_read_by_the_words_of_its_header(ring, tmp_path, program):
    header, separator, cells = HEADERS[program]
    geodetic = on_earth(ring)
    priors = table_priors(write(tmp_path / "t.csv", ring, map(cells, geodetic), header, separator), ring)
    assert_placed(priors, ring)
    assert priors.datum.geodetic[:2] == pytest.approx((47.3, 8.5), abs=1e-4)
    if program in WITH_ACCURACIES:
        np.testing.assert_allclose(priors.known.information, [np.linalg.inv(SIGMAS)] * len(ring.names))
    is_degrees_unsaid = program.startswith("no header") or program.endswith("x and y")
    assert ("are taken for l" in " ".join(priors.notes)) == is_degrees_unsaid


def test_the_southern_and_western_halves_have_signs_of_their_own(ring, tmp_path):
    geodetic = on_earth(ring, -33.8, -70.6)
    for row_of in (
        lambda g: [sexagesimal(-g[0], "S"), sexagesimal(-g[1], "W"), g[2], "", ""],
        lambda g: [-g[0], -g[1], g[2], "South", "W"],
    ):
        header = "FileName,GPSLatitude,GPSLongitude,GPSAltitude,GPSLatitudeRef,GPSLongitudeRef"
        priors = table_priors(write(tmp_path / "t.csv", ring, map(row_of, geodetic), header), ring)
        assert_placed(priors, ring)
        assert priors.datum.geodetic[:2] == pytest.approx((-33.8, -70.6), abs=1e-4)


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        ("name,latitude,y,z", "the header name,latitude,y,z is not known; give name,lat,lon,alt"),
        ("name,foo,bar,baz", "is not known, above all 'foo', 'bar', 'baz'; give name,lat,lon,alt"),
        ("name latitude [deg] longitude [deg] altitude [m]", "line 2: expected a name"),
        ("EPSG:2056", "line 1: the projection 'EPSG:2056' is not one that is converted"),
    ],
)
def test_a_header_without_a_position_is_refused_by_its_words(ring, tmp_path, header, reason):
    with pytest.raises(InputError, match=reason):
        table_priors(write(tmp_path / "t.csv", ring, ring.centers, header), ring)


def test_longitudes_that_are_no_latitudes_come_first_without_a_header(ring, tmp_path):
    """As `exiftool -T -n -filename -gpslongitude -gpslatitude -gpsaltitude` prints them."""
    table = write(tmp_path / "t.txt", ring, on_earth(ring, -33.8, 151.2)[:, LON_LAT], separator="\t")
    priors = table_priors(table, ring)
    assert_placed(priors, ring)
    assert "taken for longitude and latitude" in priors.notes[0]


def test_latitudes_out_of_range_may_be_longitudes(ring, tmp_path):
    swapped = on_earth(ring, -33.8, 151.2)[:, LON_LAT]
    with pytest.raises(InputError, match="out of range; are they swapped"):
        table_priors(write(tmp_path / "t.csv", ring, swapped, "name,lat,lon,alt"), ring)


def test_columns_that_are_not_known_and_rows_without_a_position_are_said(ring, tmp_path):
    rows = [[*g, 7] for g in on_earth(ring).tolist()]
    rows[0][:3], rows[1][2] = ["", "", ""], "-"
    priors = table_priors(write(tmp_path / "t.csv", ring, rows, "image,lat,lon,alt,blur"), ring)
    assert priors.known.indices.tolist() == list(range(1, len(ring.names)))
    told = " | ".join(priors.notes)
    assert "not known are not used: blur" in told
    assert "1 position is missing or not finite, of 8" in told
    assert "1 position is without altitude" in told
    assert priors.known.positions[0, 2] == pytest.approx(0.0, abs=1e-3)  # that of the median


def test_lengths_stay_lengths(ring, tmp_path):
    """Neither small scenes far from the origin nor a header that says meters are taken for degrees."""
    flat = 0.05 * ring.centers * [1.0, 1.0, 0.0]  # spread by .3; as degrees, by 30 km
    away = np.array([47.0, 8.0, 400.0])
    scenes = (10.0 * ring.centers, 0.01 * ring.centers + away, flat + away)
    for positions in scenes:
        priors = table_priors(write(tmp_path / "t.txt", ring, positions, separator=" "), ring)
        np.testing.assert_array_equal(priors.known.positions, positions)
    for header in ("name,x_m,y_m,z_m", "name,easting,northing,height"):
        geodetic = on_earth(ring)
        priors = table_priors(write(tmp_path / "t.csv", ring, geodetic, header), ring)
        np.testing.assert_array_equal(priors.known.positions, geodetic)


@pytest.mark.parametrize(
    ("latitude", "longitude", "wrong"),
    [
        (-16.8, 180.0, None),
        (-16.8, 180.0, 0.0),
        (51.5, 0.0, -120.0),
        (89.9999, 20.0, None),
        (-90.0, 0.0, None),
    ],
)
def test_positions_around_meridians_and_poles_are_near_their_datum(
    ring, tmp_path, latitude, longitude, wrong
):
    geodetic = on_earth(ring, latitude, longitude)
    assert longitude % 180.0 or len(set(np.sign(geodetic[:, 1]))) > 1
    if wrong is not None:
        geodetic[0] = [10.0, wrong, 0.0]
    table = write(tmp_path / "t.csv", ring, geodetic, "name,lat,lon,alt")
    found = table_priors(table, ring).known.positions[1:]
    assert np.linalg.norm(found, axis=1).max() < 100.0  # meters; the ring is some 25 wide
    apart = [np.linalg.norm(x[:, None] - x, axis=2) for x in (found, 10.0 * ring.centers[1:])]
    np.testing.assert_allclose(*apart, atol=1e-3)
    assert evaluate_against_table(MODEL, table).facts.aligned_position_error.median < 1e-3


def test_names_of_another_system_are_those_of_the_images(ring, tmp_path):
    table = tmp_path / "t.csv"
    names = [f"D:/data\\{name}" for name in ring.names[:4]] + [f"./images/{name}" for name in ring.names[4:]]
    for chosen in (names[:4], names[4:]):
        table.write_text("".join(f"{name},{k},{k * k},0\n" for k, name in enumerate(chosen)))
        assert len(table_priors(table, ring)) == 4


ENU = {"coordinate_system": "CARTESIAN", "cartesian_frame": "ENU", "enu_origin": [47.0, 8.0, 500.0]}


def test_colmaps_pose_prior_json_is_read(ring, tmp_path):
    path = tmp_path / "priors.json"
    head = {"coordinate_system": "WGS84", "sensor_type": "CAMERA", "translation_convention": "WORLD_FROM_CAM"}
    rows = [
        [7, *g.tolist(), name, 0.02, 0.02, 0.05] for g, name in zip(on_earth(ring), ring.names, strict=True)
    ]
    schema = ["WEIGHT", "LAT", "LON", "ALT", "NAME", "STD_TX", "STD_TY", "STD_TZ"]
    path.write_text(json.dumps({**head, "schema": schema, "data": rows}))
    priors = table_priors(path, ring)
    assert_placed(priors, ring)
    np.testing.assert_allclose(priors.known.information, [np.linalg.inv(SIGMAS)] * len(ring.names))

    covariance = [[4.0, 1.0, 0.0], [1.0, 9.0, 2.0], [0.0, 2.0, 16.0]]
    upper = [covariance[i][j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]
    schema = ["NAME", "TX", "TY", "TZ", *(f"COV_T{axes}" for axes in ("XX", "XY", "XZ", "YY", "YZ", "ZZ"))]
    rows = [[name, *c, *upper] for name, c in zip(ring.names, ring.centers.tolist(), strict=True)]
    rows[0][1] = None
    path.write_text(json.dumps({**ENU, "schema": schema, "data": rows}))
    found = locate(MODEL, priors=path)
    assert found.gauge.datum.geodetic == (47.0, 8.0, 500.0)
    assert any("1 position is missing" in warning for warning in found.warnings)
    priors = table_priors(path, ring)
    np.testing.assert_allclose(priors.known.information, [np.linalg.inv(covariance)] * (len(ring.names) - 1))


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"translation_convention": "CAM_FROM_WORLD"}, "only WORLD_FROM_CAM is read"),
        ({"sensor_type": "IMU"}, "only CAMERA is read"),
        ({"coordinate_system": "UTM"}, "give WGS84 or CARTESIAN"),
        ({"schema": ["NAME", "TX", "TY"]}, "the header NAME,TX,TY is not known"),
        ({"data": {}}, "data is no list"),
        ({"data": [["a.jpg", "one", 2, 3]]}, "line 1: expected .* 'one' is not a number"),
    ],
)
def test_pose_prior_json_that_says_something_else_is_refused(ring, tmp_path, changed, reason):
    path = tmp_path / "priors.json"
    path.write_text(
        json.dumps({**ENU, "schema": ["NAME", "TX", "TY", "TZ"], "data": [["a.jpg", 1, 2, 3]], **changed})
    )
    with pytest.raises(InputError, match=reason):
        table_priors(path, ring)


def database(path, ring, positions, system, more=()):
    """Write a database of the ring's images and their pose priors; `more` are rows as of the table."""
    connection = sqlite3.connect(path)
    connection.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT)")
    connection.execute(
        "CREATE TABLE pose_priors (pose_prior_id INTEGER PRIMARY KEY, corr_data_id INTEGER, corr_sensor_id "
        "INTEGER, corr_sensor_type INTEGER, position BLOB, position_covariance BLOB, gravity BLOB, "
        "coordinate_system INTEGER)"
    )
    connection.executemany("INSERT INTO images VALUES (?, ?)", enumerate(ring.names, start=1))
    rows = [(k, 0, position, system) for k, position in enumerate(positions, start=1)]
    connection.executemany(
        "INSERT INTO pose_priors VALUES (NULL, ?, 1, ?, ?, ?, NULL, ?)",
        [
            (k, sensor, np.asarray(p, "<f8").tobytes(), SIGMAS.tobytes(), s)
            for k, sensor, p, s in [*rows, *more]
        ],
    )
    connection.commit()
    connection.close()
    return path


def read_database(path, ring):
    return read_from(path, database_priors, ring)


def test_priors_of_no_system_are_taken_as_colmap_does_and_said(ring, tmp_path):
    priors = read_database(database(tmp_path / "a.db", ring, ring.centers, -1), ring)
    np.testing.assert_array_equal(priors.known.positions, ring.centers)
    assert "8 pose priors with" in priors.notes[0]
    assert "UNDEFINED taken for Cartesian" in priors.notes[0]
    priors = read_database(database(tmp_path / "b.db", ring, on_earth(ring), -1), ring)
    assert_placed(priors, ring)
    assert "UNDEFINED taken for WGS84" in priors.notes[0]


def test_pose_priors_that_are_not_used_are_counted_with_their_reason(ring, tmp_path):
    geodetic = on_earth(ring)
    geodetic[:3, 2], geodetic[3, 0] = np.nan, np.inf
    more = [(1, 1, [0, 0, 0], 0), (77, 0, [0, 0, 0], 0)]  # of an IMU, and of no image
    priors = read_database(database(tmp_path / "a.db", ring, geodetic, 0, more), ring)
    told = " | ".join(priors.notes)
    assert priors.known.indices.tolist() == [0, 1, 2, 4, 5, 6, 7]
    for reason in (
        "1 pose prior is of sensors that are no cameras",
        "1 pose prior is of images that are not there",
        "1 position is missing or not finite, of 8",
        "3 positions are without altitude",
    ):
        assert reason in told
    np.testing.assert_allclose(
        priors.known.positions[:3, 2], np.median(priors.known.positions[3:, 2]), atol=1e-3
    )

    with pytest.raises(
        MissingPriorsError, match=r"no position prior of the model's images.*8 positions are missing"
    ):
        read_database(database(tmp_path / "b.db", ring, np.full((8, 3), np.nan), 0), ring)


def test_priors_that_images_of_old_databases_have_themselves_are_read(ring, tmp_path):
    path = tmp_path / "old.db"
    connection = sqlite3.connect(path)
    connection.execute(
        "CREATE TABLE images (image_id INTEGER, name TEXT, prior_tx REAL, prior_ty REAL, prior_tz REAL)"
    )
    rows = [
        (k, name, *g) for k, (name, g) in enumerate(zip(ring.names, on_earth(ring).tolist(), strict=True))
    ]
    rows[0], rows[1] = (0, ring.names[0], 0.0, 0.0, 0.0), (1, ring.names[1], None, None, None)
    connection.executemany("INSERT INTO images VALUES (?, ?, ?, ?, ?)", rows)
    connection.commit()
    connection.close()
    priors = read_database(path, ring)
    assert_placed(priors, ring)
    assert priors.known.indices.tolist() == list(range(2, 8))


def test_images_without_any_altitude_lie_at_zero_and_that_is_said(ring, tmp_path):
    table = write(tmp_path / "t.csv", ring, on_earth(ring)[:, :2], "name,lat,lon")
    priors = table_priors(table, ring)
    assert priors.datum.altitude_m == 0.0
    assert "8 positions are without altitude, taken for 0 m" in priors.notes[0]
    with pytest.raises(InputError, match="no position prior"):
        exif_priors(tmp_path, ring)
