"""Options: stated once, refused by name, set by keyword; and the public names that take them."""

import csv
import dataclasses
import inspect
from typing import get_args, get_type_hints

import numpy as np
import pytest

import sfm_shapefit
from sfm_shapefit.base.settings import (
    Composed,
    Settings,
    flat_values,
    group,
    homes_of,
    merge_options,
    option,
    setting_groups,
)
from sfm_shapefit.facts.command_options import InspectOptions, LocateOptions, MapOptions, SourceOptions
from sfm_shapefit.facts.placed import UNITS
from sfm_shapefit.facts.tables import CameraRow, Table
from sfm_shapefit.pairs.direction_options import DirectionOptions
from sfm_shapefit.placement.gauge import ScaleKind
from sfm_shapefit.placement.gauge_options import GaugeOptions
from sfm_shapefit.refinement.placement_options import PlacementOptions
from sfm_shapefit.rotations.averaging_options import AveragingOptions
from sfm_shapefit.scene.freedom import FreedomOptions
from sfm_shapefit.solver.solver_options import SolverOptions
from sfm_shapefit.synthetic import RenderOptions, SceneOptions, WorkspaceOptions, random_graph_problem
from sfm_shapefit.tracks.structure_options import NodeOptions, StructureOptions
from tests.scenes import RING

NAN = float("nan")
ROOTLESS = {"fix", "rotations", "join"}
"""Options of the compositions themselves."""
COMPOSED = (PlacementOptions, InspectOptions, LocateOptions, MapOptions)
GROUPS = (
    *(SolverOptions, DirectionOptions, StructureOptions, NodeOptions, FreedomOptions, GaugeOptions),
    *(AveragingOptions, SourceOptions),
)
ALL = (*GROUPS, *COMPOSED)


@pytest.mark.parametrize("settings", ALL)
def test_every_option_has_a_sentence_that_help_shows(settings):
    shown = " ".join(settings.__doc__.split())
    for item in (item for one in setting_groups(settings) for item in one.options):
        assert item.help.endswith(".")
        assert f"{item.name} = {item.default!r} {item.help}" in shown
    assert "LocateOptions" in inspect.getdoc(sfm_shapefit.locate)


@pytest.mark.parametrize("settings", ALL)
def test_every_default_is_what_its_option_takes(settings):
    """Settings trust their defaults, and look at other values only."""
    for item in dataclasses.fields(settings):

        @dataclasses.dataclass(frozen=True, kw_only=True)
        class Other(Settings):
            value: get_type_hints(settings)[item.name] = option(object(), "Another default.")

        Other(value=item.default)


@pytest.mark.parametrize("settings", COMPOSED)
def test_each_option_belongs_to_one_group_and_has_one_name(settings):
    names = [item.name for one in setting_groups(settings) for item in one.options]
    assert len(names) == len(set(names))
    assert set(names) == set(homes_of(settings)) == set(flat_values(settings()))


def test_two_groups_with_an_option_of_one_name_are_a_programming_error():
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Other(Settings):
        tol: float = option(0.1, "Another.")

    @dataclasses.dataclass(frozen=True, kw_only=True, init=False)
    class Both(Composed):
        solver: SolverOptions = group(SolverOptions)
        other: Other = group(Other)

    with pytest.raises(TypeError, match="Both has several options named tol"):
        Both()


def test_groups_and_single_options_go_together_however_deep_they_are():
    flat = LocateOptions(min_inliers=20, directions="tracks", tol=1e-6, min_trust=0.1)
    grouped = LocateOptions(
        directions=DirectionOptions(min_inliers=20),
        source=SourceOptions(directions="tracks"),
        placement={"tol": 1e-6},
        trust={"min_trust": 0.1},
    )
    assert flat == grouped
    assert hash(flat) == hash(grouped)
    assert (flat.directions.min_inliers, flat.placement.solver.tol) == (20, 1e-6)
    assert dataclasses.replace(flat, refine=False, min_trust=0.2).placement.solver.tol == 1e-6
    assert (
        LocateOptions(directions=DirectionOptions(min_inliers=20), min_inliers=30).directions.min_inliers
        == 30
    )
    assert LocateOptions().structure.min_points_per_image == 0
    assert MapOptions(min_track_length=3).structure == StructureOptions(
        min_track_length=3, min_points_per_image=30
    )
    with pytest.raises(TypeError, match=r"'placement' is no option of MapOptions; give PlacementOptions"):
        MapOptions(placement=3)
    with pytest.raises(TypeError, match="'rotations' is no option of MapOptions; it is one of LocateOptions"):
        MapOptions(rotations="held")
    with pytest.raises(TypeError, match="'min_inlier' is no option of DirectionOptions; did you mean"):
        MapOptions(directions={"min_inlier": 3})


OUT_OF_RANGE = {
    DirectionOptions: [(item.name, -1) for item in dataclasses.fields(DirectionOptions)],
    SolverOptions: [("solver", "magic"), ("threads", -1), ("tol", 0.0), ("max_iterations", 0)],
    StructureOptions: [
        *(("max_reprojection_error_px", 0.0), ("max_reprojection_error_px", NAN)),
        *(("min_triangulation_angle_deg", 90.0), ("min_track_length", 1)),
    ],
    LocateOptions: [("min_inlier_ratio", 3.0), ("tol", 2.0), ("threads", -1), ("max_memory_mb", -1)],
    SceneOptions: [
        *(("shape", "torus"), ("num_images", 1), ("pixel_noise_px", NAN), ("focal_length_px", 0.0)),
        *(("wrong_match_fraction", 1.5), ("corrupted_pair_fraction", -0.1)),
    ],
    RenderOptions: [
        *(("repeated_fraction", 1.1), ("radial_k1", 0.6), ("gray_noise", -1.0), ("jpeg_quality", 0))
    ],
}
REFUSED = [
    *(
        (settings, {name: value}, rf"\b{name} must")
        for settings in OUT_OF_RANGE
        for name, value in OUT_OF_RANGE[settings]
    ),
    (PlacementOptions, {"objective": "l2"}, "shapefit"),
    (LocateOptions, {"scale": "metric"}, "scale must be one of auto, input"),
    (LocateOptions, {"min_inliers": "many"}, "min_inliers must be a whole number, got 'many'"),
    (LocateOptions, {"min_inliers": True}, "min_inliers must be a whole number"),
    (LocateOptions, {"refine": 1}, "refine must be true or false"),
    (LocateOptions, {"max_iterations": 1.5}, "max_iterations must be a whole number"),
    (LocateOptions, {"threads": 257}, r"threads must lie in \[0, 256\]"),
    (LocateOptions, {"min_trust": NAN}, "min_trust must lie in"),
    (LocateOptions, {"factor_memory_mb": -1}, "factor_memory_mb must be at least 0"),
    (LocateOptions, {"rotations": "free", "adjust": "none"}, "rotations=free needs an adjustment"),
    (LocateOptions, {"rotations": 0.1, "adjust": "none"}, "rotations=0.1 needs an adjustment"),
    (LocateOptions, {"intrinsics": "focal", "adjust": "none"}, "intrinsics=focal needs an adjustment"),
    (MapOptions, {"rigs": "free", "adjust": "none"}, "rigs=free needs an adjustment"),
    (LocateOptions, {"rotations": -1.0}, "rotations must lie between"),
    (LocateOptions, {"rotations": "exact"}, "rotations must be one of auto, held, free or a number"),
    (LocateOptions, {"known_distance": ("a", "b", -1.0)}, "must be positive"),
    (LocateOptions, {"known_distance": ("a", "b", 1e200)}, r"positive, from 1e-30 to 1e\+30, of two"),
    (LocateOptions, {"known_distance": ("a", "b", 1e-200)}, r"positive, from 1e-30 to 1e\+30, of two"),
    (LocateOptions, {"known_distance": ("a", "a", 1.0)}, "two different images"),
    (LocateOptions, {"known_distance": ("a", "b")}, "two image names and a number"),
    (LocateOptions, {"known_distance": 3.0}, "known_distance must be a list"),
    (MapOptions, {"min_matches": 5}, "min_matches must be at least 15"),
    (WorkspaceOptions, {"model": "rotations", "database": False}, "model = 'rotations' needs database"),
]


@pytest.mark.parametrize(("settings", "wrong", "message"), REFUSED, ids=str)
def test_a_wrong_value_is_refused_by_name(settings, wrong, message):
    with pytest.raises(ValueError, match=message):
        settings(**wrong)


def test_integers_serve_as_floats_and_numpy_numbers_as_their_kind():
    assert (
        LocateOptions(tol=np.float64(1e-6), min_inliers=np.int64(20), min_trust=1).directions.min_inliers
        == 20
    )


def test_options_by_name_win_over_those_given_and_a_near_name_is_suggested():
    given = LocateOptions(min_trust=0.2, points="never")
    merged = merge_options(given, LocateOptions, {"min_trust": 0.0})
    assert (merged.trust.min_trust, merged.nodes.points) == (0.0, "never")
    assert merge_options(None, LocateOptions, {}) == LocateOptions()
    with pytest.raises(TypeError, match=r"options must be LocateOptions\(\.\.\.\), got dict; or give single"):
        merge_options({"min_trust": 0.0}, LocateOptions, {})
    with pytest.raises(TypeError, match="'min_trus' is no option of LocateOptions; did you mean min_trust"):
        merge_options(given, LocateOptions, {"min_trus": 0.0})
    with pytest.raises(TypeError, match="known are"):
        merge_options(None, SolverOptions, {"color": 3})


def test_completion_shows_public_names_only_and_after_two_arguments_all_are_given_by_name():
    public = {name: getattr(sfm_shapefit, name) for name in dir(sfm_shapefit) if not name.startswith("_")}
    assert set(public) == set(sfm_shapefit.__all__)
    assert all(value is not None for value in public.values())
    for name, function in public.items():
        if inspect.isfunction(function):
            kinds = [parameter.kind for parameter in inspect.signature(function).parameters.values()]
            by_position = sum(kind is inspect.Parameter.POSITIONAL_OR_KEYWORD for kind in kinds)
            assert by_position <= {
                "certify": 3,
                "average_rotations": 3,
                "workspace": 3,
                "global_mapping": 4,
            }.get(name, 2), name


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        (MapOptions, "rotations"),
        (MapOptions, "fix"),
        (InspectOptions, "min_trust"),
        (LocateOptions, "gravity"),
    ],
)
def test_a_command_knows_the_options_of_its_own_groups_only(settings, name):
    with pytest.raises(TypeError, match=f"'{name}' is no option of {settings.__name__}"):
        merge_options(None, settings, {name: "free"})


@pytest.fixture(scope="module")
def located():
    return sfm_shapefit.locate(RING / "sparse" / "0", min_trust=0.0)


def test_an_option_by_name_reaches_the_run_rows_are_made_once_and_errors_have_a_summary(located):
    assert located.options == LocateOptions(min_trust=0.0)
    with pytest.raises(TypeError, match="did you mean min_trust"):
        sfm_shapefit.locate(RING / "sparse" / "0", mintrust=0.0)
    assert located.cameras is located.cameras
    assert located.pairs is located.pairs
    assert located.summary() == located.summary()
    errors = sfm_shapefit.evaluate(located.reconstruction, RING / "sparse" / "0")
    assert errors.summary()["num_common"] == 8
    assert "8 cameras in common" in repr(errors)
    assert not errors.degenerate


def test_results_say_what_they_are_in_a_line_and_in_a_table_of_escaped_text(located):
    assert repr(located).startswith("<LocateResult: good: 8 of 8 images placed")
    problem = random_graph_problem(12, p=0.8, seed=1)
    solved = sfm_shapefit.solve(problem.view_graph, tol=1e-6)
    assert solved.converged
    assert repr(solved).startswith("<SolverResult: 12 locations, converged")
    placed = sfm_shapefit.place(problem.view_graph, refine=False)
    assert (placed.refined.finish.refined, placed.certified.converged) == (False, True)
    assert repr(placed).startswith("<PlacedGraph: good: 12 of 12 nodes placed, 0 of")
    located.timings_s["<script>"] = 1.0
    table = located._repr_html_()
    del located.timings_s["<script>"]
    assert "&lt;script&gt;" in table
    assert "<script>" not in table
    assert "8 of 8 images" in table
    assert "good</b>" in table
    assert "<iframe sandbox='allow-scripts'" in table
    assert "method</th><td>newton<" in solved._repr_html_()


def test_every_scale_has_its_unit():
    assert set(UNITS) == {*get_args(ScaleKind)}


def test_tables_are_columns_by_their_names_in_the_csv_with_nan_where_nothing_is_known(located, tmp_path):
    sfm_shapefit.write_result(located, tmp_path / "out", report=False)
    for name, rows in (("cameras", located.cameras), ("pairs", located.pairs)):
        columns = located.table(name)
        with (tmp_path / f"out/{name}.csv").open(newline="", encoding="utf-8") as stream:
            written = list(csv.DictReader(stream))
        assert list(columns) == list(written[0])
        assert {len(column) for column in columns.values()} == {len(rows)}
        assert columns["x" if name == "cameras" else "vx"][0] == float(
            written[0]["x" if name == "cameras" else "vx"]
        )
    cameras = located.table("cameras")
    assert cameras["name"][0] == located.cameras[0].name
    assert cameras["placed"].dtype == np.bool_
    assert cameras["degree"].dtype == np.int64
    unplaced = Table(CameraRow, 2, {"name": ["a.jpg"]}).flat()
    assert list(unplaced)[4:6] == ["x", "y"]
    assert np.isnan([unplaced["x"][0], unplaced["trust"][0], unplaced["sigma_y"][0]]).all()
    assert cameras["piece"].dtype == np.float64
