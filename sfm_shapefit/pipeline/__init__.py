"""The commands as functions: read, measure, place, seed, write. Each is a page; its steps stand beside it."""
