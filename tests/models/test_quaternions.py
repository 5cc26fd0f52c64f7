"""Quaternions of numeric rotation matrices."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from models.spatial import quaternion_from_rotation
from tests.models.robot.trees import Array


def near_half_turns() -> st.SearchStrategy[Array]:
    """Rotation vectors, many of them of half a turn about an axis, where other formulas divide by zero."""
    axes = arrays(float, 3, elements=st.floats(-1, 1)).filter(lambda v: np.linalg.norm(v) > 1e-3)
    plain = st.sampled_from([np.eye(3)[i] for i in range(3)])
    angles = st.one_of(st.floats(0, np.pi), st.just(np.pi), st.floats(-1e-7, 1e-7).map(lambda d: np.pi + d))
    return st.tuples(st.one_of(axes, plain), angles).map(lambda p: p[1] * p[0] / np.linalg.norm(p[0]))


@given(vectors=st.lists(near_half_turns(), min_size=1, max_size=5))
def test_quaternions_are_those_of_scipy(vectors: list[Array]) -> None:
    rotation = Rotation.from_rotvec(np.array(vectors))
    result = quaternion_from_rotation(rotation.as_matrix())
    assert result.shape == (len(vectors), 4)
    assert (result[:, 0] >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(result, axis=1), 1.0, atol=1e-14)
    again = Rotation.from_quat(np.roll(result, -1, axis=1)).as_matrix()
    np.testing.assert_allclose(again, rotation.as_matrix(), atol=1e-12)
    wanted = np.roll(rotation.as_quat(), 1, axis=1)
    same = np.abs(np.einsum("mi,mi->m", result, wanted))
    np.testing.assert_allclose(same, 1.0, atol=1e-12)


def test_no_rotation_and_half_turns_about_the_axes_are_exact() -> None:
    turns = np.array([np.eye(3), *(np.diag(2 * np.eye(3)[i] - 1) for i in range(3))])
    np.testing.assert_array_equal(quaternion_from_rotation(turns), np.eye(4))
    assert quaternion_from_rotation(np.zeros((0, 3, 3))).shape == (0, 4)
