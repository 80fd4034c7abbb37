"""What may still move, as it is asked for. Pure data, and cheap to import."""

from dataclasses import dataclass
from typing import Literal

from sfm_shapefit.base.settings import Settings, explained, option

Adjust = Literal["none", "seed", "full"]
IntrinsicsFreedom = Literal["auto", "held", "focal", "all"]
RigFreedom = Literal["held", "free"]

PARTS_FREED: dict[IntrinsicsFreedom, tuple[str, ...]] = {
    "auto": ("focal_lengths", "distortion"),
    "held": (),
    "focal": ("focal_lengths",),
    "all": ("focal_lengths", "distortion"),
}
"""What each choice frees of a lens, see `scene.lens.PARTS`."""

_MOST_ADJUSTED_CAMERAS = 2_000  # cameras; the adjustment of more would take longer than all the rest


@explained
@dataclass(frozen=True, kw_only=True)
class FreedomOptions(Settings):
    """What is adjusted to the pixels, and what may move with it."""

    adjust: Adjust = option(
        "seed",
        'Bundle adjustment: "seed" adjusts positions and points by all tracks, and rotations as far as they '
        'are in doubt (up to 2,000 cameras); "full" then adjusts all once more, freely; "none" nothing.',
    )
    intrinsics: IntrinsicsFreedom = option(
        "auto",
        'Intrinsics that the adjustments change: "auto", focal length and distortion of cameras that were '
        'never calibrated (COLMAP\'s guess, or EXIF data); "focal", the focal lengths of all cameras; "all", '
        'their distortion too; "held", nothing. Given values count by their own uncertainty, and stay where '
        "the matches do not determine them. Cameras that images share stay shared.",
    )
    rigs: RigFreedom = option(
        "held",
        'Poses of the sensors in their rigs: "held", as they are; "free", refined, one pose for all frames '
        "each. The reference sensors stay, and so does the mean distance of the others "
        "from them: the scale is still that of the rigs. Where the matches do not determine a "
        "sensor's pose, `locate` refuses, and `map` holds all.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.intrinsics not in ("auto", "held"):
            self.refuse_held("intrinsics", self.intrinsics)
        if self.rigs == "free":
            self.refuse_held("rigs", self.rigs)

    def adjusts_cameras(self, num_cameras: int) -> bool:
        """Return whether `num_cameras` placed cameras are adjusted, unless the optimum is wanted as it is."""
        return self.adjust != "none" and num_cameras <= _MOST_ADJUSTED_CAMERAS

    def refuse_held(self, name: str, value: object) -> None:
        """Refuse a freedom, an option with its value, where nothing is adjusted that could use it.

        Raises:
            ValueError: a sentence that names both options.
        """
        if self.adjust == "none":
            raise ValueError(f"{name}={value} needs an adjustment; leave out adjust=none")
