"""Pose conversions against matrices written by hand, and the Lie group against scipy."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from invgraphics.core import transforms as tf

# One camera, written down five times by hand: it stands at (1, 2, 5), looks along -z, and world +y is up in its picture.
OPENCV = [[1, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 5], [0, 0, 0, 1]]  # columns: right, down, forward
OPENGL = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 5], [0, 0, 0, 1]]  # right, up, back
MITSUBA = [[-1, 0, 0, 1], [0, 1, 0, 2], [0, 0, -1, 5], [0, 0, 0, 1]]  # left, up, forward
LLFF = [[0, 1, 0, 1], [-1, 0, 0, 2], [0, 0, 1, 5]]  # down, right, back
COLMAP = [[1, 0, 0, -1], [0, -1, 0, 2], [0, 0, -1, 5]]  # world to camera: (1, 2, 5) goes to zero, -z to +z

PAIRS = {
    "opengl": (tf.opengl_to_opencv, tf.opencv_to_opengl, OPENGL),
    "mitsuba": (tf.mitsuba_to_opencv, tf.opencv_to_mitsuba, MITSUBA),
    "llff": (tf.llff_to_opencv, tf.opencv_to_llff, LLFF),
    "colmap": (tf.colmap_to_opencv, tf.opencv_to_colmap, COLMAP),
}


def matrix(rows: list[list[float]]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def random_pose(seed: int) -> torch.Tensor:
    rotation = Rotation.random(random_state=seed).as_matrix()
    translation = np.random.default_rng(seed).normal(size=3)
    return torch.from_numpy(np.block([[rotation, translation[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]))


@pytest.mark.parametrize("name", PAIRS)
def test_known_camera(name: str) -> None:
    to_opencv, from_opencv, theirs = PAIRS[name]
    torch.testing.assert_close(to_opencv(matrix(theirs)), matrix(OPENCV))
    torch.testing.assert_close(from_opencv(matrix(OPENCV)), matrix(theirs))


@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize("seed", range(3))
def test_round_trip_keeps_handedness_and_position(name: str, seed: int) -> None:
    to_opencv, from_opencv, _ = PAIRS[name]
    pose = random_pose(seed)
    back = to_opencv(from_opencv(pose))
    torch.testing.assert_close(back, pose)
    assert float(torch.linalg.det(from_opencv(pose)[:3, :3])) == pytest.approx(1.0)
    if name != "colmap":
        torch.testing.assert_close(from_opencv(pose)[:3, 3], pose[:3, 3])


def test_look_at_puts_target_ahead_and_up_upwards() -> None:
    eye, target, up = matrix([[2, -3, 1], [0.5, 0, 0.2], [0, 0, 1]])
    pose = tf.look_at(eye, target, up)
    x, y, z = np.linalg.inv(pose.numpy())[:3, :3] @ (target - eye).numpy()
    assert abs(x) < 1e-12
    assert abs(y) < 1e-12
    assert z == pytest.approx(float((target - eye).norm()))
    assert float(pose[:3, 1] @ up) < 0, "+y is down"
    assert float(pose[:3, 0] @ up) == pytest.approx(0, abs=1e-12), "the horizon is level"
    assert float(torch.linalg.det(pose[:3, :3])) == pytest.approx(1.0)


@pytest.mark.parametrize("up", [[0.0, 0, 1], [0.0, 2, 0], [1.0, 1, 1]])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_look_at_along_up_is_a_camera_too(up: list[float], side: float) -> None:
    target = torch.tensor([0.3, 0.1, 0.2])
    eye = target + side * torch.tensor(up)
    pose = tf.look_at(eye, target, torch.tensor(up))
    torch.testing.assert_close(pose[:3, :3].T @ pose[:3, :3], torch.eye(3))
    assert float(torch.linalg.det(pose[:3, :3])) == pytest.approx(1.0)
    torch.testing.assert_close(pose[:3, 2], torch.nn.functional.normalize(target - eye, dim=0))


def test_similarity_moves_cameras_like_points() -> None:
    """What a camera sees does not change when camera and world move together."""
    pose, motion = random_pose(1), random_pose(2)
    similarity = motion.clone()
    similarity[:3, :3] *= 2.5
    moved = tf.apply_similarity(similarity, pose)
    assert float(torch.linalg.det(moved[:3, :3])) == pytest.approx(1.0)
    point = np.array([0.3, -1.2, 4.0])
    before = np.linalg.inv(pose.numpy()) @ [*point, 1]
    world = similarity.numpy() @ [*point, 1]
    after = np.linalg.inv(moved.numpy()) @ world
    np.testing.assert_allclose(after[:3], 2.5 * before[:3])
    torch.testing.assert_close(tf.transform_points(similarity, torch.from_numpy(point)), torch.from_numpy(world[:3]))


def test_quaternions_match_scipy() -> None:
    rotations = Rotation.random(20, random_state=0)
    x, y, z, w = rotations.as_quat().T
    ours = tf.quaternion_to_matrix(torch.from_numpy(np.stack([w, x, y, z], axis=1) * 3.7))
    np.testing.assert_allclose(ours.numpy(), rotations.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.3, 3.0])
def test_se3_exp_matches_scipy(size: float) -> None:
    twist = torch.tensor([0.6, -0.3, 0.74, 0.5, -2.0, 0.1], dtype=torch.float64) * size
    wx, wy, wz, vx, vy, vz = twist.tolist()
    generator = np.array([[0, -wz, wy, vx], [wz, 0, -wx, vy], [-wy, wx, 0, vz], [0, 0, 0, 0]])
    pose = tf.se3_exp(twist).numpy()
    np.testing.assert_allclose(pose, expm(generator), atol=1e-12)
    np.testing.assert_allclose(pose[:3, :3], Rotation.from_rotvec([wx, wy, wz]).as_matrix(), atol=1e-12)


def test_se3_exp_has_gradients_at_zero() -> None:
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(tf.se3_exp, (twist,))


def test_focal_from_fov() -> None:
    """A point at the edge of the field of view falls on the edge of the picture."""
    focal = tf.focal_from_fov(math.radians(50), 640)
    assert focal * math.tan(math.radians(25)) == pytest.approx(320)
