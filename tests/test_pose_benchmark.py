"""benchmarks/poses.py: its measures against closed forms and a double loop."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerfcli.cameras import rigid


@pytest.fixture(scope="module")
def benchmark() -> Any:
    """The script as a module."""
    path = Path(__file__).parent.parent / "benchmarks" / "poses.py"
    spec = importlib.util.spec_from_file_location("poses_benchmark", path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["poses_benchmark"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def random_poses(count: int = 12, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rigid.from_parts(Rotation.random(count, rng=rng).as_matrix(), rng.normal(size=(count, 3)))


def in_another_world(poses: np.ndarray) -> np.ndarray:
    """The same cameras after a rotation, a shift and a scale of the world."""
    rotation = Rotation.from_rotvec([0.3, -1.0, 0.4]).as_matrix()
    return rigid.from_parts(rotation @ poses[:, :3, :3], 2.5 * poses[:, :3, 3] @ rotation.T + [1, 2, 3])


def test_the_same_cameras_in_another_world_are_right(benchmark):
    poses = random_poses()
    found = benchmark.compare_poses(poses, in_another_world(poses))
    assert found.compared == 12
    np.testing.assert_allclose([found.ate, found.rotation_worst_deg, found.own_axes_deg], 0, atol=2e-6)
    np.testing.assert_allclose([found.auc_1, found.auc_10], 1, atol=1e-6)


def test_rotations_about_their_own_axes_are_distinguished_from_the_rest(benchmark):
    """Closed form: every camera turned by 0.65 degrees about its own y: centres stay, all rotations are off by that."""
    poses = random_poses()
    turned = poses.copy()
    turned[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec([0, 0.65, 0], degrees=True).as_matrix()
    found = benchmark.compare_poses(poses, in_another_world(turned))
    assert found.ate == pytest.approx(0, abs=1e-9)
    assert found.rotation_median_deg == pytest.approx(0.65)
    assert found.own_axes_deg == pytest.approx(0.65)
    assert found.own_axes_median_deg == pytest.approx(0, abs=1e-6)


def test_one_camera_that_lies_elsewhere(benchmark):
    """Closed form at first order: one of N cameras is off by d, so the RMS distance is d / sqrt(N)."""
    poses = random_poses(100)
    off = poses.copy()
    off[7, :3, 3] += [1e-3, 0, 0]
    radii = np.linalg.norm(poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0), axis=1)
    expected = 1e-3 / np.sqrt(np.sum(radii**2))
    assert benchmark.compare_poses(poses, off).ate == pytest.approx(expected, rel=0.05)


def test_relative_errors_and_missing_photos(benchmark):
    """A double loop is the oracle; AUC is the mean of max(0, 1 - error / limit); a missing photo fails its pairs."""
    truth, found = random_poses(6), random_poses(6)
    found[:, :3, :3] = truth[:, :3, :3] @ Rotation.from_rotvec(0.02 * random_poses(6, seed=2)[:, :3, 3]).as_matrix()
    found[:, :3, 3] = truth[:, :3, 3] + 0.02 * random_poses(6, seed=3)[:, :3, 3]
    errors = []
    for i in range(6):
        for j in range(i + 1, 6):
            one, other = (np.linalg.inv(poses[j]) @ poses[i] for poses in (truth, found))
            turn = np.degrees(np.arccos(np.clip((np.trace(one[:3, :3].T @ other[:3, :3]) - 1) / 2, -1, 1)))
            cosine = one[:3, 3] @ other[:3, 3] / np.linalg.norm(one[:3, 3]) / np.linalg.norm(other[:3, 3])
            errors.append(max(turn, np.degrees(np.arccos(cosine))))
    accuracy = benchmark.compare_poses(truth, found, missing=1)
    for limit, auc in ((1, accuracy.auc_1), (3, accuracy.auc_3), (10, accuracy.auc_10)):
        expected = sum(max(0.0, 1 - error / limit) for error in errors) / 21  # 7 photos have 21 pairs
        assert auc == pytest.approx(expected, abs=1e-6)
