"""The images of a scene as arrays: through which lens each was taken, in which frame, and where that stands.

Every array of the package is over one of these spaces, and its comment names it by a letter:

    images i, frames f, lenses l, pairs p, edges e, nodes n, points x, observations o

An entry of one space that refers to another is a row of that one. Ids of COLMAP stand in `Images.ids`,
`Frames.ids`, `Lens.id` and `Points.ids`, nowhere else.

A frame is what moves: an image alone, or the images that a rig took at once. A point X of the world has, in
an image of frame f through lens l, the coordinates

    x = R_l R_f (X - C_f) + t_l,        (R_l, t_l) = sensor_from_rig of the lens, the identity of a reference.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, Int32Array, IntArray, frozen
from sfm_shapefit.base.geometry import Similarity
from sfm_shapefit.scene.lens import Lens


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frames:
    """Poses that move by themselves; arrays are read-only."""

    ids: IntArray
    """(f,) ascending."""
    rotations: FloatArray
    """(f, 3, 3) rig_from_world; NaN where unknown."""
    centers: FloatArray
    """(f, 3) origins in the world; NaN where unknown."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "ids", frozen(np.asarray(self.ids, dtype=np.int64)))
        object.__setattr__(self, "rotations", frozen(np.reshape(self.rotations, (-1, 3, 3))))
        object.__setattr__(self, "centers", frozen(np.reshape(self.centers, (-1, 3))))

    @property
    def is_posed(self) -> BoolArray:
        """Frames whose rotation and center are known, (f,)."""
        return np.asarray(
            np.isfinite(self.centers).all(axis=1) & np.isfinite(self.rotations).all(axis=(1, 2))
        )

    def part(self, frames: IntArray) -> "Frames":
        """Return some of the frames."""
        return Frames(ids=self.ids[frames], rotations=self.rotations[frames], centers=self.centers[frames])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sensors:
    """Where each lens is in its rig; arrays are read-only."""

    rotations: FloatArray
    """Rotations (l, 3, 3) of sensor_from_rig, exactly the identity for a reference; NaN where unknown."""
    translations: FloatArray
    """Translations (l, 3) of sensor_from_rig, exactly 0 for a reference; NaN where unknown."""
    rig_of: IntArray
    """(l,) number of the rig."""
    is_reference: BoolArray
    """(l,) lenses that stand at the origin of their rig."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "rotations", frozen(np.reshape(self.rotations, (-1, 3, 3))))
        object.__setattr__(self, "translations", frozen(np.reshape(self.translations, (-1, 3))))
        object.__setattr__(self, "rig_of", frozen(np.asarray(self.rig_of, dtype=np.int64)))
        object.__setattr__(self, "is_reference", frozen(np.asarray(self.is_reference, dtype=np.bool_)))

    @classmethod
    def references(cls, count: int) -> "Sensors":
        """Return so many lenses, each the reference of a rig of its own."""
        return cls(
            rotations=np.tile(np.eye(3), (count, 1, 1)),
            translations=np.zeros((count, 3)),
            rig_of=np.arange(count),
            is_reference=np.ones(count, dtype=np.bool_),
        )

    def part(self, lenses: IntArray) -> "Sensors":
        """Return those of some lenses, rigs renumbered."""
        return Sensors(
            rotations=self.rotations[lenses],
            translations=self.translations[lenses],
            rig_of=np.unique(self.rig_of[lenses], return_inverse=True)[1].ravel(),
            is_reference=self.is_reference[lenses],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Images:
    """All images of a scene, with a pose or without, in the order of their names; arrays are read-only."""

    names: tuple[str, ...]
    """(i,)"""
    ids: IntArray
    """(i,)"""
    frame_of: IntArray
    """(i,)"""
    lens_of: IntArray
    """(i,)"""
    frames: Frames
    """Frames of the images; each has at least one."""
    lenses: tuple[Lens, ...]
    """(l,) lenses of the images, ascending by id."""
    sensors: Sensors

    def __post_init__(self) -> None:
        for name in ("ids", "frame_of", "lens_of"):
            object.__setattr__(self, name, frozen(np.asarray(getattr(self, name), dtype=np.int64)))

    @classmethod
    def listed(
        cls,
        names: Sequence[str],
        poses: tuple[FloatArray, FloatArray],
        lens_of: Sequence[int],
        lenses: Sequence[Lens],
    ) -> "Images":
        """Return images in frames of their own, posed by rotations and centers (i, 3), with ids from 1 on."""
        ids = np.arange(1, len(names) + 1)
        return cls(
            names=tuple(names),
            ids=ids,
            frame_of=ids - 1,
            lens_of=np.array(lens_of, dtype=np.int64),
            frames=Frames(ids=ids, rotations=poses[0], centers=poses[1]),
            lenses=tuple(replace(lens, id=k) for k, lens in enumerate(lenses, start=1)),
            sensors=Sensors.references(len(lenses)),
        )

    @property
    def num_images(self) -> int:
        """Number of images, i."""
        return len(self.names)

    @property
    def rotations(self) -> FloatArray:
        """Rotations cam_from_world, (i, 3, 3); NaN where unknown."""
        return np.asarray(self.sensors.rotations[self.lens_of] @ self.frames.rotations[self.frame_of])

    @property
    def offsets(self) -> FloatArray:
        """Centers of images minus those of their frames, world axes, (i, 3); exactly 0 for a reference."""
        shifts = np.einsum("iba,ib->ia", self.rotations, self.sensors.translations[self.lens_of])
        return np.asarray(0.0 - shifts)

    @property
    def centers(self) -> FloatArray:
        """Centers of images in the world, (i, 3); NaN where unknown."""
        return np.asarray(self.frames.centers[self.frame_of] + self.offsets)

    @property
    def camera_ids(self) -> IntArray:
        """COLMAP's ids of the lenses that took the images, (i,)."""
        return np.array([lens.id for lens in self.lenses], dtype=np.int64)[self.lens_of]

    def names_of(self, rows: IntArray) -> tuple[str, ...]:
        """Return the names of some images, by their rows (k,)."""
        return tuple(self.names[k] for k in rows.tolist())

    def are_named(self, names: Collection[str]) -> BoolArray:
        """Return which images (i,) bear one of some names."""
        chosen = frozenset(names)
        return np.array([name in chosen for name in self.names], dtype=np.bool_)

    @property
    def focal_lengths_px(self) -> FloatArray:
        """Mean focal lengths, (i,); of a lens without one, pixels per radian."""
        return np.array([lens.focal_px for lens in self.lenses], dtype=np.float64)[self.lens_of]

    @property
    def are_angular(self) -> BoolArray:
        """Images in which the distance from the center grows with the angle, as of fisheyes, (i,)."""
        return np.array([lens.is_angular for lens in self.lenses], dtype=np.bool_)[self.lens_of]

    @property
    def focal_widths(self) -> FloatArray:
        """Mean focal lengths over the longer sides of the pictures, (i,); NaN where a size is not known."""
        return np.array([lens.focal_widths for lens in self.lenses], dtype=np.float64)[self.lens_of]

    def differ_in_rays(self, other: "Images") -> bool:
        """Return whether the rays of a lens differ by a hundredth between the same images."""
        return any(map(Lens.differs_in_rays, self.lenses, other.lenses))

    @property
    def sizes_px(self) -> FloatArray:
        """Widths and heights, (i, 2)."""
        sizes = [(lens.width, lens.height) for lens in self.lenses]
        return np.array(sizes, dtype=np.float64)[self.lens_of]

    @property
    def is_posed(self) -> BoolArray:
        """Images whose frame has a pose, (i,)."""
        return self.frames.is_posed[self.frame_of]

    @property
    def posed_rows(self) -> IntArray:
        """Images with a pose in the order of their ids, that of the sums of an adjustment, (r,)."""
        rows = np.flatnonzero(self.is_posed)
        return rows[np.argsort(self.ids[rows])]

    @property
    def has_rigs(self) -> bool:
        """Whether any frame has several images."""
        return len(self.frames.ids) < self.num_images

    def part(self, images: IntArray) -> "Images":
        """Return some of the images, ascending, with the frames and lenses of these; all are renumbered."""
        frames, frame_of = np.unique(self.frame_of[images], return_inverse=True)
        lenses, lens_of = np.unique(self.lens_of[images], return_inverse=True)
        return Images(
            names=self.names_of(images),
            ids=self.ids[images],
            frame_of=frame_of.ravel(),
            lens_of=lens_of.ravel(),
            frames=self.frames.part(frames),
            lenses=tuple(self.lenses[k] for k in lenses.tolist()),
            sensors=self.sensors.part(lenses),
        )

    def posed(self, rotations: FloatArray, centers: FloatArray) -> "Images":
        """Return the images with their frames at other rotations (f, 3, 3) and centers (f, 3)."""
        return replace(self, frames=replace(self.frames, rotations=rotations, centers=centers))

    def placed(self, rows: IntArray, centers: FloatArray) -> "Images":
        """Return the images with some of them (k,) at centers (k, 3), rotations as they are.

        Others of a frame move along with its first one; frames without any become NaN.
        """
        frames, first = np.unique(self.frame_of[rows], return_index=True)
        moved = np.full_like(self.frames.centers, np.nan)
        moved[frames] = (centers - self.offsets[rows])[first]
        return self.posed(self.frames.rotations, moved)

    def transformed(self, motion: Similarity, fixed: BoolArray) -> "Images":
        """Return the images after a similarity of the world, with their sensors; `fixed` frames (f,) stay."""
        frames = self.frames
        rotations = np.where(fixed[:, None, None], frames.rotations, frames.rotations @ motion.rotation.T)
        centers = np.where(fixed[:, None], frames.centers, motion.apply(frames.centers))
        sensors = self.sensors
        return self.posed(rotations, centers).with_sensors(
            sensors.rotations, motion.scale * sensors.translations
        )

    def without(self, gone: BoolArray) -> "Images":
        """Return the images with the frames of some (i,) not placed."""
        centers = self.frames.centers.copy()
        centers[self.frame_of[gone]] = np.nan
        return self.posed(self.frames.rotations, centers)

    def updated(self, part: "Images") -> "Images":
        """Return the images with frames, lenses and sensors as a part of them has them now."""
        rows, own = np.searchsorted(self.frames.ids, part.frames.ids), self.lenses_of(part)
        frames, sensors = self.frames, self.sensors
        moved = [frames.rotations.copy(), frames.centers.copy()]
        turned = [sensors.rotations.copy(), sensors.translations.copy()]
        moved[0][rows], moved[1][rows] = part.frames.rotations, part.frames.centers
        turned[0][own], turned[1][own] = part.sensors.rotations, part.sensors.translations
        return self.posed(*moved).with_sensors(*turned).with_lenses_of(part, np.ones(len(own), np.bool_))

    def turned(self, part: "Images") -> "Images":
        """Return the images with rotations, lenses and sensors of a part of them; frames stay in place."""
        rows = np.searchsorted(self.frames.ids, part.frames.ids)
        return self.updated(part.posed(part.frames.rotations, self.frames.centers[rows]))

    def apart(self) -> "Images":
        """Return the images each in a frame of its own, at the origin, in axes of its camera."""
        ids, frame_of = np.unique(self.ids, return_inverse=True)
        turns, places = np.tile(np.eye(3), (len(ids), 1, 1)), np.zeros((len(ids), 3))
        frames = Frames(ids=ids, rotations=turns, centers=places)
        sensors = Sensors.references(len(self.lenses))
        return replace(self, frame_of=frame_of.ravel(), frames=frames, sensors=sensors)

    def turned_to(self, rotations: FloatArray) -> "Images":
        """Return the images with rotations (i, 3, 3) cam_from_world, all frames at the origin.

        A frame turns with its first image.
        """
        _, first = np.unique(self.frame_of, return_index=True)
        sensors = self.sensors.rotations[self.lens_of[first]]
        turns = sensors.transpose(0, 2, 1) @ rotations[first]
        return self.posed(turns, np.zeros((len(first), 3)))

    def lenses_of(self, part: "Images") -> IntArray:
        """Return which lenses those of a part of the images are, rows (l,)."""
        return np.searchsorted([lens.id for lens in self.lenses], [lens.id for lens in part.lenses])

    def with_lenses_of(self, part: "Images", chosen: BoolArray) -> "Images":
        """Return the images with the `chosen` lenses (l,) of a part of them."""
        lenses, rows = list(self.lenses), self.lenses_of(part).tolist()
        for k in np.flatnonzero(chosen).tolist():
            lenses[rows[k]] = part.lenses[k]
        return self.with_lenses(lenses)

    def with_lenses(self, lenses: Sequence[Lens]) -> "Images":
        """Return the images with other parameters of their lenses."""
        return replace(self, lenses=tuple(lenses))

    def with_sensors_of(self, part: "Images") -> "Images":
        """Return the images with their sensors where a part of them has them."""
        return self.updated(part).posed(self.frames.rotations, self.frames.centers).with_lenses(self.lenses)

    def with_sensors(self, rotations: FloatArray, translations: FloatArray) -> "Images":
        """Return the images with other poses of their sensors, (l, 3, 3) and (l, 3)."""
        return replace(self, sensors=replace(self.sensors, rotations=rotations, translations=translations))


class KeypointRays(Protocol):
    """The keypoints of images and what their lenses do with rays, by the images' rows."""

    def count(self, image: int) -> int:
        """Return how many keypoints an image has."""
        ...

    def pixels(self, image: int, keypoints: IntArray | Int32Array) -> FloatArray:
        """Return where keypoints are, (k, 2)."""
        ...

    def rays(self, image: int, pixels: FloatArray) -> FloatArray:
        """Return rays (k, 3) of pixels, of any length; NaN where there is none."""
        ...

    def project(self, image: int, positions: FloatArray, *, ahead: bool = True) -> FloatArray:
        """Return the pixels (k, 2) of points (k, 3) in axes of the camera.

        NaN for those that it does not see; not `ahead`: where the formula of the lens leads, even behind it.
        """
        ...
