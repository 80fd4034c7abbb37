"""What to photograph and what to write of it: data alone, cheap to import, as flags are made of it."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from sfm_shapefit.base.settings import Settings, explained, option

if TYPE_CHECKING:  # numpy is not cheap
    from sfm_shapefit.base.arrays import FloatArray

RigKind = Literal["none", "pair", "back-to-back", "four"]
Shape = Literal["ring", "facade", "drive", "cloud", "courtyard"]
ModelContent = Literal["full", "rotations"]


@explained
@dataclass(frozen=True, kw_only=True)
class SceneOptions(Settings):
    """What to photograph, and how badly."""

    shape: Shape = option(
        "ring",
        'Shape of the scene: "ring": cameras around an object; "facade": a grid of cameras before a '
        'wall; "drive": forward along a street; "cloud": random cameras around random points; '
        '"courtyard": around the inside of four facades.',
    )
    num_images: int = option(25, "Number of images, all by cameras of the same lens.")
    rig: RigKind = option(
        "none",
        "What the cameras are mounted on, so that a rig of several stands where each single camera would; "
        '"pair": two side by side; "back-to-back": two that look away from each other; "four": a pair '
        "ahead, and one to either side. The number of images is rounded down to whole frames.",
    )
    num_points: int = option(
        2000, "Number of surface points; those seen by fewer than two images stay out of the model."
    )
    pixel_noise_px: float = option(0.5, "Standard deviation of each keypoint coordinate.")
    wrong_match_fraction: float = option(0.0, "Fraction of each pair's matches that join random keypoints.")
    corrupted_pair_fraction: float = option(
        0.0, "Fraction of the pairs all of whose matches agree on a false baseline."
    )
    rotation_noise_deg: float = option(
        0.0, "Standard deviation, about each axis, of the error of the rotations that the model states."
    )
    max_pairs_per_image: int = option(
        20,
        "Each image is paired with that many others, those it shares most points with; a pair is kept "
        "if either of its images asks for it.",
    )
    min_matches: int = option(30, "Images that share fewer points than this are no pair.")
    max_matches_per_pair: int | None = option(
        None, "So many of a pair's matches are kept, drawn at random; all if not given."
    )
    max_keypoints_per_image: int = option(
        1000, "The points that appear largest (nearest and most frontal) are kept."
    )
    image_width: int = option(1200, "In pixels.")
    image_height: int = option(900, "In pixels.")
    focal_length_px: float = option(
        1000.0, "One for both axes; the principal point is the center of the image."
    )
    seed: int = option(0, "Decides every random draw.")

    def __post_init__(self) -> None:
        super().__post_init__()
        for least, names in (
            (0, ("seed",)),
            (1, ("num_points", "max_pairs_per_image")),
            (2, ("num_images",)),
            (8, ("min_matches", "max_keypoints_per_image")),
            (16, ("image_width", "image_height")),
        ):
            for name in names:
                self.check_range(name, least)
        most = self.max_matches_per_pair
        if most is not None and most < self.min_matches:
            raise ValueError(f"max_matches_per_pair must be >= min_matches = {self.min_matches}, got {most}")
        self.check_range("pixel_noise_px", 0.0, 1e6)
        self.check_range("rotation_noise_deg", 0.0, 180.0)
        for name in ("wrong_match_fraction", "corrupted_pair_fraction"):
            self.check_range(name, 0.0, 1.0)
        self.check_range("focal_length_px", 1e-3, 1e9)

    @property
    def calibration(self) -> "FloatArray":
        """The (3, 3) calibration matrix K of every image."""
        import numpy as np

        f, x, y = self.focal_length_px, self.image_width / 2.0, self.image_height / 2.0
        return np.array([[f, 0.0, x], [0.0, f, y], [0.0, 0.0, 1.0]])


@explained
@dataclass(frozen=True, kw_only=True)
class RenderOptions(Settings):
    """How a scene is drawn, where images are asked for."""

    repeated_fraction: float = option(
        0.0,
        "Fraction of the houses (of the tower's sides in a ring) that look the same, so that matches "
        "of different ones are wrong and agree.",
    )
    radial_k1: float = option(
        -0.05, "First radial distortion coefficient of the lens, as OpenCV and COLMAP define it."
    )
    radial_k2: float = option(0.01, "Second radial distortion coefficient.")
    gray_noise: float = option(2.0, "Standard deviation of the sensor's noise, in gray levels of 255.")
    exposure_spread: float = option(0.05, "Standard deviation of the brightness factor from image to image.")
    jpeg_quality: int = option(92, "Of the image files, 1 to 100.")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("radial_k1", "radial_k2"):
            self.check_range(name, -0.5, 0.5)
        for name, most in (("repeated_fraction", 1.0), ("gray_noise", 100.0), ("exposure_spread", 0.3)):
            self.check_range(name, 0.0, most)
        self.check_range("jpeg_quality", 1, 100)


@explained
@dataclass(frozen=True, kw_only=True)
class WorkspaceOptions(Settings):
    """What stands in the workspace."""

    model: ModelContent = option(
        "full",
        'What sparse/0 states: "full" is poses and points with their tracks; "rotations" keeps the '
        "rotations only, as from an inertial sensor: all centers at the origin, no points.",
    )
    database: bool = option(
        True, "Write database.db; without it the model's own tracks are the only source of directions."
    )
    relative_poses: bool = option(
        False, "Store cam2_from_cam1 in the two-view geometries; COLMAP leaves it out by default."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.model == "rotations" and not self.database:
            raise ValueError(
                "model = 'rotations' needs database: without points and "
                "without matches nothing can be located"
            )
