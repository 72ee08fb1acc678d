"""Alignment and errors of poses, against pycolmap's estimator, scipy's rotations and known similarities."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from invgraphics.metrics.poses import align_poses, align_similarity, camera_extent, pose_errors, rotation_angle


def poses(centres: np.ndarray, seed: int = 0) -> torch.Tensor:
    result = np.tile(np.eye(4), (len(centres), 1, 1))
    result[:, :3, :3] = Rotation.random(len(centres), random_state=np.random.default_rng(seed)).as_matrix()
    result[:, :3, 3] = centres
    return torch.from_numpy(result)


def seen_elsewhere(true: torch.Tensor, scale: float = 0.3, seed: int = 5) -> torch.Tensor:
    """The same cameras in a world of another origin, orientation and unit."""
    rng = np.random.default_rng(seed)
    turn, shift = torch.from_numpy(Rotation.random(random_state=rng).as_matrix()), torch.from_numpy(rng.normal(size=3))
    moved = true.clone()
    moved[:, :3, :3] = turn @ true[:, :3, :3]
    moved[:, :3, 3] = scale * true[:, :3, 3] @ turn.T + shift
    return moved


LINE = np.outer(np.linspace(-1, 1, 7), [0.3, -0.2, 0.9])
LAYOUTS = {
    "cloud": np.random.default_rng(1).normal(size=(9, 3)),
    "plane": np.random.default_rng(2).normal(size=(9, 3)) * [1, 1, 0],
    "line": LINE,
    "nearly a line": LINE + 1e-9 * np.random.default_rng(3).normal(size=LINE.shape),
    "pair": LINE[[0, -1]],
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_similarity_is_found_whatever_the_layout(layout: str) -> None:
    true = poses(LAYOUTS[layout])
    errors = pose_errors(seen_elsewhere(true), true)
    assert float(errors.rotation_degrees.max()) < 1e-5
    assert float(errors.translation_per_cent.max()) < 1e-5
    assert errors.scale == pytest.approx(1 / 0.3)


@pytest.mark.parametrize("count", [1, 5])
def test_cameras_in_one_place_are_aligned_by_their_orientations(count: int) -> None:
    true = poses(np.tile([0.5, -2.0, 7.0], (count, 1)))
    errors = pose_errors(seen_elsewhere(true), true)
    assert float(errors.rotation_degrees.max()) < 1e-5
    assert float(errors.translation_per_cent.max()) < 1e-5
    assert (errors.scale, errors.extent) == (1.0, 1.0)


def test_noisy_centres_are_aligned_as_pycolmap_does() -> None:
    import pycolmap

    rng = np.random.default_rng(4)
    source = rng.normal(size=(30, 3))
    target = 2.5 * source @ Rotation.random(random_state=rng).as_matrix().T + [1, 2, 3] + 0.1 * rng.normal(size=(30, 3))
    ours = align_similarity(torch.from_numpy(source), torch.from_numpy(target))
    theirs = pycolmap.estimate_sim3d(source, target)
    np.testing.assert_allclose(ours.matrix[:3].numpy(), theirs.matrix(), atol=1e-9)


def test_mirrored_centres_still_give_a_rotation() -> None:
    source = torch.from_numpy(LAYOUTS["cloud"])
    similarity = align_similarity(source, source * source.new_tensor([1, 1, -1]))
    assert float(torch.linalg.det(similarity.rotation)) == pytest.approx(1)


def test_errors_are_those_that_were_put_in() -> None:
    """Turned by known angles about random axes; symmetric shifts, which no alignment can absorb."""
    rng = np.random.default_rng(6)
    angles = np.array([1e-7, 1e-3, 5.0, 90.0, 179.999, 180.0])
    octahedron = np.concatenate([np.eye(3), -np.eye(3)]) * 2
    true = poses(octahedron)
    axes = rng.normal(size=(6, 3))
    axes *= np.radians(angles)[:, None] / np.linalg.norm(axes, axis=1, keepdims=True)
    estimated = true.clone()
    estimated[:, :3, :3] = true[:, :3, :3] @ torch.from_numpy(Rotation.from_rotvec(axes).as_matrix())
    errors = pose_errors(seen_elsewhere(estimated), true)
    np.testing.assert_allclose(errors.rotation_degrees.numpy(), angles, rtol=1e-6, atol=1e-9)
    assert float(errors.translation_per_cent.max()) < 1e-9
    # One opposite pair 10% further out: the scale takes a part, s = Σ a·b / Σ a·a, and known shifts remain.
    estimated[[0, 3], :3, 3] *= 1.1
    scale = (2 * 1.1 + 4) / (2 * 1.21 + 4)
    errors = pose_errors(estimated, true, extent=2.0)
    expected = 100 * np.abs(scale * np.array([1.1, 1, 1, 1.1, 1, 1]) - 1)
    np.testing.assert_allclose(errors.translation_per_cent.numpy(), expected, atol=1e-9)
    summary = errors.summary()
    assert summary["rotation_degrees"]["max"] == pytest.approx(180)
    assert summary["rotation_degrees"]["median"] == pytest.approx(47.5)
    assert summary["cameras"] == 6


def test_orientations_break_the_tie_of_a_line_only() -> None:
    """With a real width the centres decide alone, as Umeyama has it."""
    true = poses(LAYOUTS["cloud"])
    estimated = true.clone()
    estimated[:, :3, :3] = poses(LAYOUTS["cloud"], seed=8)[:, :3, :3]
    np.testing.assert_allclose(align_poses(estimated, true).matrix.numpy(), np.eye(4), atol=1e-12)


def test_extent_is_that_of_a_scene() -> None:
    true = poses(np.array([[0, 0, 0], [4.0, 0, 0]]))
    assert camera_extent(true) == pytest.approx(2.2)


@pytest.mark.parametrize("count", [1, 3, 10])
def test_a_tripod_s_extent_is_one_unit(count: int) -> None:
    """The mean of equal numbers is off by a rounding error, which is no extent."""
    true = poses(np.tile([0.1, 0.2, 0.3], (count, 1)))
    assert camera_extent(true) == 1.0


def test_angles_agree_with_scipy() -> None:
    first, second = Rotation.random(20, random_state=1), Rotation.random(20, random_state=2)
    angles = rotation_angle(torch.from_numpy(first.as_matrix()), torch.from_numpy(second.as_matrix()))
    np.testing.assert_allclose(angles.numpy(), np.degrees((first * second.inv()).magnitude()), atol=1e-9)


def test_different_counts_are_refused() -> None:
    with pytest.raises(ValueError, match="cannot align"):
        align_similarity(torch.zeros(3, 3), torch.zeros(2, 3))
