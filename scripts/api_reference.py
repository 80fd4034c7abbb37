"""Build the API reference of the package, with pdoc, from its docstrings.

    python scripts/api_reference.py docs/api

A page per module that callers use; the public names are on the first. Warnings, as of names that do not
resolve, should be errors: run it with -W error, as scripts/docs does.
"""

import sys
from importlib import import_module
from pathlib import Path

import pdoc

import sfm_shapefit

FURTHER = (
    *("scene.evaluation", "facts.tables", "files.colmap.model", "files.g2o", "files.glomap_text"),
    *("files.graph_text", "files.nerf", "files.onedsfm", "files.opensfm", "files.tum", "graph.rigidity"),
    *("placement.gauge", "placement.diagnosis", "synthetic", "synthetic.fixtures"),
    *("synthetic.rendered_workspace", "synthetic.workspace"),
)
"""Modules with a page beside those that public names come from."""


def modules() -> list[str]:
    """Return the modules that callers use."""
    public = (getattr(sfm_shapefit, name) for name in sfm_shapefit.__all__)
    further = (f"{sfm_shapefit.__name__}.{name}" for name in FURTHER)
    return ["sfm_shapefit", *sorted({*(value.__module__ for value in public), *further})]


def build(out: Path) -> None:
    """Write the pages into a folder."""
    names = modules()
    for module in map(import_module, names):
        for name in getattr(module, "__all__", ()):
            getattr(module, name)  # pdoc sees only what is there, and some is imported at its first use
    pdoc.render.configure(docformat="google", show_source=False)
    pdoc.pdoc(*names, output_directory=out)


if __name__ == "__main__":
    build(Path(sys.argv[1]))
