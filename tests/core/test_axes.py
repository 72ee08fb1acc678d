"""Frames by name and by letters: what they mean follows from where a walker's right, down and forward are."""

from itertools import permutations, product

import pytest
import torch
from scipy.spatial.transform import Rotation

from invgraphics.core.transforms import AXES, axes_to_opencv, opencv_to_axes
from invgraphics.errors import InputError

UP, RIGHT, FORWARD = torch.tensor([0.0, -1.0, 0.0]), torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("name", "up", "right", "forward"),
    [
        ("opencv", (0, -1, 0), (1, 0, 0), (0, 0, 1)),
        ("opengl", (0, 1, 0), (1, 0, 0), (0, 0, -1)),
        ("z-up", (0, 0, 1), (1, 0, 0), (0, 1, 0)),
        ("LUF", (0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    ],
)
def test_directions_arrive_where_they_belong(name: str, up, right, forward) -> None:
    rotation = axes_to_opencv(name)[:3, :3].float()
    for there, here in ((up, UP), (right, RIGHT), (forward, FORWARD)):
        assert torch.equal(rotation @ torch.tensor(there).float(), here)


def test_every_right_handed_frame_is_a_rotation_and_the_others_are_refused() -> None:
    pairs = ("RL", "UD", "FB")
    frames = ["".join(letters) for order in permutations(pairs) for letters in product(*order)]
    known = 0
    for frame in frames:
        columns = [{"R": RIGHT, "L": -RIGHT, "U": UP, "D": -UP, "F": FORWARD, "B": -FORWARD}[letter] for letter in frame]
        if torch.dot(torch.linalg.cross(columns[0], columns[1]), columns[2]) < 0:
            with pytest.raises(InputError, match="right-handed"):
                axes_to_opencv(frame)
            continue
        known += 1
        pose = axes_to_opencv(frame)
        matrix = pose[:3, :3].numpy()
        assert abs(Rotation.from_matrix(matrix).as_matrix() - matrix).max() < 1e-12
        assert torch.equal(opencv_to_axes(frame) @ pose, torch.eye(4, dtype=torch.float64))
        assert torch.equal(axes_to_opencv(frame.lower()), pose)
    assert (known, len(frames)) == (24, 48)
    assert set(AXES.values()) <= set(frames)


@pytest.mark.parametrize("name", ["", "blender", "RU", "RUX", "RRD", "RUBB", "RLU"])
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(InputError):
        axes_to_opencv(name)
