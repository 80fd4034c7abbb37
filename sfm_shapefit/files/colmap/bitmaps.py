"""Pictures as COLMAP reads them, and the place on Earth that their EXIF data have."""

import os
from pathlib import Path

import numpy as np
import pycolmap


def read_bitmap(file: Path) -> pycolmap.Bitmap | None:
    """Return a picture in colors; None if the file is none that pycolmap can read."""
    try:
        return pycolmap.Bitmap.read(os.fsencode(file), as_rgb=True)
    except (ValueError, RuntimeError, MemoryError):
        return None


def earth_position(bitmap: pycolmap.Bitmap) -> tuple[float, float, float] | None:
    """Return latitude and longitude, degrees, and altitude, NaN if it is not told; None without a place."""
    latitude, longitude, altitude = bitmap.exif_latitude(), bitmap.exif_longitude(), bitmap.exif_altitude()
    if latitude is None or longitude is None:
        return None
    return latitude, longitude, np.nan if altitude is None else altitude
