"""What all benchmarks share: limits and numbers, tables, fresh processes, the driver."""

import argparse
import itertools
import math
import os
import time
from functools import partial

import numpy as np
import pytest

from harness import driver, process, record
from harness.driver import Benchmark, Kept
from harness.graphs import relative_error
from harness.record import Check, Row, at_least, at_most, exponent, number, ratio, text_of, times, verdict


@pytest.mark.parametrize(
    ("value", "better", "met"),
    [
        (0.025, "lower", True),
        (0.025 * (1 + 1e-9), "lower", False),  # prints as 0.0250, and is above it nevertheless
        (0.025 * (1 - 1e-9), "lower", True),
        (0.026, "higher", True),
        (0.024, "higher", False),
        (math.nan, "lower", False),
        (-math.inf, "lower", False),
        (math.inf, "higher", False),
    ],
)
def test_a_limit_is_met_by_the_unrounded_finite_value_only(value, better, met):
    assert Check(name="median", value=value, limit=0.025, better=better).met is met


def test_a_verdict_names_every_limit_that_is_missed_and_no_other():
    checks = [
        Check(name="median", value=0.03, limit=0.025),
        Check(name="mean", value=0.02, limit=0.026),
        Check(name="max", value=math.nan, limit=1.0),
    ]
    assert verdict(checks) == "**missed**: median 0.0300 > 0.0250, max - > 1.00"
    assert verdict(checks[1:2]) == "met"
    assert verdict([]) == "-"
    assert Check("median", 1.0, 2.0).goal == "median up to 2.00"


def test_limits_that_are_none_are_no_limits():
    assert [check.name for check in at_most(CPU_s=(1.0, 2.0), MB=(1.0, None))] == ["CPU s"]
    assert at_least(placed=(9, 11)) == [Check("placed", 9, 11, "higher")]


@pytest.mark.parametrize("bad", [(1.0, 0.0), (1.0, -2.0), (math.nan, 1.0), (1.0, math.nan), (math.inf, 1.0)])
def test_a_ratio_is_the_value_over_the_reference_or_a_dash(bad):
    assert math.isnan(ratio(*bad))
    assert times(ratio(*bad)) == "-"
    assert ratio(3.0, 2.0) == 1.5
    assert [times(value) for value in (0.156, 1.5, 9.96, 21.4)] == ["0.16x", "1.5x", "10x", "21x"]


def test_numbers_have_three_significant_digits():
    values = (0.0, 0.00226, 0.03, 7.28, 447.2, 12345.6, 3e-11, 2e7, -0.5, math.inf)
    expected = "0 0.00226 0.0300 7.28 447 12346 3.0e-11 2.0e+07 -0.500 -"
    assert " ".join(map(number, values)) == expected
    assert [text_of(one) for one in (None, "a", True, 3, 0.5, [0.5, 2])] == [
        *"-a",
        "yes",
        "3",
        "0.500",
        "0.500 / 2",
    ]
    sizes = [1e3, 1e4, 1e5]
    assert exponent(sizes, [2e-4 * n**1.3 for n in sizes]) == pytest.approx(1.3)
    assert math.isnan(exponent([1e3], [1.0]))
    assert math.isnan(exponent([1e3, 1e4], [1.0, math.nan]))


def test_a_table_has_a_line_per_row_and_the_processor_is_named_by_its_model(tmp_path):
    assert record.table(["a", "b"], [["1", "2|3"]]) == "| a | b |\n| --- | --- |\n| 1 | 2/3 |\n"
    with pytest.raises(ValueError, match="another number of cells than the header: a, b"):
        record.table(["a", "b"], [["1"]])
    (tmp_path / "cpuinfo").write_text("processor : 0\nmodel name\t: Some CPU @ 2 GHz\nmodel name\t: other\n")
    assert record.cpu_model(tmp_path / "cpuinfo") == "Some CPU @ 2 GHz"
    assert record.cpu_model(tmp_path / "missing")


def test_the_error_knows_the_gauge():
    rng = np.random.default_rng(5)
    t = rng.standard_normal((9, 3))
    assert relative_error(3.0 * t + 7.0, t) < 1e-14  # rounding
    assert relative_error(-t, t) == pytest.approx(2.0)


def test_a_fresh_process_has_the_threads_that_were_asked_for_and_its_failure_is_one_sentence():
    before = dict(os.environ)
    assert process.call(os.getenv, "OPENBLAS_NUM_THREADS", environment=process.thread_environment(3)) == "3"
    assert dict(os.environ) == before
    with pytest.raises(RuntimeError, match=r"^ValueError: .*literal"):
        process.call(int, "x")
    with pytest.raises(RuntimeError, match="ended with code 7 and no answer"):
        process.call(os._exit, 7)


def test_a_process_that_takes_too_long_is_ended():
    with pytest.raises(TimeoutError, match=r"no answer within 0\.1 s"):
        process.call(time.sleep, 60.0, timeout_s=0.1)
    with pytest.raises(TimeoutError, match="no answer within 1 s of CPU time"):
        process.call(sum, itertools.repeat(0), cpu_limit_s=1)


def fail():
    raise ValueError("no luck")


def measure(value):
    return Row({"value": float(value), "name": "n"}, at_most(value=(value, 2.0)), "Values")


BENCHMARK = Benchmark(
    name="made",
    title="Made",
    cases=lambda args: {
        "one": partial(measure, args.repeats),
        "two": fail,
        "three": "it is not there",
    },
    columns={"value": "1; what it is"},
    notes={"Values": "Before the table."},
    packages=("numpy",),
    quick={"repeats": 2},
)


def parse(*words):
    parser = argparse.ArgumentParser()
    BENCHMARK.add_arguments(parser)
    return parser.parse_args([*map(str, words)])


def test_a_section_says_what_was_measured_by_which_command_and_what_was_not_and_why(tmp_path, capsys):
    out = tmp_path / "made.md"
    assert BENCHMARK.run(parse("--out", out, "--repeats", 3)) == 0
    text = out.read_text()
    assert text.startswith("# Made\n\n- Command: `python scripts/benchmark.py made --repeats 3`\n")
    assert "**0 of 1 limits met.**" in text
    assert "## Values\n\nBefore the table.\n\n| value | name | to reach | verdict |" in text
    assert "| 3.00 | n | value up to 2.00 | **missed**: value 3.00 > 2.00 |" in text
    assert "Not measured: two: failed: ValueError: no luck; three: it is not there." in text
    assert "| value | 1; what it is |" in text
    assert str(tmp_path) not in text
    assert "two: failed: ValueError: no luck" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["made.md"]


def test_the_quick_version_is_recorded_as_such_and_where_nothing_is_measured_nothing_is_written(
    tmp_path, capsys
):
    args = parse("--quick")
    vars(args).update(BENCHMARK.quick)
    assert BENCHMARK.command_line(args) == "python scripts/benchmark.py made --quick"
    assert BENCHMARK.run(parse("--out", tmp_path / "made.md", "--only", "three")) == 0
    assert capsys.readouterr().err == "three: it is not there\n"
    assert list(tmp_path.iterdir()) == []


def test_cases_are_chosen_by_the_beginning_of_their_names():
    cases = {"seq-300": "a", "seq-300 exact": "b", "er2": "c"}
    assert list(driver.choose(cases, ["seq-300"])) == ["seq-300", "seq-300 exact"]
    assert list(driver.choose(cases, [])) == list(cases)
    with pytest.raises(SystemExit, match="no case begins with x; known: seq-300; seq-300 exact; er2"):
        driver.choose(cases, ["er2", "x"])


def test_answers_of_an_interrupted_run_are_kept_and_not_asked_again(tmp_path):
    file, asked = tmp_path / "kept", []
    first = Kept(file, {"limit": 1})
    first.get("one", lambda: asked.append(1) or 2.5)
    again = Kept(file, {"limit": 1})
    assert again.get("one", lambda: asked.append(2)) == 2.5
    assert asked == [1]
    with pytest.raises(ValueError, match="other settings; delete it or give another --cache"):
        Kept(file, {"limit": 2})
