"""The plugins of these tests: the package's own fixtures, and pytest's for tests of plugins."""

pytest_plugins = ["pytester", "sfm_shapefit.synthetic.fixtures"]
