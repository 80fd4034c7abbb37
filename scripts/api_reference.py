"""Build the API reference of the package, with pdoc, from its docstrings.

    python scripts/api_reference.py docs/api

A page per module that callers use; the public names are on the first. Warnings, as of names that do not
resolve, should be errors: run it with -W error, as scripts/docs does.
"""

import sys
from importlib import import_module
from pathlib import Path

import pdoc

MODULES = (
    "sfm_shapefit",
    "sfm_shapefit.baselines",
    "sfm_shapefit.colmap.model",
    "sfm_shapefit.synthetic.rendered_workspace",
    "sfm_shapefit.colmap.quiet",
    "sfm_shapefit.synthetic.workspace",
    "sfm_shapefit.placement.diagnosis",
    "sfm_shapefit.directions",
    "sfm_shapefit.errors",
    "sfm_shapefit.evaluation",
    "sfm_shapefit.formats",
    "sfm_shapefit.placement.gauge",
    "sfm_shapefit.options",
    "sfm_shapefit.commands",
    "sfm_shapefit.placement.place",
    "sfm_shapefit.results.tables",
    "sfm_shapefit.results",
    "sfm_shapefit.rigidity",
    "sfm_shapefit.judgement",
    "sfm_shapefit.solver",
    "sfm_shapefit.synthetic",
    "sfm_shapefit.synthetic.fixtures",
    "sfm_shapefit.theory",
    "sfm_shapefit.viewgraph",
)


def build(out: Path) -> None:
    """Write the pages into a folder."""
    for module in map(import_module, MODULES):
        for name in getattr(module, "__all__", ()):
            getattr(module, name)  # pdoc sees only what is there, and some is imported at its first use
    pdoc.render.configure(docformat="google", show_source=False)
    pdoc.pdoc(*MODULES, output_directory=out)


if __name__ == "__main__":
    build(Path(sys.argv[1]))
