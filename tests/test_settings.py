"""Options: stated once, refused by name, set by keyword; and the public names that take them."""

import dataclasses
import inspect

import numpy as np
import pytest

import sfm_shapefit
from sfm_shapefit.colmap.structure_options import StructureOptions
from sfm_shapefit.directions.options import DirectionOptions
from sfm_shapefit.options import LocateOptions, MapOptions
from sfm_shapefit.refinement.options import PlacementOptions
from sfm_shapefit.settings import groups_of, merge_options
from sfm_shapefit.solver.options import SolverOptions
from sfm_shapefit.synthetic import random_graph_problem
from tests.scenes import RING

ALL = (SolverOptions, PlacementOptions, DirectionOptions, StructureOptions, LocateOptions, MapOptions)


@pytest.mark.parametrize("settings", ALL)
def test_every_option_has_a_sentence_that_help_shows(settings):
    shown = " ".join(settings.__doc__.split())
    for item in dataclasses.fields(settings):
        assert item.metadata["help"].endswith(".")
        assert f"{item.name} = {item.default!r} {item.metadata['help']}" in shown


def test_each_option_belongs_to_one_group_and_is_stated_by_one_class():
    names = [item.name for group in groups_of(MapOptions) for item in group.fields]
    assert sorted(names) == sorted(item.name for item in dataclasses.fields(MapOptions))
    again = {"refine_rotations"}  # on by default for rotations that were averaged
    own = [name for one in ALL for name in inspect.get_annotations(one)]
    assert {name for name in own if own.count(name) > 1} == again


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"scale": "metric"}, "scale must be one of auto, input"),
        ({"min_inliers": "many"}, "min_inliers must be of type int, got 'many'"),
        ({"min_inliers": True}, "min_inliers must be of type int"),
        ({"refine": 1}, "refine must be of type bool"),
        ({"max_iterations": 1.5}, "max_iterations must be of type int"),
        ({"threads": 257}, r"threads must lie in \[0, 256\]"),
        ({"min_trust": float("nan")}, "min_trust must lie in"),
        ({"factor_memory_mb": -1}, "factor_memory_mb must be at least 0"),
        ({"max_rotation_error_deg": 5.0}, "belongs to directions=relative-poses"),
    ],
)
def test_a_wrong_value_is_refused_by_name(wrong, message):
    with pytest.raises(ValueError, match=message):
        LocateOptions(**wrong)


def test_integers_serve_as_floats_and_numpy_numbers_as_their_kind():
    assert LocateOptions(tol=np.float64(1e-6), min_inliers=np.int64(20), min_trust=1).min_inliers == 20
    assert LocateOptions(directions="relative-poses", max_rotation_error_deg=5.0).max_rotation_error_deg == 5


def test_options_by_name_win_over_those_given_and_a_near_name_is_suggested():
    given = LocateOptions(min_trust=0.2, points="never")
    merged = merge_options(given, LocateOptions, {"min_trust": 0.0})
    assert (merged.min_trust, merged.points) == (0.0, "never")
    assert merge_options(None, LocateOptions, {}) == LocateOptions()
    with pytest.raises(TypeError, match="'min_trus' is no option of LocateOptions; did you mean min_trust"):
        merge_options(given, LocateOptions, {"min_trus": 0.0})
    with pytest.raises(TypeError, match="known are"):
        merge_options(None, SolverOptions, {"colour": 3})


# --- public names ------------------------------------------------------------------------------------------


def test_completion_shows_public_names_only():
    public = {name for name in dir(sfm_shapefit) if not name.startswith("_")}
    assert public == set(sfm_shapefit.__all__)
    assert all(getattr(sfm_shapefit, name) is not None for name in public)


def test_what_follows_the_first_two_arguments_is_given_by_name():
    more = {"certify": 3}
    functions = [getattr(sfm_shapefit, name) for name in sfm_shapefit.__all__]
    for function in (one for one in functions if inspect.isfunction(one)):
        kinds = [parameter.kind for parameter in inspect.signature(function).parameters.values()]
        by_position = sum(kind is inspect.Parameter.POSITIONAL_OR_KEYWORD for kind in kinds)
        assert by_position <= more.get(function.__name__, 2), function.__name__


@pytest.fixture(scope="module")
def located():
    return sfm_shapefit.locate(RING / "sparse" / "0", min_trust=0.0)


def test_an_option_by_name_reaches_the_run(located):
    assert located.options == LocateOptions(min_trust=0.0)
    with pytest.raises(TypeError, match="did you mean min_trust"):
        sfm_shapefit.locate(RING / "sparse" / "0", mintrust=0.0)


def test_results_say_what_they_are_in_a_line_and_in_a_table_of_escaped_text(located):
    assert repr(located).startswith("<LocateResult: 8 of 8 images placed")
    problem = random_graph_problem(12, p=0.8, seed=1)
    solved = sfm_shapefit.solve(problem.view_graph, tol=1e-6)
    assert solved.converged
    assert repr(solved).startswith("<SolverResult: 12 locations, converged")
    placed = sfm_shapefit.place(problem.view_graph, refine=False)
    assert (placed.refined.is_refined, placed.certified.converged) == (False, True)
    assert repr(placed).startswith("<Placement: 12 of 12 nodes placed, 0 of")
    located.timings_s["<script>"] = 1.0
    table = located._repr_html_()
    del located.timings_s["<script>"]
    assert "&lt;script&gt;" in table
    assert "<script>" not in table
    assert "num images</th><td>8<" in table


def test_rows_are_made_once(located):
    assert located.cameras is located.cameras
    assert located.pairs is located.pairs
    assert located.summary() == located.summary()
    assert located.certified.gap <= 1e-8


def test_errors_of_evaluate_have_a_summary(located):
    errors = sfm_shapefit.evaluate(located.reconstruction, RING / "sparse" / "0")
    assert errors.summary()["num_common"] == 8
    assert "8 cameras in common" in repr(errors)
    assert not errors.degenerate
