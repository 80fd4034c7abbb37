"""`sfm-shapefit warm-up`."""

from functools import partial

from sfm_shapefit.base.display import row
from sfm_shapefit.cli.console import print_table, report_errors
from sfm_shapefit.cli.flags import GroupedCommand, Quiet
from sfm_shapefit.cli.progress import show_progress
from sfm_shapefit.cli.root import app


@app.command(
    "warm-up",
    cls=GroupedCommand,
    short_help="Compile all kernels beforehand, as a step of an installation.",
    epilog="In a Dockerfile: RUN pip install . && sfm-shapefit warm-up",
)
def warm_up_command(*, quiet: Quiet = False) -> None:
    """Compile everything that any command needs, on all cores, and keep it on disk.

    Without it a command compiles what it needs when it first needs it.
    """
    with report_errors():
        from sfm_shapefit.commands.warm_up import WarmUpError, not_done, warm_up

        with show_progress(not quiet) as progress:
            done = warm_up(not_done(), partial(progress, "compiling kernels") if progress else None)
        if done.failures:
            raise WarmUpError("; ".join(done.failures))
        if not quiet:
            ready = f"{done.num_kernels} ready on disk" if done.num_kernels else "ready on disk since before"
            print_table("warm-up", [row("kernels", ready)])
