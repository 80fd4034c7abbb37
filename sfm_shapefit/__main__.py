"""`python -m sfm_shapefit`."""

from sfm_shapefit.cli import main

if __name__ == "__main__":  # worker processes import this module again
    main()
