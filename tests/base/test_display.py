"""How results show themselves."""

from sfm_shapefit.base.display import NextStep


def test_a_step_has_quoted_folders_in_place_of_the_words_that_stand_for_them():
    step = NextStep("Next.", "sfm-shapefit workspace {out} {images} {out_dense}")
    there = step.at(out="a folder/{images}", images="it's")
    assert there.command == "sfm-shapefit workspace 'a folder/{images}' 'it'\"'\"'s' {out_dense}"
    assert there.text == step.text
