"""`convert --crs` and `--offset`: coordinates on Earth, and what poses, models, covariances become there."""

import json

import numpy as np
import pycolmap
import pytest

import sfm_shapefit
from sfm_shapefit.files.colmap.earth import epsg_code, to_epsg
from sfm_shapefit.scene.given import EarthDatum
from tests.pipeline.made import DATABASE, FOLDER
from tests.program import run, run_refused

RING = pycolmap.Reconstruction(FOLDER)
NAMES = sorted(image.name for image in RING.images.values())
LATITUDE, LONGITUDE, ALTITUDE = 47.3, 8.5, 400.0
EAST_M, NORTH_M = 75785.0, 111175.0  # meters per degree there, roughly
SCALE = 10.0  # meters in a unit of the ring


@pytest.fixture(scope="module")
def placed(tmp_path_factory):
    """An output of `locate` that knows where on Earth it is, and its positions by name."""
    folder = tmp_path_factory.mktemp("world")
    rows = ["name,lat,lon,alt"]
    for name in NAMES:
        x, y, z = (SCALE * RING.find_image_with_name(name).projection_center()).tolist()
        rows.append(f"{name},{LATITUDE + y / NORTH_M!r},{LONGITUDE + x / EAST_M!r},{ALTITUDE + z!r}")
    (folder / "priors.csv").write_text("\n".join(rows))
    flags = ("--database", DATABASE, "--priors", folder / "priors.csv", "--no-report", "-q")
    run("locate", FOLDER, folder / "out", *flags, code=0)
    model = pycolmap.Reconstruction(folder / "out")
    return folder / "out", {name: model.find_image_with_name(name).projection_center() for name in NAMES}


def converted(placed, target, *flags):
    """Run `convert`, and return what it says in one line."""
    return " ".join(run("convert", placed[0], target, *flags, code=0).output.split())


def table_of(file):
    """Return name to numbers of a CSV."""
    rows = [line.split(",") for line in file.read_text().splitlines()[1:]]
    return {name: np.array(cells, dtype=float) for name, *cells in rows}


def vertices_of(file):
    """Return the vertices (n, 3) of a PLY of doubles."""
    header, _, content = file.read_bytes().partition(b"end_header\n")
    count = int(next(line for line in header.decode().splitlines() if "element vertex" in line).split()[-1])
    assert header.count(b"property double") == 3
    return np.frombuffer(content, [("xyz", "<f8", 3), ("rgb", "u1", 3)], count)["xyz"]


# By pyproj 3.7.2: latitude, longitude, EPSG code, easting and northing, or x, y, z; the height is 400.
@pytest.mark.parametrize(
    ("latitude", "longitude", "code", "expected"),
    [
        (47.3, 8.5, 32632, (462200.5453242915, 5238624.111181368, 400.0)),
        (47.3, 5.9995, 32632, (273173.4579078491, 5242869.699562319, 400.0)),  # in zone 31
        (-16.8, 179.9999, 32701, (180200.31473107077, 8140148.204222623, 400.0)),  # in zone 60
        (-16.8, -179.9999, 32760, (819799.6852689292, 8140148.204222623, 400.0)),
        (0.00005, -78.45, 32717, (783845.5087786128, 10000005.532017179, 400.0)),  # north of the equator
        (-0.00005, -78.45, 32617, (783845.5087786128, -5.532017178409808, 400.0)),
        (47.3, 8.5, 4978, (4285907.494674004, 640533.1667687616, 4664740.8896517595)),
    ],
)
def test_coordinates_are_those_of_proj(latitude, longitude, code, expected):
    datum = EarthDatum(latitude_deg=latitude, longitude_deg=longitude, altitude_m=400.0)
    far = np.array([[0.0, 0.0, 0.0], [30.0, -20.0, 5.0], [-2000.0, 100.0, 0.0], [-3000.0, 100.0, 0.0]])
    np.testing.assert_allclose(to_epsg(far[:1], datum, code)[0], expected, rtol=0.0, atol=1e-6)
    every, alone = to_epsg(far, datum, code), [to_epsg(one[None], datum, code)[0] for one in far]
    np.testing.assert_allclose(every, alone, rtol=0.0, atol=1e-6)  # whatever else is converted beside


@pytest.mark.parametrize(
    ("latitude", "longitude", "code"),
    [
        (47.3, 8.5, 32632),
        (-33.9, 151.2, 32756),
        (10.0, 180.0, 32601),
        (10.0, 188.5, 32602),
        (60.39, 5.32, 32632),
        (78.2, 15.6, 32633),
        (78.2, 8.9, 32631),
    ],
)
def test_utm_is_the_zone_of_the_datum(latitude, longitude, code):
    assert (
        epsg_code("UTM", EarthDatum(latitude_deg=latitude, longitude_deg=longitude, altitude_m=0.0)) == code
    )


def test_tables_and_points_are_where_their_latitudes_are(tmp_path, placed):
    assert "EPSG:32632" in converted(placed, tmp_path / "poses.csv", "--crs", "utm")
    found = table_of(tmp_path / "poses.csv")
    there, datum = np.array([found[name][:3] for name in NAMES]), json_of(placed)["datum"]
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    back = transform.ellipsoid_to_enu(transform.utm_to_ellipsoid(there, 32, True), *datum.values())
    inverse_m = 5e-4  # the error of pycolmap's way back from UTM; its way there is right to 1e-7
    np.testing.assert_allclose(back, [placed[1][name] for name in NAMES], atol=inverse_m)
    converted(placed, tmp_path / "scene.ply", "--crs", "EPSG:32632")
    cloud = transform.ellipsoid_to_enu(
        transform.utm_to_ellipsoid(vertices_of(tmp_path / "scene.ply"), 32, True), *datum.values()
    )
    points = pycolmap.Reconstruction(placed[0]).points3D
    np.testing.assert_allclose(cloud, [points[i].xyz for i in sorted(points)], atol=inverse_m)
    apexes = vertices_of(tmp_path / "scene_cameras.ply")[::5]
    np.testing.assert_allclose(apexes, there, atol=1e-6)
    # A camera turns with the grid: to it, the others lie in the same directions, up to the grid's own bend.
    model = pycolmap.Reconstruction(placed[0])
    for name in NAMES:
        w, x, y, z = found[name][3:]
        turn = pycolmap.Rotation3d(np.array([x, y, z, w])).matrix()
        pose = model.find_image_with_name(name).cam_from_world()
        ours = (there - found[name][:3]) @ turn.T
        theirs = (
            np.array([placed[1][other] for other in NAMES]) - placed[1][name]
        ) @ pose.rotation.matrix().T
        np.testing.assert_allclose(ours, theirs, atol=1e-3 * np.abs(theirs).max())


def json_of(placed):
    return json.loads((placed[0] / "locate.json").read_text())


def test_a_model_goes_as_one_and_says_by_how_much_it_bends(tmp_path, placed):
    told = converted(placed, tmp_path / "model", "--crs", "utm")
    assert "EPSG:32632; as one model, up to 0.0" in told
    before, after = pycolmap.Reconstruction(placed[0]), pycolmap.Reconstruction(tmp_path / "model")
    error_px = [one.compute_mean_reprojection_error() for one in (before, after)]
    after.update_point_3d_errors()
    assert after.compute_mean_reprojection_error() == pytest.approx(error_px[0], abs=1e-5)
    converted(placed, tmp_path / "poses.csv", "--crs", "utm")
    exact = table_of(tmp_path / "poses.csv")
    off = [np.linalg.norm(after.find_image_with_name(n).projection_center() - exact[n][:3]) for n in NAMES]
    assert f"up to {max(off):.2g} m" in told
    assert max(off) < 0.05
    assert "as one" not in converted(placed, tmp_path / "ecef", "--crs", "EPSG:4978")  # which is not curved


@pytest.mark.parametrize("offset", ["auto", "462000,5238000,0"])
def test_an_offset_is_subtracted_and_stated(tmp_path, placed, offset):
    for name in ("poses.csv", "scene.ply"):
        converted(placed, tmp_path / f"full_{name}", "--crs", "utm")
        told = converted(placed, tmp_path / name, "--crs", "utm", "--offset", offset)
        assert "_offset.xyz" in told
    stated = np.array((tmp_path / "scene_offset.xyz").read_text().split(), dtype=float)
    assert (stated % 100.0 == 0.0).all()
    assert (tmp_path / "poses_offset.xyz").read_text() == (tmp_path / "scene_offset.xyz").read_text()
    full, short = table_of(tmp_path / "full_poses.csv"), table_of(tmp_path / "poses.csv")
    assert max(np.abs(row[:3]).max() for row in short.values()) < 1000.0
    for name, row in full.items():
        np.testing.assert_allclose(short[name][:3] + stated, row[:3], rtol=0.0, atol=1e-8)
    clouds = [vertices_of(tmp_path / name) for name in ("full_scene.ply", "scene.ply")]
    np.testing.assert_allclose(clouds[1] + stated, clouds[0], rtol=0.0, atol=1e-8)
    assert b"comment EPSG:32632, offset 462" in (tmp_path / "scene.ply").read_bytes()


def test_an_offset_serves_models_without_a_datum(tmp_path):
    run("convert", FOLDER, tmp_path / "out", "--offset", "1,2,3", code=0)
    moved = pycolmap.Reconstruction(tmp_path / "out")
    for name in NAMES:
        centers = [one.find_image_with_name(name).projection_center() for one in (RING, moved)]
        np.testing.assert_allclose(centers[0] - [1.0, 2.0, 3.0], centers[1], atol=1e-12)
    assert (tmp_path / "out" / "offset.xyz").read_text() == "1.0 2.0 3.0\n"


@pytest.mark.parametrize("crs", ["", "utm", "EPSG:4978"])
def test_covariances_go_along(tmp_path, placed, crs):
    rows = [line.split(",") for line in (placed[0] / "cameras.csv").read_text().splitlines()]
    known = {row[0]: dict(zip(rows[0], row, strict=False)) for row in rows[1:]}
    own = {name: row.reshape(3, 3) for name, row in table_of(placed[0] / "covariances.csv").items()}
    assert sorted(own) == NAMES
    for name, covariance in own.items():
        sigmas = np.sqrt(np.diagonal(covariance))
        np.testing.assert_allclose(sigmas, [float(known[name][f"sigma_{axis}"]) for axis in "xyz"])
        rho = float(known[name]["rho_xz"])
        assert covariance[0, 2] / (sigmas[0] * sigmas[2]) == pytest.approx(rho)
        np.testing.assert_array_equal(covariance, covariance.T)
    flags = ("--crs", crs) if crs else ()
    converted(placed, tmp_path / "there.csv", "--format", "covariances", *flags)
    found = {name: row.reshape(3, 3) for name, row in table_of(tmp_path / "there.csv").items()}
    # A shift of a camera along one of its axes here is one along the same axis there.
    converted(placed, tmp_path / "poses.csv", *flags)
    model = pycolmap.Reconstruction(placed[0])
    for name, row in table_of(tmp_path / "poses.csv").items():
        w, x, y, z = row[3:]
        turn = pycolmap.Rotation3d(np.array([x, y, z, w])).matrix()
        before = model.find_image_with_name(name).cam_from_world().rotation.matrix()
        here, there = before @ own[name] @ before.T, turn @ found[name] @ turn.T
        np.testing.assert_allclose(there, here, atol=2e-3 * np.trace(here))
        assert crs or (found[name] == own[name]).all()


def test_what_cannot_be_converted_is_refused_in_a_sentence(tmp_path, placed):
    out = tmp_path / "out.csv"
    assert "has no datum" in run_refused("convert", FOLDER, out, "--crs", "utm")
    assert "EPSG:326" in run_refused("convert", placed[0], out, "--crs", "EPSG:2056")
    for other in ("EPSG:32600", "EPSG:32661", "32632", "utm32", "EPSG:0032632"):
        run_refused("convert", placed[0], out, "--crs", other)
    assert "EPSG:32632" in run_refused("convert", placed[0], out, "--crs", "EPSG:32610")
    for offset in ("1,2", "a,b,c", "nan,0,0", "1e300,0,0"):
        assert "three numbers" in run_refused("convert", placed[0], out, "--offset", offset)
    assert "covariances.csv" in run_refused("convert", FOLDER, out, "--format", "covariances")
    assert not [*tmp_path.iterdir()]


def test_a_result_in_memory_knows_its_datum(tmp_path, placed):
    found = sfm_shapefit.locate(FOLDER, DATABASE, priors=str(placed[0].parent / "priors.csv"))
    assert sfm_shapefit.convert(found, tmp_path / "poses.csv", crs="utm") == tmp_path / "poses.csv"
    converted(placed, tmp_path / "other.csv", "--crs", "utm")
    assert (tmp_path / "poses.csv").read_text() == (tmp_path / "other.csv").read_text()
