"""What rotation averaging is told; cheap to import, as the command line is."""

from typing import Literal

Averaging = Literal["own", "pycolmap"]
"""Who averages: this package, or pycolmap."""
