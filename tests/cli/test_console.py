"""What the user sees while a command runs: progress with totals, and pycolmap's messages only if wanted."""

import io
import json
import os
import re
import subprocess
import sys
import time
from collections import defaultdict
from contextlib import suppress
from functools import partial
from itertools import pairwise

import pycolmap
import pytest

from sfm_shapefit import check, locate, map_database
from sfm_shapefit.base.display import NextStep, Row, Telling
from sfm_shapefit.base.kernel_cache import counted_as_compiling, measure_compilation
from sfm_shapefit.cli import console
from sfm_shapefit.cli.flags import OutputFlags
from sfm_shapefit.cli.forecast import PLANS, Course
from sfm_shapefit.cli.frame import Run
from sfm_shapefit.files.colmap import model
from sfm_shapefit.files.colmap.quiet import quiet_log
from tests.program import run, run_python
from tests.scenes import FACADE, RING, ROOT


def stages_of(run) -> dict[str, list[tuple[int, int]]]:
    """Return what a run reports of each stage."""
    reported = defaultdict(list)
    run(lambda stage, done, total: reported[stage].append((done, total)))
    return reported


def assert_counted_up(steps: list[tuple[int, int]], total: int) -> None:
    """A stage begins with (0, 1), counts up to its total, and ends with (1, 1)."""
    assert steps[0] == (0, 1)
    assert steps[-1] == (1, 1)
    inner = steps[1:-1]
    assert inner == sorted(inner)
    assert {step[1] for step in inner} == {total}
    assert inner[-1] == (total, total)


def test_locate_counts_pairs_and_images():
    stages = stages_of(lambda progress: locate(RING / "sparse/0", progress=progress))
    assert list(stages) == [
        "read",
        "directions",
        "solve",
        "adjustment",
        "trust",
        "structure",
        "triangulation",
        "model",
    ]
    assert_counted_up(stages["directions"], 16)  # verified pairs of the 8 images
    assert_counted_up(stages["structure"], 16)
    _, num_tracks = stages["triangulation"][1]
    assert_counted_up(stages["triangulation"], num_tracks)


def test_tracks_of_a_model_are_counted_by_pairs_and_the_solve_by_iterations():
    stages = stages_of(lambda progress: locate(FACADE / "sparse/0", directions="tracks", progress=progress))
    assert_counted_up(stages["directions"], 36)  # pairs of 9 images
    iterations = stages["solve"][1:-1]
    done = [count for count, _ in iterations]
    assert done[0] == 1
    assert all(after in (before + 1, 1) for before, after in pairwise(done))  # from 1 on again: another solve
    assert {limit for _, limit in iterations} == {100}  # of Newton steps; see `solver.solve`


RUN = """
import time
from sfm_shapefit.cli.progress import show_progress
with show_progress(True, {how}plan=("read", "directions", "trust")) as hear:
    hear("directions", 0, 1)
    for k in range(1, 9):
        hear("directions", k, 100)
        time.sleep({pause})
    hear("directions", 1, 1)
    hear("trust", 0, 1)
    hear("trust", 1, 1)
"""


def test_the_rest_of_a_run_is_what_is_planned_at_the_rate_so_far():
    """Twice as slow as usual, which is .02 s and .1 s for each 1,000 pairs of `directions`, and so on."""
    course = Course(("read", "directions", "solve", "write"))
    course.hear("read", 0, 1, now=0.0)
    course.hear("directions", 0, 1, now=50.0)
    assert course.rest(50.0) is None  # nobody knows how many pairs there are
    course.hear("directions", 0, 100_000, now=50.0)
    for done in (25_000, 50_000):
        course.hear("directions", done, 100_000, now=50.0 + 2.0 * 10.02 * done / 100_000)
    assert course.title == "stage 2 of 4, directions"
    assert course.counts == "50,000 of 100,000"
    rest = 2.0 * (0.5 * 10.02 + 0.2 + 10.0 + 0.15 + 10.0)
    assert course.rest(60.02) == pytest.approx(rest, rel=1e-9)
    assert course.rest(62.02) == pytest.approx(rest - 2.0, rel=1e-9)  # a clock goes on between two reports
    course.hear("directions", 1, 1, now=70.04)
    course.hear("solve", 0, 1, now=70.04)
    course.hear("solve", 1, 100, now=71.04)  # steps that it may take, not steps that it will
    assert course.counts == ""
    assert course.rest(72.04) == pytest.approx(2.0 * (10.2 + 10.15) - 2.0, rel=1e-9)
    assert course.rest(95.0) is None  # it takes longer than usual


def test_what_nobody_knows_of_a_run_is_not_forecast():
    course = Course(("images", "features", "directions", "trust"))
    course.hear("features", 0, 10, now=0.0)
    course.hear("features", 5, 10, now=20.0)
    assert course.rest(20.0) is None
    assert course.rest_of_stage(20.0) == pytest.approx(20.0)
    course.hear("directions", 0, 1000, now=40.0)
    course.hear("directions", 400, 1000, now=48.0)
    course.hear("directions", 500, 1000, now=50.0)
    assert course.rest(50.0) == pytest.approx(10.0 + 20.0 * (0.1 + 0.15) / 0.12)
    course.hear("features", 1, 1, now=50.0)  # the end of a stage around this one
    assert course.title == "stage 3 of 4, directions"
    course.hear("compiling", 0, 1, now=50.0)
    assert course.title == "compiling"
    assert course.rest(50.0) is None
    course.hear("directions", 500, 1000, now=90.0)  # resumed: what was done before has no rate
    assert course.rest_of_stage(90.0) is None
    assert course.rest(90.0) == pytest.approx(10.0 / 0.06 * (0.06 + 0.25))
    course.hear("directions", 600, 1000, now=92.0)
    assert course.rest_of_stage(92.0) == pytest.approx(8.0)
    course.hear("features", 0, 1, now=92.0)  # once more
    course.hear("directions", 0, 1000, now=92.0)
    course.hear("directions", 500, 1000, now=97.0)
    assert course.rest(97.0) is None


@pytest.mark.parametrize(
    ("plan", "run"),
    [
        ("MODEL OUT", lambda progress: locate(RING / "sparse/0", progress=progress)),
        ("DATABASE OUT", lambda progress: map_database(RING / "database.db", progress=progress)),
        ("MODEL with a database", lambda progress: check(RING / "sparse/0", progress=progress)),
    ],
)
def test_a_run_keeps_to_its_plan(plan, run):
    course = Course(PLANS[plan])

    def hear(stage, done, total):
        course.hear(stage, done, total, now=0.0)
        assert course.stage in course.plan

    run(hear)
    assert course.is_as_planned
    assert course.size


def shown_on_a_terminal(code: str, **environment: str) -> list[str]:
    """Return what a program writes on stderr, a terminal of 80 columns, by what it draws over."""
    master, terminal = os.openpty()
    env = os.environ | {"TERM": "xterm", "COLUMNS": "80"} | environment
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stderr=terminal, env=env)
    os.close(terminal)
    shown = b""
    with suppress(OSError):  # the terminal's other end is closed
        while chunk := os.read(master, 4096):
            shown += chunk
    os.close(master)
    assert process.wait() == 0
    return shown.decode().split("\r")


@pytest.mark.parametrize("environment", [{}, {"COLUMNS": "40", "NO_COLOR": "1"}])
def test_a_terminal_has_one_line_of_progress_with_what_is_left_and_nothing_of_it_at_the_end(environment):
    drawn = shown_on_a_terminal(RUN.format(how="", pause=0.3), **environment)
    plain = [re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", one) for one in drawn]
    assert not any("\n" in one.strip() for one in plain)  # never more than one line
    assert all(len(one.strip()) <= int(environment.get("COLUMNS", 80)) for one in plain)
    if "COLUMNS" not in environment:
        assert any(
            re.match(r"stage 2 of 3, directions .* \d of 100, \d s, about \d+ (s|min) left", one)
            for one in plain
        )
    assert ("\x1b[9" in "".join(drawn)) == ("NO_COLOR" not in environment)
    assert drawn[-1].endswith("\x1b[2K")  # the line is erased


@pytest.mark.parametrize("how", ["verbose=True, ", "patience_s=0.0, "])
def test_without_a_terminal_a_short_run_says_nothing_and_a_long_one_a_line_for_each_stage(how):
    assert run_python("-c", RUN.format(how="", pause=0.0)).stderr == ""
    told = run_python("-c", RUN.format(how=how, pause=0.0)).stderr.splitlines()
    assert told == ["sfm-shapefit: stage 2 of 3, directions", "sfm-shapefit: stage 3 of 3, trust"]


@pytest.mark.parametrize("verbose", [False, True])
def test_verbose_lets_pycolmap_speak_and_lists_seconds_per_stage(tmp_path, capfd, monkeypatch, verbose):
    read = model.read_folder

    def talkative(*arguments):
        with quiet_log():  # as every call of pycolmap is
            pycolmap.logging.warning("these images are of the past")
        return read(*arguments)

    monkeypatch.setattr(model, "read_folder", talkative)
    command = ["locate", RING / "sparse/0", tmp_path / "out", "--adjust", "full", "--no-report"]
    done = run(*command, *["--verbose"] * verbose, code=0)
    native = capfd.readouterr().err
    if not verbose:
        assert (done.stderr, native) == ("", "")
        assert re.search(r"^8 of 8 images placed, .* px {8}\d+\.\d s", done.stdout)
        assert "bundle adjustment" not in done.stdout
        return
    assert "these images are of the past" in native
    assert "sfm-shapefit: stage 2 of 10, directions\n" in done.stderr
    assert re.search(r"seconds +│ read \d+\.\d\d, directions", done.stdout)
    assert "bundle adjustment" in done.stdout


class Terminal(io.TextIOWrapper):
    """A stdout that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def shown_on(stdout, monkeypatch, show, *, encoding="utf-8", **environment):
    """Return what is shown on a kind of stdout."""
    raw = io.BytesIO()
    with monkeypatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        patch.setattr(sys, "stdout", stdout(raw, encoding=encoding))
        show()
        sys.stdout.flush()
        return raw.getvalue().decode(encoding)


written = partial(shown_on, io.TextIOWrapper)


def test_names_that_stdout_cannot_show_have_escapes(monkeypatch):
    table = partial(console.print_table, "d\u00e9", [("left out", ["\u0663", "b\x1b[2J"])])
    shown = written(monkeypatch, table, encoding="ascii")
    assert r"d\xe9" in shown
    assert r"\u0663" in shown
    assert r"b\ufffd[2J" in shown
    assert "d\u00e9" in written(monkeypatch, table)


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_json_means_the_same_on_any_stdout(monkeypatch, encoding):
    summary = {"names": ["d\u00e9", "\u0663", "\udce9"]}
    shown = written(monkeypatch, partial(console.print_json, summary), encoding=encoding)
    assert json.loads(shown) == summary
    assert ("\u0663" in shown) == (encoding == "utf-8")


def test_a_color_terminal_shows_warnings_and_verdict_in_color_unless_no_color_is_wanted(monkeypatch):
    def show():
        console.print_answer(Telling(["8 of 8"], [Row("warning", ["look out"])]), "3.0 s")
        console.print_ending(
            "look", "look at 1 camera (a.jpg)", "written to out/", NextStep("", "colmap", "later")
        )

    shown = partial(shown_on, Terminal, monkeypatch, show, TERM="xterm-256color")
    colored = shown()
    assert "8 of 8        3.0 s\n" in colored
    assert "\x1b[1;33mwarning: look out\x1b[0m" in colored
    assert "\x1b[1;33mverdict: look at 1 camera (a.jpg)" in colored
    assert colored.endswith("written to out/\nnext, later: colmap\n")
    assert "33m" not in shown(NO_COLOR="1")
    narrow = re.sub("\x1b\\[[0-9]*m", "", shown(COLUMNS="20", NO_COLOR="1"))
    assert narrow.endswith("look at 1 \ncamera (a.jpg)\nwritten to out/\nnext, later: colmap\n")


def test_a_terminal_of_eighty_columns_has_a_usual_first_line_whole_and_never_breaks_a_command(monkeypatch):
    first, step = (
        "30 of 30 images placed, 20,937 points, mean reprojection error 0.40 px",
        f"colmap {'x ' * 60}",
    )

    def show():
        console.print_answer(Telling([first]), "29.9 s")
        console.print_ending("good", "good", "written to out/", NextStep("", step))

    lines = shown_on(Terminal, monkeypatch, show, COLUMNS="80", TERM="xterm").splitlines()
    assert lines[0] == f"{first}    29.9 s"
    assert lines[-1].strip() == f"next: {step}".strip()


def test_options_are_spelled_as_the_command_takes_them(tmp_path):
    typed = run("locate", RING / "sparse/0", tmp_path / "out", "--min-trust", "7", code=2)
    assert "--min-trust must lie in [0, 1]" in typed.output
    (tmp_path / "few.toml").write_text("min_trust = 7\n[directions]\nmin_inlers = 3\n")
    config = tmp_path / "few.toml"
    assert "did you mean min_inliers?" in run("locate", RING / "sparse/0", "out", "--config", config).output
    assert console.in_flags("rigs=free, or min_trust=0.5; k=1") == "--rigs free, or --min-trust 0.5; k=1"
    assert console.in_flags("replace it (overwrite=True)") == "replace it (--overwrite)"
    assert console.in_flags("by min_inliers=10") == "by min_inliers = 10 in the file of --config"
    config.write_text("min_trust = 7\n")
    assert " min_trust must lie in" in run("locate", RING / "sparse/0", "out", "--config", config).output


def test_a_path_that_is_longer_than_the_table_is_folded_not_cut(monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    path = "/" + "/".join(f"folder{k}" for k in range(12))
    shown = written(monkeypatch, partial(console.print_table, path, [("written to", path)]))
    assert "\u2026" not in shown
    assert path in "".join(shown.replace("│", " ").split()).partition("writtento")[2].replace("┘", "")


def test_a_run_says_how_much_of_its_time_went_into_compiling(monkeypatch):
    with measure_compilation() as spent, counted_as_compiling(), counted_as_compiling():
        time.sleep(0.02)
    assert 0.02 <= spent.seconds < 1.0  # once, though one counted inside the other
    run_ = Run(options=None, flags=OutputFlags(), protect=[], compiling=spent)
    assert "compiling" not in run_.describe_time()
    spent.seconds = 97.2
    assert re.fullmatch(r"\d+\.\d s, of which 97 s compiling kernels, once", run_.describe_time())
