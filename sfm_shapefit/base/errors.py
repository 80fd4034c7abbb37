"""The exceptions of this package: one family, each message one sentence that says what to do."""


class ShapeFitError(Exception):
    """Anything sfm_shapefit refuses or cannot do; catch this to catch them all."""


class InputError(ShapeFitError):
    """The input is missing, truncated, not finite or inconsistent, or an output path cannot be used."""


class UnsolvableError(ShapeFitError):
    """The input is sound, but the view graph does not determine the camera positions."""


class MissingExtraError(ShapeFitError):
    """A package that one option needs is not installed."""

    def __init__(self, what: str, package: str, extra: str) -> None:
        super().__init__(f"{what} needs {package}: pip install -e '.[{extra}]' in the folder of sfm_shapefit")
