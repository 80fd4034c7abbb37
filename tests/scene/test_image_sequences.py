"""Which images one device took, as their names say."""

import numpy as np

from sfm_shapefit.scene.sequences import find_sequences


def sequences(*names):
    return [[names[k] for k in rows.tolist()] for rows, _ in find_sequences(names)]


def test_frames_are_in_the_order_of_their_numbers_and_folders_apart():
    a, b = [f"left/img{k}.jpg" for k in (2, 10, 9)], [f"right/img{k}.jpg" for k in (1, 3)]
    assert sequences(*a, *b) == [[a[0], a[2], a[1]], b]


def test_time_stamps_are_one_sequence_and_collected_numbers_are_none():
    stamps = [f"IMG_20260209_1536{s:02}_468.jpg" for s in (51, 53, 58)]
    assert sequences(*stamps) == [stamps]
    assert sequences("00172642_6310427717.jpg", "00428654_11477382116.jpg", "00504662_7553416128.jpg") == []


def test_names_without_digits_or_of_very_many_are_no_trouble():
    assert sequences("a.jpg", "b.jpg", "noending", "") == []
    long = ["9" * 40 + f"{k}.png" for k in (3, 1, 2)]
    ((rows, numbers),) = find_sequences(long)
    assert rows.tolist() == [1, 2, 0]
    assert (np.diff(numbers) == 1).all()
