"""How pictures are written without distortion. Pure data, cheap to import."""

from dataclasses import dataclass
from typing import Literal

from sfm_shapefit.base.settings import Settings, explained, option


@explained
@dataclass(frozen=True, kw_only=True)
class UndistortionOptions(Settings):
    """Images and model without distortion."""

    level: Literal["auto", "never"] = option(
        "auto",
        'Whether the world is turned so that z points up: "auto", by the horizontal axes of the images and '
        'the plane of the ground, unless priors or gravity did; "never".',
    )
    mask_path: str = option(
        "",
        "Folder of masks, NAME.png for image NAME, black where nothing is to be learned; OUT/masks has them "
        "without distortion.",
    )
    offset: str = option(
        "auto",
        "X,Y,Z to be subtracted from all coordinates; OUT/offset.xyz tells it. By default round numbers "
        "where the model is too far from its origin for the float32 of most programs, else 0.",
    )
    max_image_size: int = option(-1, "Pixels of the longer side of the images that are written, -1 for all.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_image_size != -1:
            self.check_range("max_image_size", 1)
