"""Regression tests of a pipeline, on scenes whose truth is known.

    pytest -p sfm_shapefit.synthetic.fixtures examples/test_my_pipeline.py

Copy it beside your own tests, and call your pipeline where `global_mapping`, `locate` and `place` are called.
`pytest_plugins = ["sfm_shapefit.synthetic.fixtures"]` in the conftest.py at their root makes `-p` needless.
"""

from sfm_shapefit import global_mapping, locate, place
from sfm_shapefit.synthetic import WorkspaceOptions
from sfm_shapefit.synthetic.fixtures import assert_locations_near, assert_reconstruction_near


def test_a_fifth_of_wrong_pairs_does_no_harm(drawn_workspace):
    rotations = WorkspaceOptions(model="rotations")
    workspace = drawn_workspace("courtyard", rotations, num_images=16, corrupted_pair_fraction=0.2)
    found = locate(workspace / "sparse/0", workspace / "database.db")
    assert found.verdict.grade == "good"
    assert_reconstruction_near(found, workspace / "truth", max_median_error=0.05)


def test_photographs_drawn_by_opencv_become_a_model(rendered_workspace, tmp_path):
    small = {"image_width": 400, "image_height": 300, "focal_length_px": 350.0}
    workspace = rendered_workspace("facade", **small)
    models = global_mapping(workspace / "database.db", workspace / "images", tmp_path / "models")
    assert_reconstruction_near(models[0], workspace / "sparse/0", max_median_error=0.05)


def test_half_of_the_directions_random_are_overcome(random_graph):
    problem = random_graph(40, p=0.8, q=0.5)
    assert_locations_near(place(problem.view_graph).locations, problem.locations, max_error=1e-6)
