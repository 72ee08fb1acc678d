"""Gaussians under a similarity: covariances and colours by their definitions, and back again."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from invgraphics.core import Gaussians, harmonics
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.errors import InputError
from invgraphics.fields.similarity import transform_gaussians

ROTATION = torch.from_numpy(Rotation.random(random_state=1).as_matrix())
SIMILARITY = torch.eye(4, dtype=torch.float64)
SIMILARITY[:3, :3], SIMILARITY[:3, 3] = 2.5 * ROTATION, torch.tensor([1.0, -2.0, 0.5])


def _gaussians(count: int = 30) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 9, 3))
    means, quaternions, scales, opacities, sh = (torch.randn(s, generator=generator, dtype=torch.float64) for s in shapes)
    return Gaussians(means, quaternions, (0.3 * scales).exp(), opacities.sigmoid(), sh)


def _covariance(gaussians: Gaussians) -> torch.Tensor:
    axes = quaternion_to_matrix(gaussians.quaternions) * gaussians.scales[:, None, :]
    return axes @ axes.mT


def test_covariances_and_colours_go_along_and_come_back() -> None:
    before = _gaussians()
    after = transform_gaussians(before, SIMILARITY)
    torch.testing.assert_close(after.means, 2.5 * before.means @ ROTATION.T + SIMILARITY[:3, 3])
    torch.testing.assert_close(_covariance(after), 2.5**2 * ROTATION @ _covariance(before) @ ROTATION.T)
    assert torch.equal(after.opacities, before.opacities)
    direction = torch.nn.functional.normalize(torch.randn(30, 3, dtype=torch.float64), dim=1)
    seen = harmonics.evaluate(after.sh, direction @ ROTATION.T)
    torch.testing.assert_close(seen, harmonics.evaluate(before.sh, direction))
    back = transform_gaussians(after, torch.linalg.inv(SIMILARITY))
    torch.testing.assert_close(back.means, before.means)
    torch.testing.assert_close(_covariance(back), _covariance(before))
    torch.testing.assert_close(back.sh, before.sh)


@pytest.mark.parametrize("diagonal", [(1.0, 1, -1, 1), (1.0, 2, 1, 1), (0.0, 0, 0, 1)])
def test_other_matrices_are_refused(diagonal: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="similarity"):
        transform_gaussians(_gaussians(3), torch.diag(torch.tensor(diagonal, dtype=torch.float64)))
