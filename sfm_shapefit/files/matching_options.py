"""How photographs become a database of features and matches. Pure data, cheap to import."""

from dataclasses import dataclass
from typing import Literal

from sfm_shapefit.base.settings import Settings, explained, option

CameraMode = Literal["auto", "single", "per-folder", "per-image"]
Pairing = Literal["auto", "exhaustive", "sequential", "spatial", "retrieval"]

MATCHING_FILE = "matching.json"
"""Beside a database made of photographs: the options with which it was made, with which it is gone on."""
SIDECARS = ("-wal", "-journal", "-shm")
"""Endings of the companions of a database."""
MADE_FIRST = (MATCHING_FILE, *(f"database.db{ending}" for ending in ("", *SIDECARS)))
"""Files that `map` makes of photographs in its folder before the models."""

MOST_EXHAUSTIVE = 200
"""Images up to which all pairs are matched; of 200 there are 19,900, which take an hour of one core."""


@explained
@dataclass(frozen=True, kw_only=True)
class MatchingOptions(Settings):
    """Features and matches of a folder of images."""

    camera_mode: CameraMode = option(
        "auto",
        'Which images share a lens: "auto", those of one size, device and focal length as their EXIF data '
        'have them, or else of one folder; "single", all; "per-folder"; "per-image", none.',
    )
    camera_model: str = option("SIMPLE_RADIAL", "COLMAP's model of the lenses.")
    camera_params: str = option(
        "", "Parameters of all lenses, separated by commas in the order of COLMAP; held as calibrated."
    )
    mask_path: str = option(
        "", "Folder of masks, NAME.png for image NAME; there are no features where a mask is black."
    )
    rig_config_path: str = option(
        "", "COLMAP's JSON file of rigs: which images are sensors of one rig, and the poses of the sensors."
    )
    max_image_size: int = option(-1, "Pixels of the longer side at which features are found, -1 for all.")
    max_num_features: int = option(8192, "Features of an image, the largest first.")
    pairing: Pairing = option(
        "auto",
        'Which pairs are matched: "exhaustive", all; "sequential", images near each other in the order of '
        'their names, or "spatial", by GPS in EXIF data or priors, and those that look alike; "retrieval", '
        'those that look alike; "auto", all of up to '
        f"{MOST_EXHAUSTIVE} images, else sequential if their names are numbered, else by retrieval.",
    )
    overlap: int = option(
        10,
        "Images after each one that sequential pairing matches it with; spatial pairing takes the nearest "
        "ones, three times as many.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_range("max_num_features", 1)
        self.check_range("overlap", 1)
        if self.max_image_size != -1:
            self.check_range("max_image_size", 1)
