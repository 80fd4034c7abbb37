"""Meshes of `convert`: what other viewers read of them."""

import json
import struct

import numpy as np
import pytest
import trimesh

from sfm_shapefit import convert
from sfm_shapefit.facts.tables import read_trust
from sfm_shapefit.files.colmap.model import read_model
from sfm_shapefit.report.mesh import mesh_bytes, trust_colors
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
    (tmp_path / "scene.glb").write_bytes(mesh_bytes(drawing, "glb"))
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
    for kind in ("glb", "ply"):
        (tmp_path / f"scene.{kind}").write_bytes(mesh_bytes(drawing, kind))
    assert len(trimesh.load(tmp_path / "scene.ply", process=False).vertices) == 3
    assert list(trimesh.load(tmp_path / "scene.glb").geometry) == ["points"]


@pytest.mark.parametrize("is_output", [True, False])
def test_convert_writes_a_model_in_its_own_axes_and_an_output_with_its_trust(tmp_path, is_output):
    source = FACADE / "sparse" / "0"
    if is_output:
        run("locate", source, tmp_path / "out", "--no-report", "-q", code=0)
        source = tmp_path / "out"
    assert convert(source, tmp_path / "scene.ply") == "ply"
    model = read_model(source).images
    mesh = trimesh.load(tmp_path / "scene.ply", process=False)
    assert len(mesh.faces) == 6 * model.num_images
    apexes, colors = mesh.vertices[: 5 * model.num_images : 5], mesh.visual.vertex_colors
    order = np.lexsort(model.centers.round(4).T), np.lexsort(np.asarray(apexes).round(4).T)
    np.testing.assert_allclose(apexes[order[1]], model.centers[order[0]], atol=1e-4)
    trust = [np.nan] * model.num_images
    if is_output:
        trusts = read_trust(source / "cameras.csv")
        trust = [trusts[name] for name in model.names]
    expected = trust_colors(np.array(trust))
    np.testing.assert_array_equal(colors[: 5 * model.num_images : 5, :3], expected)


def test_a_bare_graph_has_no_mesh(tmp_path):
    run("place", BUNDLED / "graph40.txt", tmp_path / "out", "--no-report", "-q", code=0)
    assert "its report.html has the scene" in run_refused("convert", tmp_path / "out", tmp_path / "scene.glb")
