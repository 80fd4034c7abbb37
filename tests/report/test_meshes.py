"""scene.glb and scene.ply: what other viewers read of them."""

import json
import struct

import numpy as np
import pytest
import trimesh

from sfm_shapefit.report.drawing import PairClass
from sfm_shapefit.report.mesh import PAIR_COLORS, trust_colors, write_meshes
from tests.drawings import make_drawing


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")
    write_meshes(make_drawing()[0], folder)
    return folder


def glb_tree(path):
    """Return the JSON of a binary glTF, after checking its header by the specification."""
    raw = path.read_bytes()
    magic, version, length, json_length, kind = struct.unpack("<4sIII4s", raw[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(raw), b"JSON")
    return json.loads(raw[20 : 20 + json_length])


def test_the_glb_holds_cameras_points_and_a_kind_of_line_per_verdict(folder):
    drawing, _ = make_drawing()
    modes = {mesh["name"]: mesh["primitives"][0]["mode"] for mesh in glb_tree(folder / "scene.glb")["meshes"]}
    points, lines, triangles = 0, {1, 3}, 4  # of the specification
    assert modes["cameras"] == triangles
    assert modes["points"] == points
    assert {modes[f"pairs: {kind}"] for kind in ("agrees", "contradicts", "undetermined")} <= lines
    loaded = trimesh.load(folder / "scene.glb").geometry
    assert len(loaded["cameras"].faces) == 6 * 24
    assert len(loaded["points"].vertices) == len(drawing.points.positions)


def test_in_the_glb_y_is_up_and_the_cameras_are_around_the_origin(folder):
    drawing, _ = make_drawing()
    cameras = trimesh.load(folder / "scene.glb").geometry["cameras"]
    apexes = np.asarray(cameras.vertices)[: 5 * 24 : 5]
    placed = drawing.cameras.centers[drawing.cameras.placed]
    height = (placed - np.median(placed, axis=0)) @ drawing.axes[2]
    np.testing.assert_allclose(apexes[:, 1], height, atol=1e-5)  # float32 of 10
    np.testing.assert_allclose(np.median(apexes, axis=0), 0.0, atol=1e-5)


def test_the_ply_is_in_the_axes_of_the_model_colored_by_trust_with_a_ribbon_for_each_drawn_pair(folder):
    drawing, _ = make_drawing()
    mesh = trimesh.load(folder / "scene.ply", process=False)
    placed, num_points = drawing.cameras.placed, len(drawing.points.positions)
    colors, vertices = mesh.visual.vertex_colors[:, :3], np.asarray(mesh.vertices)
    np.testing.assert_allclose(vertices[: 5 * 24 : 5], drawing.cameras.centers[placed], atol=1e-5)
    np.testing.assert_array_equal(colors[: 5 * 24 : 5], trust_colors(drawing.cameras.trust[placed]))
    np.testing.assert_allclose(vertices[-num_points:], drawing.points.positions, atol=1e-5)  # float32 of 10
    ends, classes = drawing.pairs.cameras, drawing.pairs.classes
    drawn = placed[ends].all(axis=1) & (classes != PairClass.NO_DIRECTION)
    assert len(mesh.faces) == 6 * 24 + 2 * int(drawn.sum())
    wrong = drawn & (classes == PairClass.CONTRADICTS)
    reds = (colors[5 * 24 :] == PAIR_COLORS[PairClass.CONTRADICTS]).all(axis=1)
    assert int(reds.sum()) == 4 * int(wrong.sum())
    ribbons = vertices[5 * 24 : -num_points].reshape(-1, 4, 3).mean(axis=1)
    middles = drawing.cameras.centers[ends[wrong]].mean(axis=1)
    found = ribbons[reds[:-num_points:4]]
    np.testing.assert_allclose(np.sort(found, axis=0), np.sort(middles, axis=0), atol=1e-5)


def test_trust_is_red_at_0_green_at_1_and_gray_where_unknown():
    low, high, unknown = trust_colors(np.array([0.0, 1.0, np.nan])).astype(int)
    assert low[0] > 3 * low[1]
    assert high[1] > 3 * high[0]
    assert len(set(unknown.tolist())) == 1


def test_nothing_placed_gives_empty_scenes_that_still_open(tmp_path):
    drawing, _ = make_drawing(num_cameras=1, num_pairs=0, num_points=3)  # the last camera is never placed
    write_meshes(drawing, tmp_path)
    assert len(trimesh.load(tmp_path / "scene.ply", process=False).vertices) == 3
