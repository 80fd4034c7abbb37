"""`workspace`: pictures and model without distortion, in the folders that splatting and dense programs read.

OUT/images/              pictures, all in one folder
OUT/sparse/0/            the model, and its points as points3D.ply: 3DGS, gsplat, brush, LichtFeld
OUT/sparse/, OUT/stereo/ the model again and the plan of the stereo: COLMAP's dense commands, OpenMVS
OUT/transforms.json      cameras, and the name of the points: nerfstudio
"""

import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from sfm_shapefit.base.atomic_folder import atomic_folder
from sfm_shapefit.base.clock import Clock, Progress
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.geometry import Similarity, angle_between_deg
from sfm_shapefit.base.paths import refuse_no_folder
from sfm_shapefit.base.wording import counted, counted_are, first_of
from sfm_shapefit.facts.tables import model_datum
from sfm_shapefit.files.colmap.listed_poses import read_by_itself
from sfm_shapefit.files.colmap.model import ColmapModel, ModelSource, model_of, read_model
from sfm_shapefit.files.colmap.picture_colors import PictureFolder, color_model
from sfm_shapefit.files.colmap.pinholes import flats_of, flatten_model, write_flats
from sfm_shapefit.files.colmap.reconstructions import transform_model
from sfm_shapefit.files.colmap.seed import pick_points, write_model
from sfm_shapefit.files.nerf import nerf_text
from sfm_shapefit.report.mesh import ply_bytes
from sfm_shapefit.rotations.gravity import DOWN, turn_upright
from sfm_shapefit.scene.level import find_up

if TYPE_CHECKING:
    import pycolmap

Level = Literal["auto", "never"]
LEVELS: tuple[Level, ...] = get_args(Level)

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
    warnings: tuple[str, ...]
    """Images that are left out, and why."""

    @property
    def told(self) -> list[str]:
        """What the terminal says, in lines."""
        model = self.reconstruction
        counts = f"{counted(model.num_reg_images(), 'picture')}, {counted(model.num_points3D(), 'point')}"
        warnings = [f"warning: {one}" for one in self.warnings]
        return [counts, f"level: {self.level}", *warnings, f"written to {self.folder}/"]


def workspace(
    model: ModelSource,
    images: Path | str,
    out: Path | str,
    *,
    level: Level = "auto",
    progress: Progress | None = None,
) -> Workspace:
    """Write pictures and model without distortion for splatting and dense reconstruction.

        sfm_shapefit.workspace("mapped/0", "images", "dense")

    Args:
        model: a result, a reconstruction, a model folder or a list of poses with lenses; it is not changed.
        images: folder of its pictures. Panoramas and wide fisheyes are cut to faces, which form rigs.
        out: the folder to be made.
        level: "auto" turns the world so that z points up, by what pictures and ground points say, unless
            priors or gravity did; "never" keeps its axes.
        progress: called as stages advance.

    Raises:
        InputError: if the model or all pictures cannot be read, or `out` exists or cannot be written.
    """
    if level not in LEVELS:
        raise InputError(f"level must be auto or never, got {level!r}")
    refuse_no_folder(Path(images))
    clock = Clock.of(progress)
    with clock("read"):
        read = read_by_itself(model_of(model), with_lenses=True)
        turn, statement = _level(read, model) if level == "auto" else (None, "its axes stay, as asked")
        leveled = read.reconstruction if turn is None else transform_model(read.reconstruction, turn)
    protect = [images, *([model] if isinstance(model, Path | str) else [])]
    with atomic_folder(out, protect=protect) as folder:
        with clock("pictures"):
            (folder / "images").mkdir()
            flats, missing = flats_of(leveled, Path(images))
            reasons = dict.fromkeys(missing, "no picture")
            for done, why in enumerate(write_flats(flats, folder / "images", clock.threads)):
                reasons |= {flats[done].name: why} if why else {}
                clock.advance(done + 1, len(flats))
            flats = [flat for flat in flats if flat.name not in reasons]
            if not flats:
                name, why = next(iter(reasons.items()))
                raise InputError(
                    f"{images} has no picture of the model ({name}: {why}); give the folder of those that it "
                    "was made of"
                )
        with clock("model"):
            colored, _ = color_model(leveled, PictureFolder(Path(images), clock.threads))
            made = flatten_model(colored, flats)
            _write_models(read_model(made), folder)
    return Workspace(
        folder=Path(out), reconstruction=made, level=statement, warnings=(*read.notes, *_warn(made, reasons))
    )


def _warn(made: "pycolmap.Reconstruction", reasons: Mapping[str, str]) -> Iterator[str]:
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


def _write_models(model: ColmapModel, folder: Path) -> None:
    sparse, stereo = folder / "sparse", folder / "stereo"
    (sparse / "0").mkdir(parents=True)
    write_model(model.reconstruction, sparse / "0")
    for file in (sparse / "0").iterdir():
        shutil.copyfile(file, sparse / file.name)
    points = pick_points(model.reconstruction, model.reconstruction.num_points3D())
    (sparse / "0" / _POINTS).write_bytes(ply_bytes(points.xyz, points.colors, with_normals=True))
    text = nerf_text(model.images, f"sparse/0/{_POINTS}")
    (folder / "transforms.json").write_bytes(text.encode(errors="backslashreplace"))
    for name in _STEREO:
        (stereo / name).mkdir(parents=True)
    names = [f"{name}\n" for name in model.images.names]
    plan = "".join(f"{name}__auto__, {_PARTNERS}\n" for name in names)
    (stereo / "patch-match.cfg").write_bytes(os.fsencode(plan))
    (stereo / "fusion.cfg").write_bytes(os.fsencode("".join(names)))
