"""scripts/benchmark.py answers: the same code gives equal recordings, and what differs is reported."""

import copy
import math

import pytest

from benchmarks import answers
from benchmarks.answer_cases import all_cases
from tests.scenes import ROOT

CASE = "solve/graph40/no-refine"


def changed(recorded, path, value):
    """Return a copy of a recording with one entry of the case's answer replaced."""
    found = copy.deepcopy(recorded)
    *parents, last = path
    place = found["answers"][CASE]
    for key in parents:
        place = place[key]
    place[last] = value
    return found


@pytest.mark.slow
def test_equal_code_gives_equal_answers_and_what_differs_is_reported(tmp_path):
    first, second = (answers.record(ROOT, tmp_path, only=CASE, quick=True) for _ in range(2))
    assert list(first["answers"]) == [CASE]
    assert first["answers"][CASE]["exit"] == 0
    answers._write(tmp_path / "a.json.gz", first)
    assert answers._read(tmp_path / "a.json.gz") == first
    text, is_equal = answers.compare_recordings(first, second)
    assert is_equal
    assert "worst of positions: 0.0e+00" in text
    assert "1 of 1 cases equal" in text

    x = first["answers"][CASE]["tables"]["cameras.csv"]["x"][4]
    place = ("tables", "cameras.csv", "x", 4)
    text, is_equal = answers.compare_recordings(first, changed(first, place, repr(float(x) + 1e-6)))
    assert not is_equal
    assert "tables cameras.csv positions 4 " in text
    assert "0 of 1 cases equal" in text
    assert answers.compare_recordings(first, changed(first, place, repr(math.nextafter(float(x), 9))))[1]

    verdicts = ("tables", "pairs.csv", "verdict", 0)
    assert "-> 'doubtful'" in answers.compare_recordings(first, changed(first, verdicts, "doubtful"))[0]
    assert "exit 0 -> 3" in answers.compare_recordings(first, changed(first, ("exit",), 3))[0]
    reworded = changed(first, ("json", "locate.json", "inputs", "directions"), "the directions are given")
    text, is_equal = answers.compare_recordings(first, reworded)
    assert is_equal
    assert "words (1):" in text


def test_names_of_cases_are_unique_and_missing_sets_are_skipped(tmp_path, capsys):
    cases = all_cases(answers._folders(tmp_path))
    names = [c.name for case in cases for c in (case, *case.followers)]
    assert len(set(names)) == len(names)
    with pytest.raises(SystemExit, match="has no package sfm_shapefit"):
        answers.record(tmp_path, tmp_path, only="locate/castle-P30/default")
    assert "castle-P30 is not at hand" in capsys.readouterr().err
