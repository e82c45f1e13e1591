"""The record of Gaussians: its harmonics against the formulas of 3DGS, and what a change of frame must keep."""

import numpy as np
import pytest
from examples import examples
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nerfcli.cameras.rigid import Similarity, rotation_from_quaternion
from nerfcli.splats.gaussians import Gaussians, basis

# A dozen operations in float32.
RELATIVE = 5e-6


def some_gaussians(seed: int, degree: int) -> Gaussians:
    rng, count = np.random.default_rng(seed), 20
    means, log_scales = rng.normal(size=(count, 3)), rng.normal(size=(count, 3)) - 2
    quaternions, logits = rng.normal(size=(count, 4)), rng.normal(size=count)
    return Gaussians(means, log_scales, quaternions, logits, rng.normal(size=(count, (degree + 1) ** 2, 3)))


def some_similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    return Similarity(float(np.exp(rng.normal())), Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3))


def directions() -> np.ndarray:
    drawn = np.random.default_rng(9).normal(size=(30, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def covariances(gaussians: Gaussians) -> np.ndarray:
    """R diag(exp(2 s)) R^T of the quaternions and log scales."""
    rotations = rotation_from_quaternion(gaussians.quaternions)
    return np.einsum("nij,nj,nkj->nik", rotations, np.exp(2 * gaussians.log_scales.astype(np.float64)), rotations)


def colours(gaussians: Gaussians, seen_along: np.ndarray) -> np.ndarray:
    return np.einsum("dk,nkc->dnc", basis(seen_along, gaussians.degree), gaussians.harmonics)


def test_harmonics_are_those_of_the_3dgs_code():
    """eval_sh of graphdeco-inria/gaussian-splatting, utils/sh_utils.py, term by term."""
    x, y, z = directions().T
    xx, yy, zz = x * x, y * y, z * z
    expected = [
        *(0.28209479177387814 + 0 * x, -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x),
        *(1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * zz - xx - yy)),
        *(-1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy)),
        *(-0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z),
        *(-0.4570457994644658 * y * (4 * zz - xx - yy), 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy)),
        *(-0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy)),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    for degree in range(4):
        np.testing.assert_allclose(basis(directions(), degree).T, expected[: (degree + 1) ** 2], rtol=0, atol=1e-14)


@examples(40)
@given(st.integers(0, 3), st.integers(0, 2**31))
@example(3, 0)
def test_moved_gaussians_look_the_same_from_the_moved_camera(degree, seed):
    gaussians, b_from_a = some_gaussians(seed, degree), some_similarity(seed)
    moved = gaussians.moved(b_from_a)
    np.testing.assert_allclose(moved.means, b_from_a.apply(gaussians.means), rtol=RELATIVE, atol=RELATIVE)
    turn = b_from_a.rotation
    expected = b_from_a.scale**2 * turn @ covariances(gaussians) @ turn.T
    atol = 1e-5 * np.abs(expected).max(axis=(1, 2), keepdims=True)  # twice the error of exp(s), s up to 6 in float32
    assert (np.abs(covariances(moved) - expected) <= atol).all()
    after, before = colours(moved, directions() @ turn.T), colours(gaussians, directions())
    np.testing.assert_allclose(after, before, rtol=0, atol=RELATIVE * 4)
    np.testing.assert_array_equal(moved.logits, gaussians.logits)


def test_shapes_are_checked_and_values_are_float32():
    whole = some_gaussians(0, 2)
    assert {values.dtype for values in whole} == {np.dtype(np.float32)}
    assert (len(whole), whole.degree, len(whole.taken(slice(3)))) == (20, 2, 3)
    with pytest.raises(ValueError, match="expected"):
        Gaussians(whole.means, whole.log_scales, whole.quaternions, whole.logits, whole.harmonics[:, :5])
    with pytest.raises(ValueError, match="expected"):
        Gaussians(whole.means, whole.log_scales, whole.quaternions[:, :3], whole.logits, whole.harmonics)
