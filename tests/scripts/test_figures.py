"""The figures of the paper: their trials, what is kept between runs, and the scripts in their quick mode."""

import os
import pickle
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import figure
import report_picture
from make_data import SCENES
from paper import noise_robustness, phase_transition, theory_plot
from paper.trials import METHODS, Cell, run_batch, run_trials
from sfm_shapefit.synthetic import make_rendered_scene
from sfm_shapefit.synthetic.rendering import encode_images
from tests.program import run
from tests.scenes import PHOTOGRAPHED, ROOT

DOCS = ROOT / "docs"

CELLS = [Cell(12, 0.0), Cell(12, 0.2, 0.05)]


def test_every_method_solves_the_same_problems_and_one_without_an_answer_counts_as_not_recovered():
    both = run_batch(CELLS, ["ShapeFit", "least squares"], 2, 0)
    assert both.shape == (2, 2, 2)
    np.testing.assert_array_equal(run_batch(CELLS[1:], ["ShapeFit"], 2, 0)[0, 0], both[1, 0])
    assert not np.array_equal(run_batch(CELLS[1:], ["ShapeFit"], 2, 1)[0, 0], both[1, 0])
    values = run_batch([Cell(4, 0.0, p=0.1)], ["ShapeFit"], 3, 0)
    np.testing.assert_array_equal(values, np.ones((1, 1, 3)))


def test_an_interrupted_run_goes_on_where_it_was_unless_its_settings_were_others(tmp_path):
    cache = tmp_path / "kept"
    whole = run_trials(CELLS, ["ShapeFit"], 2, cache=cache, processes=1)
    settings, values = pickle.loads(cache.read_bytes())
    del values[str(CELLS[0])]  # as if the run had been stopped before this cell
    values[str(CELLS[1])][:] = 0.125
    cache.write_bytes(pickle.dumps((settings, values)))
    resumed = run_trials(CELLS, ["ShapeFit"], 2, cache=cache, processes=1)
    np.testing.assert_array_equal(resumed.values[0], whole.values[0])
    np.testing.assert_array_equal(resumed.values[1], 0.125)
    with pytest.raises(ValueError, match="other settings"):
        run_trials(CELLS, ["ShapeFit"], 3, cache=cache, processes=1)


@pytest.mark.slow
def test_figure_1_has_a_quick_mode(tmp_path, capsys):
    how = ["--quick", "--processes", "1", "--figure", "methods"]
    figure.main(["phase_transition", "--out", str(tmp_path / "f.png"), *how])
    assert (tmp_path / "f.png").stat().st_size > 5000
    said = capsys.readouterr().out
    assert "problems recovered below 1e-09" in said
    worst, cells = said.split("ShapeFit, noise 0.05: at most ")[1].split()[0:4:3]
    assert int(cells) >= 1
    assert float(worst) < 0.1  # twice the noise


@pytest.mark.slow
def test_beyond_the_breakdown_point_place_recovers_what_the_usual_programs_lose(tmp_path, capsys):
    figure.main(["beyond", "--out", str(tmp_path / "f.png"), "--quick", "--processes", "1"])
    assert (tmp_path / "f.png").stat().st_size > 5000
    said = capsys.readouterr().out
    assert "LUD, random, p = 1/2: all exact up to q = 0\n" in said
    assert "place, random, p = 1/2: all exact up to q = 0.6\n" in said


@pytest.mark.slow
def test_figure_2_has_a_quick_mode_and_its_slope_is_one(tmp_path, capsys):
    before = dict(os.environ)
    figure.main(["noise_robustness", "--out", str(tmp_path / "f.png"), "--quick"])
    assert dict(os.environ) == before, "numba would compile for another processor from here on"
    assert (tmp_path / "f.png").stat().st_size > 5000
    slope = float(capsys.readouterr().out.split("ShapeFit: slope ")[1].split()[0])
    assert slope == pytest.approx(1.0, abs=0.05)


def test_the_slope_is_fitted_where_the_noise_is_small_and_the_worst_share_is_that_of_one_camera():
    sigmas = np.logspace(-6, 0, 7)
    errors = np.where(sigmas <= 1e-2, 3.0 * sigmas**1.5, 1.0)
    assert noise_robustness.fit_slope(sigmas, errors) == pytest.approx(1.5)
    problem = SimpleNamespace(
        locations=np.zeros((4, 3)),
        edges=np.array([[0, 1], [0, 2], [0, 3], [2, 3]]),
        corrupted=np.array([True, False, True, True]),
    )
    assert theory_plot.worst_share(problem) == 0.5  # cameras 0 and 3 have two of four


def test_every_panel_names_a_known_method_and_only_sizes_that_double_are_drawn_on_a_logarithmic_axis():
    panels = phase_transition.FIGURES
    assert all(panels.values())
    assert {panel.method for shown in panels.values() for panel in shown} <= set(METHODS)
    assert [name for name, shown in panels.items() if any(panel.doubles for panel in shown)] == ["large"]
    assert all(panel.doubles for panel in panels["large"])


def test_the_theory_plot_has_a_quick_mode_and_grants_less_than_is_recovered(tmp_path, capsys):
    figure.main(["theory_plot", "--out", str(tmp_path / "f.png"), "--quick"])
    assert (tmp_path / "f.png").read_bytes().startswith(b"\x89PNG")
    *_, dense = capsys.readouterr().out.splitlines()
    granted, recovered = (float(dense.split(word)[1].split()[0]) for word in ("granted ", "recovered "))
    assert dense.split()[0] == "1:"  # every pair: the theorems speak
    assert 0.0 < granted < 1e-6 < recovered


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fold", "photographs"])
def test_pictures_of_the_docs_are_what_their_commands_draw(name, tmp_path):
    """Versions of a font differ by gray levels at the edges of letters."""
    figure.main([name, "--out", str(tmp_path / "made.png")])
    made, kept = (np.asarray(Image.open(path)) for path in (tmp_path / "made.png", DOCS / f"{name}.png"))
    assert made.shape == kept.shape
    assert np.abs(made.astype(float) - kept).mean() < 1.0


@pytest.mark.slow
def test_the_pictures_of_the_report_say_what_the_report_says_today(tmp_path, monkeypatch):
    scene = make_rendered_scene(SCENES["photographed"].scene, SCENES["photographed"].render)
    monkeypatch.chdir(tmp_path)
    images = Path("yard/images")
    images.mkdir(parents=True)
    for k, picture in enumerate(encode_images(scene), start=1):
        (images / f"{k:04d}.jpg").write_bytes(picture)
    shutil.copy(PHOTOGRAPHED / "database.db", "yard")
    run("map", "yard/database.db", "yard_mapped", "--images", images, code=0)
    report_picture.main(["yard_mapped", "made.png"])
    words = Image.open("made.png").text["words"]
    for name in ("report.png", "report_camera.png"):
        assert Image.open(DOCS / name).text["words"] == words
