"""What is not installed by default, and is missed where an option asks for it."""

from sfm_shapefit.base.errors import ShapeFitError


class MissingExtraError(ShapeFitError):
    """A package that one option needs is not installed."""

    def __init__(self, what: str, package: str, extra: str) -> None:
        super().__init__(f"{what} needs {package}: pip install '.[{extra}]' in the folder of sfm_shapefit")
