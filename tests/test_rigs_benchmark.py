"""The benchmark of rigs measures what it says."""

import sys

import numpy as np
import pycolmap
import pytest

from sfm_shapefit.synthetic import SceneOptions, WorkspaceOptions, make_rig_drive
from sfm_shapefit.synthetic.workspace import write_workspace
from tests.scenes import ROOT

sys.path.insert(0, str(ROOT / "scripts"))  # as `python scripts/benchmark.py` does

from benchmarks.rigs import _outcome


def test_scale_and_errors_are_those_of_the_model(tmp_path):
    rigs = make_rig_drive(SceneOptions(num_images=12, num_points=300, min_matches=8))
    write_workspace(rigs.scene, tmp_path / "w", WorkspaceOptions(model="rotations"), rigs)
    model = pycolmap.Reconstruction(tmp_path / "w" / "truth")
    exact = _outcome(rigs, model, 1.0)
    assert exact.num_images == 12
    assert exact.scale_error == pytest.approx(0.0, abs=1e-12)
    assert exact.errors_m.max() < 1e-9
    turn = pycolmap.Rotation3d(np.array([0.0, 0.6, 0.0, 0.8]))
    model.transform(pycolmap.Sim3d(1.01, turn, np.array([5.0, -2.0, 1.0])))
    larger = _outcome(rigs, model, 1.0)
    assert larger.scale_error == pytest.approx(0.01, rel=1e-6)
    size = np.linalg.norm(rigs.scene.centers - rigs.scene.centers.mean(axis=0), axis=1)
    np.testing.assert_allclose(larger.errors_m, 0.01 * size, rtol=1e-6)
