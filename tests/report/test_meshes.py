"""Meshes of `convert`: what other viewers read of them."""

import json
import struct

import numpy as np
import pycolmap
import pytest
import trimesh

from sfm_shapefit import convert
from sfm_shapefit.facts.tables import read_trust
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.report.mesh import camera_mesh, glb_bytes, ply_bytes, trust_colors
from tests.drawings import make_drawing
from tests.program import run, run_refused
from tests.scenes import BUNDLED, FACADE


def glb_tree(path):
    """Return the JSON of a binary glTF, after checking its header by the specification."""
    raw = path.read_bytes()
    magic, version, length, json_length, kind = struct.unpack("<4sIII4s", raw[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(raw), b"JSON")
    return json.loads(raw[20 : 20 + json_length])


def test_the_glb_holds_cameras_and_points_upright_around_the_origin(tmp_path):
    drawing, _ = make_drawing()
    (tmp_path / "scene.glb").write_bytes(glb_bytes(drawing))
    modes = {
        mesh["name"]: mesh["primitives"][0]["mode"] for mesh in glb_tree(tmp_path / "scene.glb")["meshes"]
    }
    points, triangles = 0, 4  # of the specification
    assert modes == {"cameras": triangles, "points": points}
    loaded = trimesh.load(tmp_path / "scene.glb").geometry
    assert len(loaded["cameras"].faces) == 6 * 24
    assert len(loaded["points"].vertices) == len(drawing.points.xyz)
    apexes = np.asarray(loaded["cameras"].vertices)[: 5 * 24 : 5]
    placed = drawing.cameras.centers[drawing.cameras.placed]
    height = (placed - np.median(placed, axis=0)) @ drawing.axes[2]
    np.testing.assert_allclose(apexes[:, 1], height, atol=1e-5)  # float32 of 10
    np.testing.assert_allclose(np.median(apexes, axis=0), 0.0, atol=1e-5)


def test_trust_is_red_at_0_green_at_1_and_gray_where_unknown():
    low, high, unknown = trust_colors(np.array([0.0, 1.0, np.nan])).astype(int)
    assert low[0] > 3 * low[1]
    assert high[1] > 3 * high[0]
    assert len(set(unknown.tolist())) == 1


def test_nothing_placed_gives_empty_scenes_that_still_open(tmp_path):
    drawing, _ = make_drawing(num_cameras=1, num_pairs=0, num_points=3)  # the last camera is never placed
    (tmp_path / "scene.glb").write_bytes(glb_bytes(drawing))
    assert list(trimesh.load(tmp_path / "scene.glb").geometry) == ["points"]
    vertices, faces, colors = camera_mesh(drawing)
    (tmp_path / "scene.ply").write_bytes(ply_bytes(vertices, colors, faces))
    assert trimesh.load(tmp_path / "scene.ply", process=False).is_empty


@pytest.mark.parametrize("is_output", [True, False])
def test_convert_writes_all_points_in_their_colors_and_cameras_with_their_trust(tmp_path, is_output):
    source = FACADE / "sparse" / "0"
    if is_output:
        run("locate", source, tmp_path / "out", "--no-report", "-q", code=0)
        source = tmp_path / "out"
    told = run("convert", source, tmp_path / "scene.ply", code=0).output
    assert "scene_cameras.ply" in told
    model = read_model(source)
    images, points = model.images, model.reconstruction.points3D
    cloud = trimesh.load(tmp_path / "scene.ply", process=False)
    expected = np.array([points[i].xyz for i in sorted(points)])
    np.testing.assert_array_equal(np.asarray(cloud.vertices), expected.astype(np.float32))
    np.testing.assert_array_equal(cloud.colors[:, :3], [points[i].color for i in sorted(points)])
    mesh = trimesh.load(tmp_path / "scene_cameras.ply", process=False)
    assert len(mesh.faces) == 6 * images.num_images
    apexes, colors = mesh.vertices[: 5 * images.num_images : 5], mesh.visual.vertex_colors
    order = np.lexsort(images.centers.round(4).T), np.lexsort(np.asarray(apexes).round(4).T)
    np.testing.assert_allclose(apexes[order[1]], images.centers[order[0]], atol=1e-4)
    trust = [np.nan] * images.num_images
    if is_output:
        trusts = read_trust(source / "cameras.csv")
        trust = [trusts[name] for name in images.names]
    expected = trust_colors(np.array(trust))
    np.testing.assert_array_equal(colors[: 5 * images.num_images : 5, :3], expected)


def test_a_ply_is_what_colmap_writes_where_that_holds_the_points(tmp_path):
    model = read_model(FACADE / "sparse" / "0").reconstruction
    model.export_PLY(tmp_path / "theirs.ply")
    convert(model, tmp_path / "ours.ply")
    ours, theirs = ((tmp_path / name).read_bytes() for name in ("ours.ply", "theirs.ply"))
    header = ours.index(b"end_header")
    assert ours[:header] == theirs[:header]
    rows = [trimesh.load(tmp_path / name, process=False).vertices for name in ("ours.ply", "theirs.ply")]
    np.testing.assert_array_equal(*(np.sort(np.asarray(one), axis=0) for one in rows))


@pytest.mark.parametrize("away", [(2.0e6, 4.1e6, 4.4e6), (691000.0, 5334000.0, 520.0), (0.0, 0.0, 300.0)])
@pytest.mark.parametrize("size", [1.0, 0.001])
def test_nothing_that_leaves_loses_a_thousandth_of_the_scene_far_from_the_origin(tmp_path, away, size):
    model = pycolmap.Reconstruction(FACADE / "sparse" / "0")
    model.transform(pycolmap.Sim3d(size, pycolmap.Rotation3d(), np.array(away)))
    images = read_model(model).images
    extent = np.ptp(images.centers, axis=0).max()
    points = np.array([model.points3D[i].xyz for i in sorted(model.points3D)])
    for name in ("scene.ply", "scene.glb", "poses.csv", "poses.tum", "poses.json"):
        convert(model, tmp_path / name)
    close = {"rtol": 0.0, "atol": 2e-5 * extent}  # a float64 at 6e6 holds 1e-9
    cloud = trimesh.load(tmp_path / "scene.ply", process=False)
    np.testing.assert_allclose(cloud.vertices, points, **close)
    mesh = trimesh.load(tmp_path / "scene_cameras.ply", process=False)
    np.testing.assert_allclose(mesh.vertices[::5], images.centers, **close)
    scene = glb_tree(tmp_path / "scene.glb")["scenes"][0]["extras"]
    apexes = trimesh.load(tmp_path / "scene.glb").geometry["cameras"].vertices[::5]
    found = np.asarray(apexes) @ np.array(scene["axes"]) + scene["offset"]
    np.testing.assert_allclose(found, images.centers, **close)
    rows = [line.split(",")[1:4] for line in (tmp_path / "poses.csv").read_text().splitlines()[1:]]
    np.testing.assert_array_equal(np.array(rows, dtype=float), images.centers)
    rows = [line.split()[1:4] for line in (tmp_path / "poses.tum").read_text().splitlines()[1:]]
    np.testing.assert_array_equal(np.array(rows, dtype=float), images.centers)
    frames = json.loads((tmp_path / "poses.json").read_text())["frames"]
    np.testing.assert_array_equal([np.array(x["transform_matrix"])[:3, 3] for x in frames], images.centers)


def test_cameras_that_exist_already_are_not_replaced_unasked(tmp_path):
    (tmp_path / "scene_cameras.ply").write_text("mine")
    told = run_refused("convert", FACADE / "sparse" / "0", tmp_path / "scene.ply")
    assert "scene_cameras.ply exists already" in told
    assert [path.name for path in tmp_path.iterdir()] == ["scene_cameras.ply"]
    run("convert", FACADE / "sparse" / "0", tmp_path / "scene.ply", "--overwrite", code=0)
    assert (tmp_path / "scene_cameras.ply").read_bytes()[:3] == b"ply"


def test_a_bare_graph_has_no_mesh(tmp_path):
    run("place", BUNDLED / "graph40.txt", tmp_path / "out", "--no-report", "-q", code=0)
    assert "its report.html has the scene" in run_refused("convert", tmp_path / "out", tmp_path / "scene.glb")
