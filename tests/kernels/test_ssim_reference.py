"""SSIM as a loss, against scikit-image and finite differences."""

import numpy as np
import torch
from skimage.metrics import structural_similarity

from invgraphics.kernels import reference


def test_equals_scikit_image() -> None:
    """Black borders wider than the window make zero padding and scikit-image's mirroring the same thing."""
    image, target = (torch.nn.functional.pad(torch.rand(20, 31, 3).double(), (0, 0, 12, 12, 12, 12)) for _ in range(2))
    target[20:30] = image[20:30]
    expected, per_pixel = structural_similarity(
        image.numpy(),
        target.numpy(),
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )
    assert abs(float(expected) - float(reference.ssim(image, target))) > 1e-4  # skimage's own mean leaves the rim out
    np.testing.assert_allclose(float(reference.ssim(image, target)), per_pixel.mean(), atol=1e-9)


def test_equal_images_score_one() -> None:
    image = torch.rand(16, 12, 3)
    torch.testing.assert_close(reference.ssim(image, image), torch.tensor(1.0))


def test_gradient() -> None:
    image, target = torch.rand(9, 14, 3).double().requires_grad_(), torch.rand(9, 14, 3).double()
    assert torch.autograd.gradcheck(lambda x: reference.ssim(x, target), (image,))
