"""Laws of rigid transforms, quaternions and similarities; scipy and numpy.linalg are the independent references."""

import json

import numpy as np
import pytest
from captures import random_similarity
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from nerfcli.cameras import rigid
from nerfcli.cameras.rigid import Similarity
from nerfcli.errors import UserError

seeds = st.integers(0, 2**32 - 1)
exponents = st.integers(-6, 6)
few = examples(40)


def random_pose(rng: np.random.Generator, size: float = 1.0) -> np.ndarray:
    return rigid.from_parts(Rotation.from_quat(rng.normal(size=4)).as_matrix(), size * rng.normal(size=3))


@given(seed=seeds, exponent=exponents)
@few
def test_inverse_cancels_and_agrees_with_a_linear_solve(seed, exponent):
    rng = np.random.default_rng(seed)
    size = 10.0**exponent
    b_from_a = random_pose(rng, size)
    a_from_b = rigid.inverse(b_from_a)
    tolerance = 1e-14 * max(size, 1) * 10
    np.testing.assert_allclose(a_from_b @ b_from_a, np.eye(4), rtol=0, atol=tolerance)
    np.testing.assert_allclose(a_from_b, np.linalg.inv(b_from_a), rtol=0, atol=tolerance)
    np.testing.assert_array_equal(a_from_b[3], [0, 0, 0, 1])


def test_inverse_and_apply_work_on_batches_as_on_single_transforms():
    rng = np.random.default_rng(0)
    poses = np.stack([random_pose(rng) for _ in range(6)]).reshape(2, 3, 4, 4)
    points = rng.normal(size=(2, 3, 5, 3))
    inverses, moved = rigid.inverse(poses), rigid.apply(poses, points)
    for index in np.ndindex(2, 3):
        np.testing.assert_array_equal(inverses[index], rigid.inverse(poses[index]))
        np.testing.assert_allclose(moved[index], rigid.apply(poses[index], points[index]), rtol=0, atol=1e-15)
    assert rigid.apply(poses[0, 0], points[0, 0, 0]).shape == (3,)


@given(seed=seeds)
@few
def test_adjacent_names_cancel(seed):
    rng = np.random.default_rng(seed)
    c_from_b, b_from_a, points = random_pose(rng), random_pose(rng), rng.normal(size=(7, 3))
    one_by_one = rigid.apply(c_from_b, rigid.apply(b_from_a, points))
    np.testing.assert_allclose(rigid.apply(c_from_b @ b_from_a, points), one_by_one, rtol=0, atol=1e-13)


@given(seed=seeds, angle=st.sampled_from([0.0, 1e-15, 1e-12, 1e-8, 1e-3, 1.0, np.pi - 1e-8, np.pi - 1e-14, np.pi]))
@few
def test_quaternions_and_rotations_round_trip_near_identity_and_near_pi(seed, angle):
    axis = np.random.default_rng(seed).normal(size=3)
    expected = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    wxyz = rigid.quaternion_from_rotation(expected.as_matrix())
    assert wxyz[0] >= 0
    assert abs(np.linalg.norm(wxyz) - 1) < 1e-15
    np.testing.assert_allclose(rigid.rotation_from_quaternion(wxyz), expected.as_matrix(), rtol=0, atol=1e-15)
    # A small turn keeps its size: the vector part is sin(angle / 2), not the rounding of 1 - cos.
    np.testing.assert_allclose(np.linalg.norm(wxyz[1:]), np.sin(angle / 2), rtol=1e-6, atol=2e-16)


@given(seed=seeds)
@few
def test_quaternion_product_is_matrix_product(seed):
    first, second = Rotation.from_quat(np.random.default_rng(seed).normal(size=(2, 4)))
    wxyz = (first * second).as_quat()[[3, 0, 1, 2]]
    expected = first.as_matrix() @ second.as_matrix()
    for factor in (1.0, -1.0, 1e-8, 1e8):  # the length and the sign of a quaternion carry no rotation
        np.testing.assert_allclose(rigid.rotation_from_quaternion(factor * wxyz), expected, rtol=0, atol=1e-14)


angles = st.one_of(
    st.sampled_from([0.0, 1e-300, 1e-15, 1e-8, 1e-3, 0.2499, 0.2501, 3.0, np.pi - 1e-5, np.pi - 1e-9, np.pi]),
    st.floats(0, np.pi),
)


@given(seed=seeds, angle=angles)
@examples(200)
def test_exp_and_log_of_rotations_are_inverse_from_0_to_pi(seed, angle):
    """To rounding at pi too: the half angle is found by atan2 of the quaternion's two parts, never by acos."""
    axis = np.random.default_rng(seed).normal(size=3)
    vector = angle * axis / np.linalg.norm(axis)
    rotation = rigid.rotation_from_vector(vector)
    # Two roundings of some operations each; 1.1e-15 is the largest difference that was seen.
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(vector).as_matrix(), rtol=0, atol=3e-15)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=2e-15)
    back = rigid.vector_from_rotation(rotation)
    if angle > np.pi - 1e-12 and back @ vector < 0:  # at pi both axes are right
        back = -back
    np.testing.assert_allclose(back, vector, rtol=1e-15, atol=max(2e-15 * angle, 1e-300))
    np.testing.assert_allclose(rigid.rotation_from_vector(back), rotation, rtol=0, atol=2e-15)


@given(seed=seeds, angle=angles)
@examples(100)
def test_exp_of_a_twist_is_the_matrix_exponential(seed, angle):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    twist = np.concatenate([rng.normal(size=3), angle * axis / np.linalg.norm(axis)])
    generator = np.zeros((4, 4))
    generator[:3, :3] = np.cross(twist[3:], np.eye(3)).T  # its columns are w x e_i
    generator[:3, 3] = twist[:3]
    transform = rigid.transform_from_twist(twist)
    np.testing.assert_allclose(transform, expm(generator), rtol=0, atol=1e-13)


@given(seed=seeds)
@few
def test_half_a_screw_twice_is_the_whole_and_batches_are_single_twists(seed):
    twists = np.random.default_rng(seed).normal(size=(2, 3, 6))
    half, whole = rigid.transform_from_twist(twists / 2), rigid.transform_from_twist(twists)
    np.testing.assert_allclose(half @ half, whole, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(whole[1, 2], rigid.transform_from_twist(twists[1, 2]))
    np.testing.assert_allclose(rigid.transform_from_twist(-twists), rigid.inverse(whole), rtol=0, atol=1e-14)


@pytest.mark.parametrize("wxyz", [[0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 0]])
def test_a_quaternion_without_length_is_refused(wxyz):
    with pytest.raises(ValueError, match="finite length above zero"):
        rigid.rotation_from_quaternion(np.array(wxyz))


@given(seed=seeds)
@few
def test_nearest_rotation_is_a_fixed_point_and_never_mirrors(seed):
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    np.testing.assert_allclose(rigid.nearest_rotation(rotation), rotation, rtol=0, atol=1e-14)
    bent = rigid.nearest_rotation(rng.normal(size=(3, 3)))
    np.testing.assert_allclose(bent @ bent.T, np.eye(3), rtol=0, atol=1e-13)
    assert np.linalg.det(bent) > 0


def test_look_at_by_hand():
    # From +x towards the origin with z up: right is +y, down is -z, forward is -x.
    world_from_cam = rigid.look_at(np.array([2.0, 0, 0]), np.zeros(3), np.array([0, 0, 5.0]))
    expected = [[0, 0, -1, 2], [1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
    np.testing.assert_allclose(world_from_cam, expected, rtol=0, atol=1e-15)


@given(seed=seeds, parallel=st.booleans())
@few
def test_look_at_is_rigid_and_centres_the_target_even_with_up_along_the_view(seed, parallel):
    rng = np.random.default_rng(seed)
    centre, target = rng.normal(size=(2, 3))
    up = 3.0 * (target - centre) if parallel else rng.normal(size=3)
    world_from_cam = rigid.look_at(centre, target, up)
    rotation = world_from_cam[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), rtol=0, atol=1e-13)
    assert np.linalg.det(rotation) > 0
    seen = rigid.apply(rigid.inverse(world_from_cam), target)
    np.testing.assert_allclose(seen, np.array([0, 0, np.linalg.norm(target - centre)]), rtol=0, atol=1e-13)
    if not parallel:
        assert rotation[:, 1] @ up <= 1e-12  # +y of the camera is down


def test_look_at_needs_two_places():
    with pytest.raises(ValueError, match="apart from the centre"):
        rigid.look_at(np.ones(3), np.ones(3), np.array([0, 0, 1.0]))


@given(seed=seeds)
@few
def test_similarity_inverse_compose_and_matrix_agree(seed):
    rng = np.random.default_rng(seed)
    outer, inner, points = random_similarity(rng), random_similarity(rng), rng.normal(size=(9, 3))
    one_by_one = outer.apply(inner.apply(points))
    tolerance = 1e-13 * np.abs(one_by_one).max()
    np.testing.assert_allclose(outer.compose(inner).apply(points), one_by_one, rtol=0, atol=tolerance)
    back = outer.inverse().apply(outer.apply(points))
    np.testing.assert_allclose(back, points, rtol=0, atol=1e-12)
    homogeneous = np.concatenate([points, np.ones((9, 1))], axis=1) @ outer.matrix().T
    np.testing.assert_allclose(homogeneous[:, :3], outer.apply(points), rtol=0, atol=1e-13 * outer.scale * 10)
    # The translations that cancel are as large as this.
    tolerance = 1e-14 * max(1.0, np.abs(outer.translation).max())
    np.testing.assert_allclose(outer.compose(outer.inverse()).matrix(), np.eye(4), rtol=0, atol=tolerance)
    np.testing.assert_array_equal(Similarity.identity().matrix(), np.eye(4))


@given(seed=seeds)
@few
def test_similarity_survives_json_exactly(seed):
    similarity = random_similarity(np.random.default_rng(seed))
    back = Similarity.from_json(json.loads(json.dumps(similarity.to_json())))
    # The scale is read back to the bit; so are the arrays.
    assert back.scale == similarity.scale
    np.testing.assert_array_equal(back.rotation, similarity.rotation)
    np.testing.assert_array_equal(back.translation, similarity.translation)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"scale": 0.0}, "scale 0.0"),
        ({"scale": float("nan")}, "scale nan"),
        ({"scale": None}, "TypeError"),
        ({"rotation": [[1, 0], [0, 1]]}, r"rotation \(2, 2\)"),
        ({"rotation": (2 * np.eye(3)).tolist()}, "not orthonormal"),
        ({"rotation": (-np.eye(3)).tolist()}, "not orthonormal"),
        ({"translation": [0, 0, float("inf")]}, "not finite"),
    ],
)
def test_what_is_no_similarity_is_refused(change, what):
    content = Similarity.identity().to_json()
    with pytest.raises(UserError, match=what):
        Similarity.from_json({**content, **change})
    del content["scale"]
    with pytest.raises(UserError, match="KeyError: 'scale'"):
        Similarity.from_json(content)
