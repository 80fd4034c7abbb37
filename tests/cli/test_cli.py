"""The commands as users type them: results, exit codes, one sentence per error, nothing left over."""

import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from typer.main import get_command
from typer.testing import CliRunner

import sfm_shapefit
from sfm_shapefit.base import atomic_folder as output
from sfm_shapefit.base.settings import setting_groups
from sfm_shapefit.cli import app
from sfm_shapefit.cli.colmap_names import answer_for_command
from sfm_shapefit.commands.locate import locate
from sfm_shapefit.facts.command_options import LocateOptions
from sfm_shapefit.facts.placed import UNITS
from sfm_shapefit.files.colmap.sqlite_file import database_in
from sfm_shapefit.files.graph_text import graph_text
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.report.first_screen import tiles
from sfm_shapefit.report.results import draw_result
from tests.problems import all_pairs, exact_graph
from tests.program import run, run_python, run_refused
from tests.scenes import BUNDLED, COURTYARD, FACADE, RING, copied, edit_database, fingerprint

RING_MODEL, FACADE_MODEL = RING / "sparse" / "0", FACADE / "sparse" / "0"


@pytest.fixture(scope="module")
def ring_run(tmp_path_factory):
    """A run of `locate`, and where it wrote."""
    out = tmp_path_factory.mktemp("ring") / "out"
    return run("locate", RING_MODEL, out, code=0), out


def test_locate_writes_the_model_and_its_tables_and_says_what_was_placed_and_where_it_is(ring_run):
    result, out = ring_run
    model = {"cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"}
    tables = {"locate.json", "cameras.csv", "covariances.csv", "pairs.csv", "report.html"}
    assert {path.name for path in out.iterdir()} == model | tables
    assert pycolmap.Reconstruction(out).num_reg_images() == 8
    placed, matches, known, colors, verdict, report, command = result.stdout.splitlines()
    assert re.fullmatch(
        r"8 of 8 images placed, \d+ points, mean reprojection error 0\.\d\d px +\d.* s.*", placed
    )
    assert colors == "colors: the points have none; --images FOLDER takes them from the images"
    assert matches.endswith("ring8/database.db; 0 of 16 pairs contradict the result; rotations kept")
    assert re.fullmatch(r"positions known to ± \S+ % of the scene", known)
    assert verdict == "verdict: good"
    assert report == f"written to {out}/; open {out / 'report.html'}"
    step = f"sfm-shapefit workspace {out} IMAGES {out}_dense"
    assert command == f"next: {step}"
    assert result.stderr == ""


def test_terminal_and_report_show_the_figures_of_locate_json(ring_run):
    result, _ = ring_run
    found = locate(RING_MODEL)
    drawing, facts = draw_result(found), found.facts
    known = {"pair_error_deg": 0.25, "pair_error_px": 7.0, "sigma": 0.5, "sigma_of_extent": 0.125}
    figures = facts.figures
    facts = replace(facts, figures=replace(figures, **known))
    shown = {tile["label"]: tile["value"] for tile in tiles(drawing, facts)}
    assert shown["typical error of a pair"] == "7 px, 0.25°"
    assert shown["typical uncertainty, 12% of the scene"] == "± 0.5 units"
    told = facts.told((), "")
    assert ["0.25 deg (7 px)"] in [row.lines for row in told.details]
    assert told.lines[2] == "positions known to ± 12 % of the scene"
    assert told.lines[0].startswith("8 of 8 images placed, ")
    lost = replace(facts, figures=replace(facts.figures, sigma_of_extent=1.5))
    assert lost.told((), "").lines[2] == "the uncertainty of positions is not known"
    metric = replace(facts, figures=replace(facts.figures, sigma_unit=UNITS["prior"]))
    assert metric.told((), "").lines[2].endswith("(0.5 in the priors' units, relative to one another)")
    metric = replace(facts, figures=replace(facts.figures, sigma_unit="m"))
    assert metric.told((), "").lines[2].endswith("12 % of the scene (50 cm, relative to one another)")
    assert {
        "label": "typical uncertainty, 12% of the scene, relative to one another",
        "value": "± 50 cm",
    }.items() <= {
        k: v for tile in tiles(drawing, metric) for k, v in tile.items() if tile["value"].startswith("± 50")
    }.items()
    assert figures.sigma == pytest.approx(np.median(drawing.cameras.sigmas[drawing.cameras.placed]))
    assert f"± {100 * figures.sigma_of_extent:.2g} % of the scene" in result.stdout


def test_a_folder_without_the_images_is_told_and_a_graph_has_no_images_to_show(tmp_path):
    wrong = ("map", RING / "database.db", tmp_path / "out", "--images", tmp_path)
    assert "holds no image of" in run_refused(*wrong, code=3)  # before the work
    said = run("locate", RING_MODEL, tmp_path / "out", "--images", tmp_path, code=0).stdout
    assert "lacks 8 of 8 images: is it the right folder?" in " ".join(said.replace("│", " ").split())
    assert "--images" in run("locate", "--help").stdout
    assert "--images" not in run("place", "--help-all").stdout
    graph = BUNDLED / "graph40.txt"
    refused = run("place", graph, tmp_path / "out", "--images", tmp_path, code=2).output
    assert "--images is an option of map, locate, join, check and synth" in refused


def test_json_is_the_only_thing_on_stdout_and_equals_the_file_under_colmaps_own_names(tmp_path):
    out = tmp_path / "out"
    names = ("--input_path", RING_MODEL, "--output_path", out, "--database_path", RING / "database.db")
    result = run("locate", *names, "--json", code=0)
    assert json.loads(result.stdout) == json.loads((out / "locate.json").read_text())


def test_other_commands_take_colmaps_names_of_paths_too(tmp_path):
    run("convert", "--input_path", RING_MODEL, "--output_path", tmp_path / "copy", code=0)
    names = ("--database_path", tmp_path / "missing.db", "--output_path", tmp_path / "out")
    assert "missing.db does not exist" in run_refused("map", *names)


@pytest.mark.parametrize(
    ("typed", "words"),
    [
        ("mapper --database_path a", "mapper is COLMAP's; here it is sfm-shapefit map DATABASE OUT"),
        ("model_comparer --input_path1 a", "here it is sfm-shapefit evaluate MODEL REF"),
        ("colmap mapper --database_path a", "mapper is COLMAP's; here it is sfm-shapefit map DATABASE OUT"),
        ("glomap --help", "glomap is another program; `sfm-shapefit --help` lists the commands"),
        ("stereo_fusion a", "no counterpart here; run it on the folder of sfm-shapefit workspace MODEL"),
        ("matches_importer a", "no counterpart here; run it on the database before sfm-shapefit map"),
        ("model_cropper a", "no counterpart here; run it on a model that map or locate wrote"),
        ("map a b --Mapper.ba_refine_focal_length 0", "here it is --intrinsics held, focal or all"),
        ("map a b --GlobalMapper.min_num_matches=30", "here it is min_matches = ... in the file of --config"),
        ("map a b --SiftExtraction.max_num_features 9", "here it is --max-num-features"),
        ("map a b --GlobalMapper.keep_max_num_tracks 9", "this command has nothing like it; leave it out"),
        ("check a --Mapper.min_num_matches 3", "this command has nothing like it; leave it out"),
        ("check a --Mapper.num_threads 3", "this command has nothing like it; leave it out"),
        ("map a b --Mapper.ba_global_function_tolerance 0", "images are placed and adjusted all at once"),
        ("map a b --project_path x.ini", "here it is --config FILE, in TOML"),
        ("locate a b --ba_gpu_index 0", "no GPU is used, so leave it out"),
        ("join --input_path1 a --input_path2 b", "here paths go by their place, without a flag"),
        ("locate a b --min_model_size 4", "--min_model_size is an option of map"),
        ("map a b --sequence none", "--sequence is a key of --config: sequence = ..."),
    ],
)
def test_what_colmap_has_and_we_have_not_is_answered_with_what_it_is_here(typed, words):
    assert words in " ".join(run(*typed.split(), code=2).stderr.split())


def test_flags_are_understood_with_underscores_too(tmp_path):
    flags = ("--min_trust=0.25", "--no_report", "--known_distance", "0001.jpg", "0002.jpg", "3")
    told = json.loads(run("locate", RING_MODEL, tmp_path / "out", *flags, "--json", code=0).stdout)
    assert told["options"]["min_trust"] == 0.25
    assert told["options"]["known_distance"] == [["0001.jpg", "0002.jpg", 3.0]]
    assert not (tmp_path / "out" / "report.html").exists()


def test_what_is_wrong_with_the_input_is_said_before_what_is_wrong_with_the_output(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("out/mine", "empty/none.txt", "words.db", "tour.MP4", "1.jpg"):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text("mine")
    before = fingerprint(tmp_path)
    for typed, words in (
        ("map nosuch.db out", "nosuch.db does not exist"),
        ("map nosuch out --camera-model OPENCV", "nosuch does not exist"),
        (f"map {RING_MODEL} out", f"sfm-shapefit locate {RING_MODEL} OUT places its images anew"),
        (f"map {RING_MODEL.parent} out", f"sfm-shapefit locate {RING_MODEL} OUT places its images anew"),
        ("map words.db out", "words.db is not a COLMAP database"),
        ("map tour.MP4 out", "tour.MP4 is a video; take frames, as with `ffmpeg -i VIDEO"),
        ("map 1.jpg out", "1.jpg is an image; give the folder of all images"),
        ("map empty out", "empty has no database.db and holds no image"),
        ("locate nosuch out", "nosuch does not exist"),
        (f"locate {RING_MODEL} out --priors nosuch.csv", "nosuch.csv does not exist"),
        (f"locate {RING_MODEL} out --database words.db", "words.db is not a COLMAP database"),
        (f"join {RING_MODEL} nosuch out", "nosuch does not exist"),
        (f"join {RING_MODEL} empty out", "empty holds no COLMAP model"),
        ("place nosuch.txt out", "nosuch.txt does not exist"),
        ("workspace nosuch empty out", "nosuch does not exist"),
        ("convert nosuch words.db --format tum", "nosuch does not exist"),
        ("evaluate nosuch out --csv words.db", "nosuch does not exist"),
        ("check nosuch --report words.db", "nosuch does not exist"),
    ):
        assert words in run_refused(*typed.split()), typed
    assert fingerprint(tmp_path) == before


def test_paths_given_twice_or_not_at_all_are_wrong_usage(tmp_path):
    run("locate", RING_MODEL, code=2)
    run("locate", RING_MODEL, tmp_path / "out", "--output_path", tmp_path / "o", code=2)
    run("locate", RING_MODEL, tmp_path / "out", "--scale", "metric", code=2)
    run("locate", RING_MODEL, tmp_path / "out", "--min-trust", "7", code=2)
    run("frobnicate", code=2)
    assert list(tmp_path.iterdir()) == []


def test_version_and_help_are_there_and_earlier_names_are_taken_and_stand_in_no_help(tmp_path):
    assert run("--version").stdout == f"sfm-shapefit {sfm_shapefit.__version__}\n"
    listed = run("-h").stdout
    assert listed == run("--help").stdout
    assert "..." not in listed.partition("\n")[2]  # each command's line is whole
    assert "solve" not in listed
    assert run("check", "-h").stdout.startswith("Usage:")


def test_help_lists_commands_in_groups_the_most_used_first():
    text = run("-h").stdout
    titles = [line for line in text.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert titles[1:] == [
        "Make models:",
        "Look at models and results:",
        "Convert, and make test scenes:",
        "Set up:",
    ]
    listed = re.findall(r"^  ([a-z][\w-]*)  ", text.partition("Make models:")[2], flags=re.MULTILINE)
    assert listed[:3] == ["map", "locate", "join"]
    assert set(listed) == {name for name, command in get_command(app).commands.items() if not command.hidden}
    for name in listed:
        last = run(name, "-h").stdout.splitlines()[-1]
        assert last.startswith(("  Example: sfm-shapefit ", "  In a Dockerfile: "))


def test_the_usage_line_shows_what_is_needed():
    assert run("locate", "-h").stdout.splitlines()[0].endswith(" locate [OPTIONS] MODEL OUT")
    assert run("evaluate", "-h").stdout.splitlines()[0].endswith(" evaluate [OPTIONS] MODEL [REF]")
    assert re.search(r"^  MODEL ", run("evaluate", "-h").stdout, flags=re.MULTILINE)
    assert run("warm-up", "-h").stdout.splitlines()[0].endswith(" warm-up [OPTIONS]")


def test_the_shell_can_complete_commands_and_python_can_run_them():
    asked = {"_SFM_SHAPEFIT_COMPLETE": "complete_bash", "COMP_WORDS": "sfm-shapefit lo", "COMP_CWORD": "1"}
    done = CliRunner().invoke(app, [], prog_name="sfm-shapefit", env=asked)
    assert done.stdout == "locate\n"
    assert "--install-completion" in run("-h").stdout
    assert run_python("-m", "sfm_shapefit", "--version").stdout == run("--version").stdout


def test_the_program_ends_without_a_last_search_for_garbage():
    script = (
        "import atexit, gc, sys\n"
        "atexit.register(lambda: print(gc.get_freeze_count() > 0))\n"
        "from sfm_shapefit.cli import main\n"
        "sys.argv[1:] = ['--version']\n"
        "main()"
    )
    assert run_python("-c", script).stdout.endswith("\nTrue\n")


def test_place_is_also_called_solve_and_keys_of_the_config_are_no_flags(tmp_path):
    config = tmp_path / "options.toml"
    config.write_text('solver = "conic"\nfactor_memory_mb = 500\n')
    flags = ("--config", config, "--json", "--no-report")
    done = run("solve", BUNDLED / "graph40.txt", tmp_path / "out", *flags)
    options = json.loads(done.stdout)["options"]
    assert (options["solver"], options["factor_memory_mb"]) == ("conic", 500)
    said = run("solve", BUNDLED / "graph40.txt", tmp_path / "out", "--solver=conic", code=2).stderr
    assert "--solver is a key of --config: solver = ..." in " ".join(said.split())
    text = run("place", "--help-all").stdout
    assert run("solve", "--help-all").stdout == text.replace(" place ", " solve ", 1)


def test_help_lists_flags_with_their_sentences_in_the_groups_of_the_stages():
    text = run("locate", "--help-all").stdout
    titles = [line for line in text.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert titles[:2] == ["Arguments:", "Options:"]
    assert titles[-1] == "What is written and shown:"
    for one in setting_groups(LocateOptions):
        flags = [item for item in one.options if f"\n  --{item.name.replace('_', '-')} " in text]
        assert (f"{one.title}:" in titles) == bool(flags)
        assert all(item.help[:20] in " ".join(text.split()) for item in flags)
    assert not re.search(r"\[default:\s*(None)?\]", text)


@pytest.mark.parametrize("name", sorted(get_command(app).commands))
def test_help_fits_a_screen_and_help_all_has_the_rest(name):
    first, every = (run(name, flag).stdout for flag in ("--help", "--help-all"))
    listed = [
        set(re.findall(r"^  (?:-\w, )?(--[\w-]+)", text, flags=re.MULTILINE)) for text in (first, every)
    ]
    assert len(listed[0]) <= 16
    assert len(listed[1]) <= (36 if name == "map" else 28)  # which has those of matching, too
    assert listed[0] - {"--help-all"} <= listed[1]
    assert ("--help-all" in listed[0]) == (len(listed[1]) > len(listed[0]))


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """What `locate` says of the courtyard without a further option."""
    out = tmp_path_factory.mktemp("plain") / "out"
    return json.loads(run("locate", COURTYARD / "truth", out, "--json", "--no-report").stdout)


@pytest.mark.parametrize(
    ("keys", "changed"),
    [
        (
            "min_inlier_ratio=0.95 adjust='full' scale='unit'",
            "num_pairs_rejected bundle_adjustment scale",
        ),
        ("directions={inlier_threshold_px=0.3}", "num_pairs_rejected"),
        ("max_reprojection_error_px=0.3", "num_points"),
        ("structure={min_triangulation_angle_deg=40}", "num_points"),
        ("solver='conic'", "solve"),
        ("placement={tol=1e-3}", "solve"),
        ("rotations=0.05", "adjustment"),
    ],
)
def test_each_key_matters_by_its_name_and_in_the_table_of_its_group(tmp_path, plain, keys, changed):
    (tmp_path / "options.toml").write_text("\n".join(keys.split()))
    flags = ("--json", "--no-report", "--config", tmp_path / "options.toml")
    facts = json.loads(run("locate", COURTYARD / "truth", tmp_path / "out", *flags).stdout)
    assert all(facts[key] != plain[key] for key in changed.split())


def test_a_key_that_leaves_no_direction_is_refused(tmp_path):
    (tmp_path / "options.toml").write_text("min_inliers = 1000000")
    few = ("--config", tmp_path / "options.toml")
    assert "none of the" in run_refused("locate", COURTYARD / "truth", tmp_path / "out", *few, code=4)


@pytest.mark.parametrize(
    "text",
    [
        *("scale = ", "color = 3", "min_inliers = 'many'", "scale = 'metric'"),
        *("[directions]\nmin_inlier = 3", "[gauge]\nscale = 'prior'", "rotations = 'free'\nadjust = 'none'"),
    ],
)
def test_a_wrong_config_file_is_wrong_usage(tmp_path, text):
    (tmp_path / "options.toml").write_text(text)
    run("locate", FACADE_MODEL, tmp_path / "out", "--config", tmp_path / "options.toml", code=2)
    assert not (tmp_path / "out").exists()


def test_what_is_wrong_in_a_config_file_is_said_with_its_name_and_tables_are_known_too(tmp_path):
    config, flags = tmp_path / "options.toml", ("--config", tmp_path / "options.toml")
    for text, words in (
        ("threads = 2\nmin_trust = 'a'", "options.toml, line 2: min_trust must be a number"),
        ("threads = 2\nthreads = 2", "a key is given for the second time (at line 2"),
        ("[direction]\nmin_inliers = 9", "'direction' is no option; did you mean directions?"),
    ):
        config.write_text(text)
        said = run("locate", RING_MODEL, tmp_path / "out", *flags, code=2).stderr
        assert words in " ".join(said.split())
    config.write_text("min_trust = 0.5")
    said = run("locate", RING_MODEL, tmp_path / "out", *flags, "--min-trust", "7", code=2).stderr
    assert "options.toml: " not in said


COMMANDS_OF_COLMAP = """
    gui automatic_reconstructor bundle_adjuster color_extractor database_cleaner database_creator
    database_merger advancing_front_mesher delaunay_mesher exhaustive_matcher feature_extractor
    feature_importer geometric_verifier global_mapper guided_geometric_verifier hierarchical_mapper
    image_deleter image_filterer image_rectifier image_registrator image_undistorter
    image_undistorter_standalone mapper matches_importer mesh_simplifier mesh_texturer model_aligner
    model_analyzer model_clusterer model_comparer model_converter model_cropper model_merger
    model_orientation_aligner model_splitter model_transformer patch_match_stereo point_filtering
    point_triangulator pose_prior_mapper poisson_mesher project_generator rig_configurator
    rotation_averager sequential_matcher spatial_matcher stereo_fusion transitive_matcher
    view_graph_calibrator vocab_tree_builder vocab_tree_matcher vocab_tree_retriever help version
"""


def test_each_command_of_colmap_is_answered_with_commands_that_there_are():
    ours = {*get_command(app).commands}
    for name in COMMANDS_OF_COLMAP.split():
        answer = answer_for_command(name)
        assert answer, name
        assert set(re.findall(r"sfm-shapefit ([a-z]+)", answer)) <= ours


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "database_path=a.db\nlog_level=0\n[Mapper]\nmin_num_matches=15\nba_refine_focal_length=true\n"
            "ba_local_max_refinements=2",
            "has options of COLMAP, which are not read: log_level is --quiet or --verbose here; "
            "Mapper.min_num_matches is min_matches = ... here; Mapper.ba_refine_focal_length is --intrinsics "
            "held, focal or all here; paths are arguments here; 1 option can be left out",
        ),
        (
            "[Mapper]\nnum_threads = 4\nfoo = 1",
            "Mapper.num_threads is --threads here; 1 option can be left out",
        ),
        ("min_num_matches = 15", "min_num_matches is min_matches = ... here"),
        ("[mapper]\na = 1", "'mapper' is no option"),
        ("# A page\nof words", "is not a readable TOML file"),
    ],
)
def test_a_file_of_colmaps_options_is_answered_with_what_these_are_here(tmp_path, text, words):
    (tmp_path / "project.ini").write_text(text)
    config = ("--config", tmp_path / "project.ini")
    said = run("map", RING / "database.db", tmp_path / "out", *config, code=2).stderr
    assert words in " ".join(said.split())


def test_a_config_file_sets_options_and_flags_win(tmp_path):
    text = 'scale = "unit"\n[directions]\nmin_inliers = 20\n[trust]\nmin_trust = 0.1\n'
    (tmp_path / "options.toml").write_text(text)
    flags = ("--json", "--config", tmp_path / "options.toml", "--min-trust", "0.2")
    facts = json.loads(run("locate", FACADE_MODEL, tmp_path / "a", *flags).stdout)
    values = [facts["options"][name] for name in ("scale", "min_inliers", "min_trust")]
    assert values == ["unit", 20, 0.2]
    assert facts["scale"].startswith("unit")


def test_quiet_prints_nothing_and_an_existing_output_is_refused_and_overwritten_on_request(tmp_path):
    out = tmp_path / "out"
    assert run("locate", RING_MODEL, out, "-q", code=0).output == ""
    before = fingerprint(out)
    assert "exists already" in run_refused("locate", RING_MODEL, out)
    assert fingerprint(out) == before
    run("locate", RING_MODEL, out, "-q", "--overwrite", "--scale", "unit", code=0)
    assert fingerprint(out) != before
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_the_input_is_never_overwritten(tmp_path):
    scene = copied(RING, tmp_path)
    before = fingerprint(scene)
    for target in (scene, scene / "sparse", scene / "sparse" / "0"):
        run_refused("locate", scene / "sparse" / "0", target, "--overwrite")
    assert fingerprint(scene) == before


def broken_scenes(folder: Path):
    """Yield (what is wrong, arguments after `locate`, exit code, a word of the message)."""

    def scene(name, damage):
        root = Path(shutil.copytree(RING, folder / name))
        damage(root / "sparse" / "0", root / "database.db")
        return root / "sparse" / "0"

    def cut(model, _database):
        (model / "images.bin").write_bytes((model / "images.bin").read_bytes()[:-5])

    def sql(statement):
        return lambda _, database: edit_database(database, statement)

    no_pairs = sql("DELETE FROM two_view_geometries")
    unusable_pairs = sql("UPDATE two_view_geometries SET config = 7")
    other_scene = sql("UPDATE images SET name = 'other_' || name")

    def no_database(_model, database):
        database.write_bytes(b"not a database" * 100)

    yield "missing folder", [folder / "nowhere"], 3, "nowhere"
    yield "cut file", [scene("cut", cut)], 3, "images.bin"

    def named(name, damage):
        model = scene(name, damage)
        return [model, "--database", model.parents[1] / "database.db"]

    yield "no pairs", named("pairless", no_pairs), 4, "matches but no two-view geometries"
    yield "only watermark pairs", named("watermark", unusable_pairs), 4, "16 pairs WATERMARK"
    yield "no features", named("bare", sql("DELETE FROM keypoints")), 3, "no features were extracted"
    yield "database of another scene", named("other", other_scene), 3, "not in the model"
    yield "database is no database", named("text", no_database), 3, "database"
    missing = folder / "missing.db"
    yield "database missing", [RING_MODEL, "--database", missing], 3, "missing.db"


def test_bad_input_gets_one_sentence_and_leaves_no_trace(tmp_path):
    (tmp_path / "scenes").mkdir()
    for what, arguments, code, word in broken_scenes(tmp_path / "scenes"):
        before = fingerprint(tmp_path)
        model, *rest = arguments
        assert word in run_refused("locate", model, tmp_path / "out", *rest, code=code), what
        assert fingerprint(tmp_path) == before, what
        assert not (tmp_path / "out").exists(), what


@pytest.mark.parametrize("stands", [True, False])
def test_an_interrupt_says_whether_the_output_stands(tmp_path, monkeypatch, stands):
    move = output._move_into_place

    def interrupted(*arguments, **how):
        if stands:
            move(*arguments, **how)
        raise KeyboardInterrupt

    run("locate", RING_MODEL, tmp_path / "out", "--no-report", code=0)
    monkeypatch.setattr(output, "_move_into_place", interrupted)
    said = run_refused("locate", RING_MODEL, tmp_path / "out", "--no-report", "--overwrite", code=130)
    assert ("interrupted; the output is complete" in said) == stands  # else the earlier one stands there
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    said = run_refused("locate", RING_MODEL, tmp_path / "new", "--no-report", code=130)
    assert ("interrupted; the output is complete" in said) == stands == (tmp_path / "new").exists()


@pytest.mark.parametrize("extra", [(), ("--adjust", "full")])
def test_an_interrupt_in_an_adjustment_leaves_nothing(tmp_path, monkeypatch, extra):
    calls = []

    def interrupted(*_arguments, **_how):
        calls.append(1)
        raise KeyboardInterrupt

    monkeypatch.setattr("sfm_shapefit.adjustment.solve.eliminate_points", interrupted)
    said = run_refused("locate", RING_MODEL, tmp_path / "out", "--no-report", *extra, code=130)
    assert calls
    assert "interrupted; nothing was written" in said
    assert list(tmp_path.iterdir()) == []


def test_solve_writes_the_further_pieces_of_a_bare_graph(tmp_path):
    t = np.random.default_rng(0).standard_normal((8, 3))
    graph = exact_graph(t, [*all_pairs(5), *all_pairs((5, 6, 7))])
    names = [f"n{k}" for k in range(8)]
    named = ViewGraph(8, graph.edges, graph.directions, names=names)
    (tmp_path / "graph.txt").write_text(graph_text(named))
    result = run("solve", tmp_path / "graph.txt", tmp_path / "out")
    assert "pieces/1: 3 of 3 cameras" in " ".join(result.stdout.split())
    lines = (tmp_path / "out" / "pieces" / "1" / "cameras.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in lines] == ["name", "n5", "n6", "n7"]
    facts = json.loads((tmp_path / "out" / "locate.json").read_text())
    assert [piece["folder"] for piece in facts["pieces"]] == [".", "pieces/1"]
    assert "another component; see pieces/1" in (tmp_path / "out" / "cameras.csv").read_text()


def test_evaluate_prints_a_table_json_and_csv_and_writes_over_no_other_file(ring_run, tmp_path):
    arguments = ("evaluate", ring_run[1], RING_MODEL, "--threshold", "0.5")
    table = run(*arguments, "--csv", tmp_path / "errors.csv", code=0)
    assert "8 in common of 8" in table.stdout
    errors = json.loads(run(*arguments, "--json").stdout)
    assert errors["position_error"]["max"] < 1e-5
    last = errors["recall"][-1]
    assert last == {"threshold": 0.5, "fraction_of_extent": None, "recall": 1.0, "auc": last["auc"]}
    assert last["auc"] > 0.9999
    assert "rotation error" in table.stdout
    assert re.search(r"ATE +│ rms \d", run(*arguments, "--trajectory", code=0).stdout)
    lines = (tmp_path / "errors.csv").read_text().splitlines()
    assert lines[0] == "name,position_error,rotation_error_deg,x,y,z"
    assert len(lines) == 9
    (tmp_path / "cameras.csv").write_bytes(b"precious")
    assert "exists already" in run_refused(*arguments, "--csv", tmp_path / "cameras.csv")
    assert (tmp_path / "cameras.csv").read_bytes() == b"precious"
    run(*arguments, "--csv", tmp_path / "cameras.csv", "--overwrite", code=0)
    assert (tmp_path / "cameras.csv").read_text().splitlines() == lines


def test_models_of_other_scenes_are_not_compared_in_silence(ring_run):
    said = run("evaluate", ring_run[1], BUNDLED / "photographed" / "truth", code=0).stdout
    assert "do both models show the same scene?" in " ".join(said.replace("│", " ").split())


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ('sequence = "none"', "'sequence' is an option of map"),
        ('priors = "gps.csv"', "'priors' is no key of a file; give it as a flag: --priors"),
        ("min_trsut = 0.5", "'min_trsut' is no option; did you mean min_trust?"),
        ("[directions]\nmin_inlier = 3", "options.toml: 'min_inlier' is no option of DirectionOptions"),
    ],
)
def test_a_key_that_the_command_does_not_know_is_explained(line, told, tmp_path):
    (tmp_path / "options.toml").write_text(line)
    config = ("--config", tmp_path / "options.toml")
    said = run("locate", RING_MODEL, tmp_path / "out", *config, code=2).output
    assert told in " ".join(said.replace("│", " ").split())


@pytest.mark.parametrize(
    ("command", "source", "flag", "owner"),
    [
        ("locate", RING_MODEL, "--gravity", "map"),
        ("map", RING / "database.db", "--fix", "locate"),
        ("check", RING_MODEL, "--trajectory", "evaluate"),
        ("inspect", RING_MODEL, "--control-points", "locate, map and evaluate"),
    ],
)
def test_a_flag_of_another_command_is_told_whose_it_is(command, source, flag, owner, tmp_path):
    said = run(command, source, tmp_path / "out", flag, "database", code=2).output
    assert f"{flag} is an option of {owner}" in " ".join(said.replace("│", " ").split())


def test_check_says_how_points_are_compared_with_a_finished_model():
    said = run("check", RING_MODEL, "--control_points", "gcp list.txt", code=2).output
    assert f"sfm-shapefit evaluate {RING_MODEL} --control-points 'gcp list.txt'" in " ".join(said.split())


def test_synth_makes_a_workspace_that_locate_takes(tmp_path):
    made = run("synth", tmp_path / "scene", "--shape", "ring", "--num-images", "12", "--seed", "3", code=0)
    assert "12" in made.stdout
    run("locate", tmp_path / "scene" / "sparse" / "0", tmp_path / "out", "-q", code=0)
    run_refused("synth", tmp_path / "scene")
    run("synth", tmp_path / "other", "--num-images", "1", code=2)


def test_names_cannot_play_with_the_terminal_and_brackets_are_only_brackets(tmp_path):
    folder = tmp_path / "a[b]:star:[red]"
    folder.mkdir()
    model = pycolmap.Reconstruction(RING_MODEL)
    model.image(8).name = "[red]\x1b[2Jgone.jpg"
    model.write(folder)
    result = run("locate", folder, folder / "out", "--database", RING / "database.db", code=0)
    assert "\x1b[2J" not in result.output
    assert "[red]" in result.stdout
    assert "[b]:star:[red]" in "".join(result.stdout.split())
    run("evaluate", folder / "out", folder, code=0)


def test_a_scale_from_meaningless_centers_and_a_model_without_points_are_warned_about(tmp_path):
    model = pycolmap.Reconstruction(RING_MODEL)
    rng = np.random.default_rng(0)
    for frame in model.frames.values():
        rotation = frame.rig_from_world.rotation
        frame.rig_from_world = pycolmap.Rigid3d(rotation, 100.0 * rng.standard_normal(3))
    model.write(tmp_path)
    (tmp_path / "options.toml").write_text("min_triangulation_angle_deg = 89")
    flags = ("--database", RING / "database.db", "--config", tmp_path / "options.toml", "--json")
    facts = json.loads(run("locate", tmp_path, tmp_path / "out", *flags).stdout)
    assert facts["num_points"] == 0
    assert any("of their spread off" in warning for warning in facts["warnings"])
    assert any("no 3D point" in warning for warning in facts["warnings"])


def test_a_signal_while_writing_leaves_nothing(tmp_path):
    script = f"""
import os, signal, sys
from sfm_shapefit import cli
from sfm_shapefit.commands import write as files
files.write_rows = lambda *_: os.kill(os.getpid(), signal.SIGTERM)
sys.argv = ["sfm-shapefit", "locate", {str(RING_MODEL)!r}, {str(tmp_path / "out")!r}]
cli.main()
"""
    done = run_python("-c", script)
    assert done.returncode == 130
    assert done.stderr == "sfm-shapefit: interrupted; nothing was written\n"
    assert list(tmp_path.iterdir()) == []


def test_arguments_in_the_wrong_order_are_told_so_before_anything_is_read(ring_run, tmp_path):
    for first in (tmp_path / "new", ring_run[1]):
        said = run_refused("locate", first, RING_MODEL, "--overwrite")
        assert "the order is MODEL OUT" in said
        assert f"give {RING_MODEL} first" in said
    assert "the order is DATABASE OUT" in run_refused("map", tmp_path / "new", RING / "database.db")
    assert "the order is GRAPH OUT" in run_refused("place", tmp_path / "new", BUNDLED / "graph40.txt")


@pytest.mark.parametrize("command", ["inspect", "locate", "place"])
def test_a_database_in_the_place_of_a_model_is_told_which_command_takes_it(command, tmp_path):
    out = [] if command == "inspect" else [tmp_path / "out"]
    said = run_refused(command, RING / "database.db", *out)
    assert "is a database: `sfm-shapefit map`" in said
    assert "--database" in said


def test_a_database_among_the_arguments_is_told_to_go_by_its_flag(tmp_path):
    database, out = RING / "database.db", tmp_path / "out"
    for words in ([database, RING_MODEL, out], [RING_MODEL, database, out], [RING_MODEL, out, database]):
        done = run("locate", *words)
        assert done.exit_code == 2
        assert "is a database" in done.stderr
        assert "--database" in done.stderr
    assert "goes by --database" in run_refused("locate", RING_MODEL, database)
    assert "unexpected extra argument" in run("locate", RING_MODEL, out, "more").stderr
    assert not out.exists()


def test_options_and_names_may_begin_with_the_mark_of_a_windows_editor(tmp_path):
    for name, flag in (("names.txt", "--fix"), ("options.toml", "--config")):
        file = tmp_path / name
        file.write_bytes(b"\xef\xbb\xbf" + (BUNDLED / name).read_bytes().replace(b"\n", b"\r\n"))
        done = run("locate", RING_MODEL, tmp_path / flag, flag, file, "--no-report", "--adjust", "none")
        assert done.exit_code == 0, done.stderr


def test_a_file_that_is_missing_is_said_to_be_missing(tmp_path):
    for arguments in (
        ("place", "missing.txt", tmp_path / "out"),
        ("locate", RING_MODEL, tmp_path / "out", "--priors", "missing.txt"),
        ("locate", RING_MODEL, tmp_path / "out", "--fix", "missing.txt"),
        ("locate", RING_MODEL, tmp_path / "out", "--control-points", "missing.txt"),
    ):
        assert run_refused(*arguments) == "sfm-shapefit: missing.txt does not exist\n"
    flag = ("--config", "missing.toml")
    assert "missing.toml does not exist" in run("locate", RING_MODEL, tmp_path / "o", *flag, code=2).output


def test_map_takes_a_folder_by_its_database_and_refuses_one_without(tmp_path):
    assert database_in(RING) == RING / "database.db"
    assert database_in(RING / "database.db") == RING / "database.db"
    assert "without a database.db" in run_refused("map", RING_MODEL, tmp_path / "out")


def test_what_is_not_installed_has_an_exit_code_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    said = run_refused("locate", RING_MODEL, tmp_path / "out", "--scheduler", "a:1", "-q", code=5)
    assert "--scheduler needs dask.distributed: pip install" in said


def test_a_word_that_a_flag_does_not_take_is_refused_without_words_of_a_library(tmp_path):
    said = run("locate", RING_MODEL, tmp_path / "out", "--intrinsics", "focl", code=2).output
    assert "'--intrinsics': 'focl' is not one of 'auto', 'held', 'focal', 'all'" in said


def test_json_in_the_place_of_a_model_or_graph_is_told_what_is_wanted(tmp_path):
    path = tmp_path / "transforms.json"
    path.write_text("{}\n")
    for command in (("inspect", path), ("locate", path, tmp_path / "out")):
        assert "has no key 'frames'; give a transforms.json" in run_refused(*command)


def test_a_list_of_poses_is_inspected_as_it_is_located_and_a_graph_stays_one(tmp_path):
    for name in ("poses.json", "poses.txt"):
        run("convert", RING_MODEL, tmp_path / name, "--format", "nerf" if name[-1] == "n" else "tum", code=0)
        said = run("inspect", tmp_path / name, "--database", RING / "database.db", code=0).output
        assert said.startswith("8 images of ")
        assert f"--database {RING / 'database.db'}" in said.splitlines()[-1]
    assert "40 nodes" in run("inspect", BUNDLED / "graph40.txt", code=0).output


def test_a_folder_without_a_model_is_refused_before_what_reads_models_is_loaded(tmp_path):
    arguments = ["locate", str(COURTYARD / "sparse"), str(tmp_path / "out")]
    done = run_python("-X", "importtime", "-m", "sfm_shapefit", *arguments)
    *loaded, said = done.stderr.splitlines()
    assert done.returncode == 3
    assert said.endswith(f"but {COURTYARD}/sparse/0 does; give that folder")
    assert not {"numba", "pycolmap", "scipy"} & {line.split("|")[-1].strip() for line in loaded}


@pytest.mark.parametrize("command", [("map", RING / "database.db"), ("locate", COURTYARD / "sparse" / "0")])
def test_models_and_tables_are_the_same_to_the_byte_for_any_number_of_threads(command, tmp_path):
    for threads in (1, 3):
        run(*command, tmp_path / str(threads), "--threads", threads, "--no-report", code=0)
    files = [file for file in (tmp_path / "1").rglob("*") if file.suffix in {".bin", ".csv"}]
    assert len(files) >= 7
    for file in files:
        assert file.read_bytes() == (tmp_path / "3" / file.relative_to(tmp_path / "1")).read_bytes(), file


def test_a_file_in_the_place_of_out_is_only_swapped_where_the_command_takes_files(ring_run, tmp_path):
    path = tmp_path / "transforms.json"
    path.write_text("{}\n")
    said = run_refused("join", RING_MODEL, RING_MODEL, path)
    assert said.endswith("is a file, but OUT is a folder to be made; the order is MODEL MODEL... OUT\n")
    database = RING / "database.db"
    assert f"so give {database} first" in run_refused("map", ring_run[1], database)


def test_the_values_that_flags_take_are_named_in_words():
    text = run("locate", "--help-all").stdout
    assert "--known-distance NAME NAME DISTANCE" in text
    assert "--fix FILE|solved" in text
    text += run("join", "--help").stdout
    for word in ("<str>", "<int>", "<float>", "str,str", "list["):
        assert word not in text
