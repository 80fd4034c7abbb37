"""The commands and the doors of Python: a page each, on the stages of `pipeline`."""
