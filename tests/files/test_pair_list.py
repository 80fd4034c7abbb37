"""Lists of pairs to leave out: what is read, and how wrong lines are named."""

import pytest

from sfm_shapefit.base.errors import InputError
from sfm_shapefit.files.pair_list import read_pair_list

NAMES = ("a b.jpg", "c.jpg", "d.jpg")


def listed(tmp_path, text):
    path = tmp_path / "pairs.txt"
    path.write_text(text)
    return read_pair_list(path, NAMES)


@pytest.mark.parametrize(
    ("text", "pairs"),
    [
        ("# wrong\n\nd.jpg c.jpg\nc.jpg d.jpg 0.3\n", {("c.jpg", "d.jpg")}),
        (
            'name1,name2,vx\nc.jpg,d.jpg,1\n"a b.jpg", c.jpg\n',
            {("c.jpg", "d.jpg"), ("a b.jpg", "c.jpg")},
        ),
    ],
)
def test_words_and_columns_are_read(tmp_path, text, pairs):
    assert listed(tmp_path, text) == pairs


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("c.jpg d.jpg\nc.jpg x.jpg\n", "line 2: there is no image 'x.jpg'"),
        ("c.jpg\n", "line 1: expected the names of two images"),
        ("c.jpg c.jpg\n", "line 1: c.jpg makes no pair with itself"),
        ("# nothing\n", "lists no pair"),
    ],
)
def test_wrong_lists_are_refused_by_their_line(tmp_path, text, words):
    with pytest.raises(InputError, match=words):
        listed(tmp_path, text)
