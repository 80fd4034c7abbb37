"""`python -m sfm_shapefit.cli`."""

from sfm_shapefit.cli import main

main()
