"""The pytest plugin serves a pipeline's own tests: its example runs, and its comparisons can fail."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from sfm_shapefit.synthetic import RenderOptions, WorkspaceOptions, fixtures
from sfm_shapefit.synthetic.fixtures import assert_locations_near, assert_reconstruction_near
from tests.scenes import COURTYARD, FACADE, ROOT

CONFTEST = 'pytest_plugins = ["sfm_shapefit.synthetic.fixtures"]'


@pytest.mark.slow
def test_the_example_passes_in_a_pipelines_own_tests(pytester, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    pytester.makeconftest(CONFTEST)
    pytester.makepyfile((ROOT / "examples/test_my_pipeline.py").read_text(encoding="utf-8"))
    pytester.runpytest_inprocess("-p", "no:cacheprovider").assert_outcomes(passed=3)


def test_the_documented_fixtures_are_those_that_there_are(pytester, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    pytester.makeconftest(CONFTEST)
    listed = pytester.runpytest_inprocess("--fixtures", "-q").stdout.str()
    page = (ROOT / "docs" / "synthetic.md").read_text(encoding="utf-8")
    for row in (line for line in fixtures.__doc__.splitlines() if line.startswith("| `")):
        assert row in page
        for name in row.split("|")[1].replace("`", "").split(","):
            assert f"\n{name.strip()} [" in listed or f"\n{name.strip()} --" in listed, name


def test_projects_are_folders_of_the_tests_own(drawn_workspace, rendered_workspace):
    ring = drawn_workspace("ring", num_images=8)
    assert (ring / "database.db").exists()
    assert pycolmap.Reconstruction(ring / "sparse/0").num_reg_images() == 8
    yard = drawn_workspace(options=WorkspaceOptions(model="rotations"), seed=1)
    assert sorted(path.name for path in yard.iterdir()) == ["database.db", "sparse", "truth"]
    small = {"num_images": 2, "image_width": 64, "image_height": 48, "focal_length_px": 60.0}
    options = WorkspaceOptions(database=False)
    photos = rendered_workspace("ring", options, RenderOptions(gray_noise=0.0), **small)
    assert sorted(path.name for path in photos.iterdir()) == ["images", "sparse"]
    assert len(list((photos / "images").iterdir())) == 2
    model = pycolmap.Reconstruction(photos / "sparse/0")
    assert (model.num_reg_images(), model.num_points3D()) == (2, 0)
    assert len({ring, yard, photos}) == 3


def test_graphs_have_the_corruption_asked_for(random_graph):
    problem = random_graph(20, p=0.8, q=0.3, seed=5)
    np.testing.assert_array_equal(problem.view_graph.edges, problem.edges)
    assert 0.1 < problem.corrupted.mean() < 0.5


def moved(model: pycolmap.Reconstruction, meters: float) -> pycolmap.Reconstruction:
    """The model with its first camera moved."""
    image = model.images[min(model.images)]
    pose = image.cam_from_world()
    image.frame.rig_from_world = pycolmap.Rigid3d(
        pose.rotation, pose.translation + np.array([meters, 0.0, 0.0])
    )
    return model


def test_a_reconstruction_is_near_itself_and_not_near_one_with_a_camera_moved():
    truth = FACADE / "sparse/0"
    assert_reconstruction_near(truth, truth, max_error=1e-9, max_rotation_error_deg=1e-6)
    far = moved(pycolmap.Reconstruction(truth), 0.5)
    with pytest.raises(AssertionError, match=r"0001\.jpg is 0\.5 off, limit 0\.1"):
        assert_reconstruction_near(far, truth, max_error=0.1)
    assert_reconstruction_near(far, truth, max_median_error=0.1)
    with pytest.raises(ValueError, match="give max_error"):
        assert_reconstruction_near(Path("a"), Path("b"))


def test_cameras_that_are_missing_or_turned_are_named():
    truth = pycolmap.Reconstruction(COURTYARD / "truth")
    few = pycolmap.Reconstruction(COURTYARD / "truth")
    few.deregister_frame(few.images[3].frame_id)
    with pytest.raises(AssertionError, match=r"96% of the cameras are placed, not 100%: \('0003\.jpg',\)"):
        assert_reconstruction_near(few, truth, max_error=1.0)
    assert_reconstruction_near(few, truth, max_error=1e-9, min_placed=0.9)
    turned = pycolmap.Reconstruction(COURTYARD / "truth")
    image = turned.images[5]
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.02, 0.0])), np.zeros(3))
    image.frame.rig_from_world = turn * image.cam_from_world()
    with pytest.raises(AssertionError, match=r"0005\.jpg is turned by 1\.15 deg, limit 0\.5 deg"):
        assert_reconstruction_near(turned, truth, max_rotation_error_deg=0.5)


def test_locations_are_compared_up_to_shift_and_scale_only():
    t = np.random.default_rng(0).standard_normal((8, 3))
    assert_locations_near(3.0 * t + [1.0, 2.0, 3.0], t, max_error=1e-12)
    with pytest.raises(AssertionError, match=r"relative error 2, limit 0\.1"):
        assert_locations_near(-t, t, max_error=0.1)
    wrong = t.copy()
    wrong[4] += 1.0
    with pytest.raises(AssertionError, match="worst location 4"):
        assert_locations_near(wrong, t, max_error=0.1)
    with pytest.raises(AssertionError, match=r"shape \(7, 3\)"):
        assert_locations_near(t[:7], t, max_error=0.1)
