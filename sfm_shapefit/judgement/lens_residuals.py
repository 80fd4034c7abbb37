"""Residuals of each lens, averaged over parts of its picture: whether the lens model fits.

A residual leads from where the camera projects a 3D point to where its image has it, in pixels. Through a
lens model that fits, residuals at one place of the picture differ from image to image. What they have in
common is a pattern, and comes from the lens. Whether that is more than chance is asked of random signs: if
images share nothing, the residuals of each could as well be the opposite ones (Fisher's sign-flip test).

Where they point along the radius, the distortion is missing or wrong, and poses have bent to that. A model is
to be looked at if they do so by more than a quarter of a pixel in a ring of the picture. Sound models of 14
scenes reach 0.18 px, and models without the distortion of their lens 0.35 px where that turned cameras by 18
degrees.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.judgement.evidence import LensField, OddImages
from sfm_shapefit.judgement.reasons import Kind
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.structure import Structure
from sfm_shapefit.tracks.filter import keypoint_offsets_px

_MOST_FIELDS = 4  # lenses that are shown; those with most images say most
_MOST_IMAGES = 150  # images of a lens that are asked, evenly picked; more cost time and add no digit
_FEWEST_RESIDUALS = 300  # residuals of a lens; fewer show nothing over a whole picture
_FEWEST_IMAGES = 9  # images of a lens; the signs of fewer have no 1 / _CHANCE combinations
_IN_A_CELL = 30  # residuals in a cell of the picture, on average; their mean is five times as exact as one
_SIDE = (4, 16)  # limits of the number of cells along the longer side; more arrows hide one another
_FEWEST_DRAWN = 15  # residuals in a cell; the mean of fewer is noise
_LARGE = 3.0  # median lengths; longer residuals, as of wrong matches, count as of this length
_FLIPS = 999  # draws of signs; the smallest probability that they can show is a thousandth
_CHANCE = 0.005  # probability of as much of a pattern by chance; a page shows a few lenses, not hundreds
_OF_NOTE = 0.05  # share of the squared residuals; what a smaller pattern adds to their RMS is below 3 %
_BENDS_PX = 0.25  # pixels along the radius; see the header
_RINGS = 5  # rings about the principal point, of as many residuals each; a profile may change its sign


class _Residuals(NamedTuple):
    """The r residuals of a lens, of g images."""

    images: IntArray
    """(r,) from 0 to g - 1."""
    places: FloatArray
    """(r, 2) where in the picture, as shares of width and height."""
    arms: FloatArray
    """(r, 2) pixels from the principal point."""
    offsets_px: FloatArray
    """(r, 2)"""

    def taken(self, chosen: IntArray | BoolArray) -> "_Residuals":
        images, places, arms, offsets_px = self
        return _Residuals(images[chosen], places[chosen], arms[chosen], offsets_px[chosen])


def lens_fields(structure: Structure) -> tuple[LensField, ...]:
    """Return the mean residuals of the lenses with most images, of those that have enough residuals.

    Lenses of a few images each, as in a collection from many devices, are taken together by their model.
    """
    images, rows_of = structure.images, structure.rows_of_images
    seeing = images.is_posed & (rows_of.lengths() > 0)
    groups = _by_lens(images, np.flatnonzero(seeing if structure.among is None else seeing & structure.among))
    found = []
    for label, members in sorted(groups.items(), key=lambda group: -len(group[1]))[:_MOST_FIELDS]:
        chosen = members[:: -(-len(members) // _MOST_IMAGES)]
        residuals = _residuals_of(structure, np.array(chosen))
        if len(residuals.images) >= _FEWEST_RESIDUALS:
            width, height = images.sizes_px[members[0]].tolist()
            field = _average(label, width / height, _without_large(residuals))
            found.append(field._replace(images=np.array(members)))
    return tuple(found)


def find_bent_lenses(fields: Sequence[LensField], names: Sequence[str]) -> Iterator[OddImages]:
    """Yield the images of lenses whose residuals point along the radius, so that poses may have bent.

    The `names` are those of all images.
    """
    for field in fields:
        if abs(field.outward_px) > _BENDS_PX:
            side = "outward" if field.outward_px > 0.0 else "inward"
            sentence = (
                f"a lens that does not fit: residuals point {side} by {{}} px in a ring of its picture, and "
                "poses bend to that; --intrinsics all refines distortion, OPENCV and OPENCV_FISHEYE have more"
            )
            bent = tuple(names[k] for k in field.images.tolist())
            yield OddImages.of_values(Kind.LENS, bent, np.full(len(bent), abs(field.outward_px)), sentence)


def _by_lens(images: Images, chosen: IntArray) -> dict[str, list[int]]:
    """Return some images by what is said of their lens."""
    counts = np.bincount(images.lens_of[chosen], minlength=len(images.lenses)).tolist()
    groups: dict[str, list[int]] = {}
    for image, row in zip(chosen.tolist(), images.lens_of[chosen].tolist(), strict=True):
        lens, is_alone = images.lenses[row], counts[row] >= _FEWEST_IMAGES or len(images.lenses) == 1
        label = f"Camera {lens.id}, {lens.model}" if is_alone else f"Cameras of few images, {lens.model}"
        groups.setdefault(label, []).append(image)
    return groups


def _residuals_of(structure: Structure, chosen: IntArray) -> _Residuals:
    """Return the residuals of chosen images."""
    lenses, lens_of = structure.images.lenses, structure.images.lens_of[chosen]
    observed, sizes = structure.rows_of_images.subset(chosen), structure.images.sizes_px[chosen]
    middles = [
        np.array([lens.width, lens.height]) / 2.0 if lens.is_panorama else lens.split_parameters()[1]
        for lens in lenses
    ]
    offsets_px = np.concatenate([found for _, found in keypoint_offsets_px(structure, chosen)])
    pixels = structure.pixels[observed.rows]
    every = _Residuals(
        observed.list_of_rows(),
        pixels / observed.spread(np.maximum(sizes, 1)),
        pixels - observed.spread(np.array([middles[lens] for lens in lens_of.tolist()])),
        -offsets_px,
    )
    return every.taken(np.isfinite(offsets_px).all(axis=1) & observed.spread(np.asarray(sizes.all(axis=1))))


def _without_large(residuals: _Residuals) -> _Residuals:
    """Return the residuals, large ones made shorter."""
    lengths = np.linalg.norm(residuals.offsets_px, axis=1)
    factors = np.minimum(_LARGE * np.median(lengths) / np.maximum(lengths, np.finfo(float).tiny), 1.0)
    return residuals._replace(offsets_px=residuals.offsets_px * factors[:, None])


def _average(label: str, aspect: float, residuals: _Residuals) -> LensField:
    """Return the mean residuals over cells that are about square, and what they say."""
    side = np.sqrt(len(residuals.images) / _IN_A_CELL * max(aspect, 1.0 / aspect))
    along = int(np.clip(round(side), *_SIDE))
    columns, rows = (
        (along, max(round(along / aspect), 1)) if aspect >= 1 else (max(round(along * aspect), 1), along)
    )
    grid = np.clip(residuals.places * [columns, rows], 0, [columns - 1, rows - 1]).astype(np.int64)
    cells, of_cell = np.unique(grid @ [1, columns], return_inverse=True)
    cell_sums = _sums(of_cell, residuals.offsets_px, len(cells))
    counts = np.bincount(of_cell, minlength=len(cells))
    drawn, (statement, outward_px) = counts >= _FEWEST_DRAWN, _judge(residuals, of_cell)
    middles = (np.stack([cells % columns, cells // columns], axis=1) + 0.5) / [columns, rows]
    means_px = (cell_sums / counts[:, None])[drawn]
    return LensField(label, aspect, middles[drawn], means_px, statement, np.empty(0, np.int64), outward_px)


def _judge(residuals: _Residuals, of_cell: IntArray) -> tuple[str, float]:
    """Return what residuals say of the lens, by the cells that they are in, and `LensField.outward_px`."""
    typical = float(np.sqrt(np.mean(np.sum(residuals.offsets_px**2, axis=1))))
    num_images, num_cells = int(residuals.images.max()) + 1, int(of_cell.max()) + 1
    if num_images < _FEWEST_IMAGES:
        return f"{num_images} images are too few to tell a pattern from chance.", 0.0
    place = residuals.images * num_cells + of_cell
    sums = _sums(place, residuals.offsets_px, num_images * num_cells).reshape(num_images, num_cells, 2)
    counts = np.bincount(place, minlength=num_images * num_cells).reshape(num_images, num_cells)
    in_cell = counts.sum(axis=0)
    scaled = (sums / np.sqrt(in_cell)[:, None]).reshape(num_images, -1)
    shared = np.einsum("ia,ja->ij", scaled, scaled)  # what two images have in common
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (_FLIPS, num_images))
    by_chance = np.einsum("fj,fj->f", np.einsum("fi,ij->fj", signs, shared), signs)
    chance = np.mean(np.append(by_chance, np.inf) >= (1.0 - 1e-9) * shared.sum())
    # What an image has in common with itself is no pattern.
    pattern = (shared.sum() - np.trace(shared)) / np.sum(in_cell - np.sum(counts**2, axis=0) / in_cell)
    if chance > _CHANCE or pattern <= 0.0:
        return "No pattern: residuals point everywhere. The lens model fits.", 0.0
    size, rings = float(np.sqrt(pattern)), _radial(residuals, of_cell)
    ring = int(np.argmax(np.abs(rings)))
    is_radial = np.mean(rings**2) >= 0.5 * pattern
    if (max(pattern, rings[ring] ** 2) if is_radial else pattern) < _OF_NOTE * typical**2:
        return f"A pattern of {size:.2g} px beside residuals of {typical:.2g} px: too small to matter.", 0.0
    if not is_radial:
        return (
            f"A pattern of {size:.2g} px beside residuals of {typical:.2g} px, not along the radius: as of a "
            "decentered lens, a rolling shutter, or wrong cameras."
        ), 0.0
    where = ["in the middle", *["halfway to the rim"] * (_RINGS - 2), "at the rim"]
    side = "outward" if rings[ring] > 0.0 else "inward"
    return (
        f"They point {side} {where[ring]}, by {abs(rings[ring]):.2g} px: the lens model is too simple, or "
        "its distortion is wrong. --intrinsics all refines it; OPENCV and OPENCV_FISHEYE can bend more."
    ), float(rings[ring])


def _radial(residuals: _Residuals, of_cell: IntArray) -> FloatArray:
    """Return the mean outward part of residuals in rings about the principal point, the innermost first."""
    num_cells = int(of_cell.max()) + 1
    arms, sums = (_sums(of_cell, values, num_cells) for values in (residuals.arms, residuals.offsets_px))
    in_cell, lengths = np.bincount(of_cell, minlength=num_cells), np.linalg.norm(arms, axis=1)
    outward = np.einsum("ca,ca->c", arms, sums) / np.maximum(lengths, np.finfo(float).tiny)
    order = np.argsort(lengths / in_cell, kind="stable")
    before = np.cumsum(in_cell[order]) - in_cell[order]
    ring = np.minimum(_RINGS * before // in_cell.sum(), _RINGS - 1)
    return np.bincount(ring, outward[order], _RINGS) / np.maximum(
        np.bincount(ring, in_cell[order], _RINGS), 1.0
    )


def _sums(labels: IntArray, values: FloatArray, count: int) -> FloatArray:
    """Return the sums of values (r, 2) by their labels, (count, 2)."""
    return np.stack([np.bincount(labels, column, count) for column in values.T], axis=1)
