"""Images as arrays: parts of parts, poses put in and read out, what follows from frames and sensors."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sfm_shapefit.scene.images import Frames, Images, Sensors
from sfm_shapefit.scene.lens import Lens


@st.composite
def scenes(draw):
    """Images of up to three rigs of up to three lenses; some frames are not posed."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    sizes = draw(st.lists(st.integers(1, 3), min_size=1, max_size=3))
    rig_of = np.repeat(np.arange(len(sizes)), sizes)
    is_reference = np.diff(rig_of, prepend=-1) > 0
    taken = [
        (rig, lens)
        for rig in draw(st.lists(st.integers(0, len(sizes) - 1), min_size=1, max_size=5))
        for lens in [np.flatnonzero(rig_of == rig)]
    ]
    ends = [(f, k) for f, (_, lenses) in enumerate(taken) for k in lenses.tolist()]
    order = rng.permutation(len(ends))
    frame_of, lens_of = np.array(ends)[order].T
    used, lens_of = np.unique(lens_of, return_inverse=True)
    turns, n = Rotation.random(len(rig_of), rng).as_matrix(), len(taken)
    turns[is_reference] = np.eye(3)
    shifts = np.where(is_reference[:, None], 0.0, rng.standard_normal((len(rig_of), 3)))
    unposed = rng.random(n) < 0.2
    return Images(
        names=tuple(f"{k:03}.jpg" for k in range(len(ends))),
        ids=rng.permutation(100)[: len(ends)],
        frame_of=frame_of,
        lens_of=lens_of,
        frames=Frames(
            ids=np.sort(rng.permutation(50)[:n]),
            rotations=np.where(unposed[:, None, None], np.nan, Rotation.random(n, rng).as_matrix()),
            centers=np.where(unposed[:, None], np.nan, rng.standard_normal((n, 3))),
        ),
        lenses=tuple(Lens("SIMPLE_PINHOLE", (500.0 + k, 320.0, 240.0), id=k) for k in used.tolist()),
        sensors=Sensors(
            rotations=turns[used],
            translations=shifts[used],
            rig_of=rig_of[used],
            is_reference=is_reference[used],
        ),
    )


def values_of(images):
    """All that the images are, without the numbers of frames, lenses and rigs."""
    return {
        name: (
            images.ids[k],
            images.frames.ids[images.frame_of[k]],
            images.lenses[images.lens_of[k]],
            images.rotations[k].tobytes(),
            images.centers[k].tobytes(),
            images.offsets[k].tobytes(),
            images.focal_lengths_px[k],
            images.is_posed[k],
        )
        for k, name in enumerate(images.names)
    }


def chosen_of(data, count):
    rows = data.draw(st.sets(st.integers(0, count - 1), min_size=1))
    return np.array(sorted(rows))


@given(scenes(), st.data())
def test_a_part_of_a_part_is_a_part_and_nothing_in_it_changes(images, data):
    first = chosen_of(data, images.num_images)
    second = chosen_of(data, len(first))
    twice, once = images.part(first).part(second), images.part(first[second])
    assert values_of(twice) == values_of(once)
    assert values_of(once).items() <= values_of(images).items()
    for one in (twice, once):
        assert np.unique(one.frame_of).tolist() == list(range(len(one.frames.ids)))
        assert np.unique(one.lens_of).tolist() == list(range(len(one.lenses)))
    np.testing.assert_array_equal(twice.sensors.rig_of, once.sensors.rig_of)
    assert values_of(images.part(np.arange(images.num_images))) == values_of(images)


@given(scenes(), st.data())
def test_parts_are_posed_as_the_whole_is(images, data):
    rng = np.random.default_rng(0)
    rotations = Rotation.random(len(images.frames.ids), rng).as_matrix()
    centers = rng.standard_normal((len(rotations), 3))
    rows = chosen_of(data, images.num_images)
    frames = np.unique(images.frame_of[rows])
    there, again = (
        images.posed(rotations, centers),
        images.posed(images.frames.rotations, images.frames.centers),
    )
    assert values_of(again) == values_of(images)
    assert there.is_posed.all()
    part = images.part(rows).posed(rotations[frames], centers[frames])
    assert values_of(part) == values_of(there.part(rows))
    back = there.posed(images.frames.rotations, images.frames.centers)
    assert values_of(back) == values_of(images)


@given(scenes(), st.data())
def test_the_first_image_of_a_frame_places_it_and_frames_without_one_are_gone(images, data):
    rows, rng = chosen_of(data, images.num_images), np.random.default_rng(0)
    images = images.posed(
        Rotation.random(len(images.frames.ids), rng).as_matrix(), np.zeros_like(images.frames.centers)
    )
    centers = rng.standard_normal((len(rows), 3))
    found = images.placed(rows, centers)
    frames = images.frame_of[rows]
    is_first = [frame not in frames[:k] for k, frame in enumerate(frames)]
    np.testing.assert_allclose(found.centers[rows[is_first]], centers[is_first], atol=1e-12)
    np.testing.assert_array_equal(found.is_posed, np.isin(images.frame_of, frames))
    np.testing.assert_array_equal(found.rotations, images.rotations)


@given(scenes())
def test_images_stand_where_frames_and_sensors_put_them(images):
    sensors, frames = images.sensors, images.frames
    for k in range(images.num_images):
        lens, frame = images.lens_of[k], images.frame_of[k]
        origin = images.rotations[k] @ (frames.centers[frame] - images.centers[k])
        if images.is_posed[k]:
            np.testing.assert_allclose(origin, sensors.translations[lens], atol=1e-12)
        if sensors.is_reference[lens]:
            assert images.rotations[k].tobytes() == frames.rotations[frame].tobytes()
            assert not images.is_posed[k] or not images.offsets[k].any()
    assert images.has_rigs == (np.bincount(images.frame_of).max() > 1)


@given(images=scenes(), data=st.data())
def test_images_differ_in_rays_where_any_of_their_lenses_does(images, data):
    k = data.draw(st.integers(0, len(images.lenses) - 1))
    lenses, (focal_px, *center) = list(images.lenses), images.lenses[k].parameters
    for factor, differs in ((1.0001, False), (1.2, True)):
        lenses[k] = replace(lenses[k], parameters=(factor * focal_px, *center))
        assert images.differ_in_rays(images.with_lenses(lenses)) is differs


def test_arrays_are_read_only():
    frames = Frames(ids=np.arange(1), rotations=np.eye(3)[None], centers=np.zeros((1, 3)))
    for array in (frames.ids, frames.rotations, frames.centers):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
