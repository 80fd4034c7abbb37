"""The exceptions of this package: one family, each message one sentence that says what to do."""


class ShapeFitError(Exception):
    """Anything sfm_shapefit refuses or cannot do; catch this to catch them all."""


class InputError(ShapeFitError):
    """The input is missing, truncated, not finite or inconsistent, or an output path cannot be used."""


class UnsolvableError(ShapeFitError):
    """The input is sound, but the view graph does not determine the camera positions."""
