"""`workspace`: pictures and model without distortion, in the folders that splatting and dense programs read.

OUT/images/              pictures, all in one folder: that of a/b.jpg is a_b.jpg
OUT/masks/               their masks, NAME.png for NAME, if there are any: brush, LichtFeld, COLMAP's fusion
OUT/sparse/0/            the model, and its points as points3D.ply: 3DGS, gsplat, brush, LichtFeld
OUT/sparse/, OUT/stereo/ the model again and the plan of the stereo: COLMAP's dense commands, OpenMVS
OUT/transforms.json      cameras, and the names of points and masks: nerfstudio
OUT/offset.xyz           what was subtracted from the coordinates in all of these, if anything was
"""

import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.atomic_folder import atomic_folder
from sfm_shapefit.base.clock import Clock, Progress
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import Similarity, angle_between_deg
from sfm_shapefit.base.paths import MASKS, refuse_no_folder
from sfm_shapefit.base.settings import merge_options
from sfm_shapefit.base.wording import counted, counted_are, first_of
from sfm_shapefit.facts.tables import model_datum, model_doubt
from sfm_shapefit.files.colmap.listed_poses import read_by_itself
from sfm_shapefit.files.colmap.model import ColmapModel, ModelSource, model_of, read_model
from sfm_shapefit.files.colmap.picture_colors import PictureFolder, color_model
from sfm_shapefit.files.colmap.pinholes import Flat, flats_of, flatten_model, mask_of, write_flats
from sfm_shapefit.files.colmap.reconstructions import transform_model
from sfm_shapefit.files.colmap.seed import pick_points, write_model
from sfm_shapefit.files.colmap.world import float32_world
from sfm_shapefit.files.undistortion_options import UndistortionOptions
from sfm_shapefit.report.mesh import nerf_files
from sfm_shapefit.rotations.gravity import DOWN, turn_upright
from sfm_shapefit.scene.level import find_up

if TYPE_CHECKING:
    import pycolmap

_LEVEL_DEG = 5.0  # degrees; a model whose z axis is no farther from up has it from GPS, gravity or its maker
_ROUGH_DEG = 3.0  # degrees, standard deviation; ground that is tilted by more is seen to be
_PARTNERS = 20  # images that the stereo of one looks at; COLMAP's undistorter says as many
_MOST_POINTS = 3000  # points that are asked where the ground is; more say the same
_POINTS = "points3D.ply"
_STEREO = ("depth_maps", "normal_maps", "consistency_graphs")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Workspace:
    """What was written."""

    folder: Path
    reconstruction: "pycolmap.Reconstruction"
    """The model of the pictures."""
    level: str
    """How it was leveled, and how surely, or why not."""
    offset: tuple[float, float, float]
    """What was subtracted from all coordinates, after leveling."""
    warnings: tuple[str, ...]
    """The verdict on the model where it is not good, and images that are left out, and why."""
    renamed: dict[str, str]
    """By the names of images in folders: those of their pictures, which are in one folder."""

    @property
    def told(self) -> list[str]:
        """What the terminal says, in lines."""
        model = self.reconstruction
        counts = f"{counted(model.num_reg_images(), 'picture')}, {counted(model.num_points3D(), 'point')}"
        warnings = [f"warning: {one}" for one in self.warnings]
        renamed = [f"{old} becomes images/{new}" for old, new in self.renamed.items()]
        names = [f"pictures: {first_of(renamed)}"] if renamed else []
        offset = "offset: {!r} {!r} {!r}, subtracted from all coordinates".format(*self.offset)
        shifted = [f"{offset}, see offset.xyz"] if any(self.offset) else []
        level = f"level: {self.level}"
        return [counts, *names, level, *shifted, *warnings, f"written to {self.folder}/"]


def workspace(
    model: ModelSource,
    images: Path | str,
    out: Path | str,
    *,
    options: UndistortionOptions | None = None,
    progress: Progress | None = None,
    **overrides: Any,
) -> Workspace:
    """Write pictures and model without distortion for splatting and dense reconstruction.

        sfm_shapefit.workspace("mapped/0", "images", "dense", mask_path="masks", max_image_size=1600)

    Args:
        model: a result, a reconstruction, a model folder or a list of poses with lenses; it is not changed.
        images: folder of its pictures. Panoramas and wide fisheyes are cut to faces, which form rigs.
        out: the folder to be made.
        options: settings, see `help(UndistortionOptions)`; defaults if None.
        progress: called as stages advance.
        **overrides: single options by name.

    Raises:
        InputError: if the model cannot be read, no picture or mask is one of it, `offset` is none, or `out`
            exists or cannot be written.
    """
    options = merge_options(options, UndistortionOptions, overrides)
    masks = Path(options.mask_path) if options.mask_path else None
    refuse_no_folder(Path(images))
    if masks:
        refuse_no_folder(masks, MASKS)
    clock = Clock.of(progress)
    with clock("read"):
        read = read_by_itself(model_of(model), with_lenses=True)
        turn, statement = (
            _level(read, model) if options.level == "auto" else (None, "its axes stay, as asked")
        )
        world = float32_world(_places(read, turn), options.offset)
        moved = read.reconstruction if turn is None else transform_model(read.reconstruction, turn)
        moved = moved if world.is_own else transform_model(moved, world.similarity(read.images.centers))
    protect = [images, *([model] if isinstance(model, Path | str) else []), *([masks] if masks else [])]
    with atomic_folder(out, protect=protect) as folder:
        with clock("pictures"):
            flats, missing = flats_of(moved, Path(images), options.max_image_size)
            _refuse_no_masks(flats, masks)
            for name in ("images", "masks") if masks else ("images",):
                (folder / name).mkdir()
            reasons = dict.fromkeys(missing, "not found")
            for done, why in enumerate(write_flats(flats, folder, clock.threads, masks)):
                reasons |= {flats[done].name: why} if why else {}
                clock.advance(done + 1, len(flats))
            flats = [flat for flat in flats if flat.name not in reasons]
            if len(flats) < 2:
                name, why = next(iter(reasons.items()))
                count = "only one" if flats else "none"
                raise InputError(
                    f"{images} has {count} of the model's images ({name}: {why}); give the folder of those "
                    f"that it was made of{', and their masks' if masks else ''}"
                )
        with clock("model"):
            colored, _ = color_model(moved, PictureFolder(Path(images), clock.threads))
            made = flatten_model(colored, flats)
            _write_models(read_model(made), folder, "masks" if masks else "")
            if world.offset_line:
                (folder / "offset.xyz").write_bytes(world.offset_line)
    doubt = model_doubt(model)
    warnings = [f"the verdict on the model is: {doubt}"] if doubt else []
    return Workspace(
        folder=Path(out),
        reconstruction=made,
        level=statement,
        offset=world.offset,
        warnings=(*warnings, *read.notes, *_warn(made, reasons)),
        renamed={flat.name: flat.names[0] for flat in flats if Path(flat.name).name != flat.name},
    )


def _refuse_no_masks(flats: Sequence[Flat], masks: Path | None) -> None:
    """Raise InputError if no image has a mask in a folder of masks."""
    if masks and flats and not any(mask_of(masks, flat.name) for flat in flats):
        raise InputError(
            f"{masks} has no mask of the {counted(len(flats), 'image')}; that of {flats[0].name} is to be "
            f"{flats[0].name}.png there"
        )


def _warn(made: "pycolmap.Reconstruction", reasons: dict[str, str]) -> Iterator[str]:
    for why in dict.fromkeys(reasons.values()):
        names = [name for name, reason in reasons.items() if reason == why]
        yield f"{counted_are(len(names), 'image')} left out ({why}): {first_of(names)}"
    if not made.num_points3D():
        yield "the model has no 3D points, so that splatting begins with random ones; `locate` makes some"


def _level(read: ColmapModel, source: ModelSource) -> tuple[Similarity | None, str]:
    """Return the turn of the world after which z points up, None for none, and what to say of it."""
    if model_datum(source) is not None:
        return None, "its axes are those of its priors: east, north, up"
    images = read.images
    points = pick_points(read.reconstruction, _MOST_POINTS).xyz
    up = find_up(images.rotations, images.centers, points)
    sigma_deg, off_deg = np.degrees(up.sigma_rad), float(angle_between_deg(up.direction, -DOWN))
    pictures = f"the horizontal axes of {counted(images.num_images, 'picture')}"
    by = f"{pictures}, and the plane of {100.0 * up.ground:.0f} % of the points" if up.ground else pictures
    known = f"known to {sigma_deg:.2g} deg by {by}"
    if sigma_deg > _ROUGH_DEG:
        return None, f"not leveled, as up is only {known}"
    if off_deg <= _LEVEL_DEG:
        return None, f"z points up already, within {off_deg:.2g} deg; up is {known}"
    turn = Similarity(scale=1.0, rotation=turn_upright(-up.direction), translation=np.zeros(3))
    return turn, f"leveled, z points up; up is {known}"


def _places(model: ColmapModel, turn: Similarity | None) -> FloatArray:
    """Return where cameras and some points stand after a turn, (k, 3)."""
    points = pick_points(model.reconstruction, _MOST_POINTS).xyz
    own = np.concatenate([model.images.centers, points])
    return own if turn is None else turn.apply(own)


def _write_models(model: ColmapModel, folder: Path, masks: str) -> None:
    sparse, stereo = folder / "sparse", folder / "stereo"
    (sparse / "0").mkdir(parents=True)
    write_model(model.reconstruction, sparse / "0")
    for file in (sparse / "0").iterdir():
        shutil.copyfile(file, sparse / file.name)
    transforms, points = nerf_files(model, f"sparse/0/{_POINTS}", masks)
    (sparse / "0" / _POINTS).write_bytes(points)
    (folder / "transforms.json").write_bytes(transforms)
    for name in _STEREO:
        (stereo / name).mkdir(parents=True)
    names = [f"{name}\n" for name in model.images.names]
    plan = "".join(f"{name}__auto__, {_PARTNERS}\n" for name in names)
    (stereo / "patch-match.cfg").write_bytes(os.fsencode(plan))
    (stereo / "fusion.cfg").write_bytes(os.fsencode("".join(names)))
