"""Coverage-guided fuzzing of the walkers over model files, by atheris if it is installed.

Any bytes in the place of any file of a small model must end in None or an InputError; a file that passes must
be read by pycolmap in the same process without a crash.
"""

import argparse
import importlib.util
import os
import subprocess
import sys
import tempfile
import types
from pathlib import Path

from abuse.verdicts import MODEL_FILES

HELP = "coverage-guided fuzzing of the binary walkers (needs atheris)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--corpus", type=Path, help="where interesting inputs are kept between runs")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--base", type=Path, help=argparse.SUPPRESS)


def run(args: argparse.Namespace) -> int:
    """Fuzz in a process of its own, which libFuzzer ends by itself."""
    if importlib.util.find_spec("atheris") is None:
        print("atheris is not installed; `pip install atheris` (Linux, CPython 3.11 or newer)")
        return 2
    if args.inside:
        _fuzz(args)
    from abuse.fuzz import make_base

    with tempfile.TemporaryDirectory() as temporary:
        base = make_base(Path(temporary) / "base")
        corpus = (args.corpus or Path(temporary) / "corpus").resolve()
        corpus.mkdir(exist_ok=True, parents=True)
        for k, name in enumerate(MODEL_FILES):
            (corpus / f"sound-{name}").write_bytes(
                bytes([k]) + (base / "sparse" / "0" / f"{name}.bin").read_bytes()
            )
        command = [sys.executable, os.path.abspath(sys.argv[0]), "walkers", "--inside", "--base", str(base)]
        command += ["--seconds", str(args.seconds), "--seed", str(args.seed), "--corpus", str(corpus)]
        return subprocess.run(command, check=False, cwd=temporary).returncode


def _fuzz(args: argparse.Namespace) -> None:
    """Become libFuzzer; never returns."""
    import atheris
    import pycolmap

    from sfm_shapefit.colmap import check
    from sfm_shapefit.colmap.model import PYCOLMAP_ERRORS, quiet_pycolmap
    from sfm_shapefit.errors import InputError

    folder = args.base / "sparse" / "0"
    sound = {name: (folder / f"{name}.bin").read_bytes() for name in MODEL_FILES}
    check.check_model_files(folder)

    for owner in (check, check._BinaryFile):  # plain functions only: numba cannot compile instrumented ones
        for name, function in list(vars(owner).items()):
            if isinstance(function, types.FunctionType):
                setattr(owner, name, atheris.instrument_func(function))

    def one_input(data: bytes) -> None:
        if not data:
            return
        name = MODEL_FILES[data[0] % len(MODEL_FILES)]
        (folder / f"{name}.bin").write_bytes(data[1:])
        try:
            check.check_model_files(folder)
            with quiet_pycolmap():
                pycolmap.Reconstruction(folder)
        except (InputError, *PYCOLMAP_ERRORS):
            pass
        finally:
            (folder / f"{name}.bin").write_bytes(sound[name])

    limits = [f"-max_total_time={args.seconds}", f"-seed={args.seed}", "-timeout=10", "-rss_limit_mb=2048"]
    shown = ["-print_final_stats=1", "-max_len=16384", "-verbosity=0"]
    atheris.Setup([sys.argv[0], str(args.corpus), *limits, *shown], one_input)
    os.environ["PYTHONUNBUFFERED"] = "1"
    atheris.Fuzz()
