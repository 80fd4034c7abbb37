"""The plugins of these tests: the package's own fixtures, and pytest's for tests of plugins."""

import signal

pytest_plugins = ["pytester", "sfm_shapefit.synthetic.fixtures"]

# A shell starts background jobs with interrupts ignored, and their children inherit that: commands that the
# tests interrupt would never end.
signal.signal(signal.SIGINT, signal.default_int_handler)
