"""Plane sweep over training views: the colours that they show at each texel, and how well they agree (Collins 1996)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Camera, Scene, View
from invgraphics.core.compositing import layer_alphas_from_weights
from invgraphics.core.planes import homographies_to, warp

WHOLE = 0.999
"""Share of the pixels around a texel's image that must be valid (`View.mask`) for it to be seen."""
FEW = 2.0
"""Views that must see a texel for their agreement to count in full."""


@torch.no_grad()
def plane_sweep(
    scene: Scene, camera: Camera, depths: Float[Tensor, " p"], views: int, agreement: float
) -> tuple[Float[Tensor, "p 3 h w"], Float[Tensor, "p h w"]]:
    """Mean colour of the training views at each texel of planes, and opacities by their agreement.

    Along each ray of ``camera``, plane i gets the weight exp(-s_i / agreement), normalised over planes, where s_i is the
    standard deviation of the colour over the views that see the texel, plus ``agreement`` for each view short of `FEW`.

    Args:
        scene: its training views, in its colour space.
        camera: reference camera, as wide as the planes.
        depths: of the planes.
        views: most views that are used, evenly spaced among the training views.
        agreement: standard deviation at which a plane is 1/e as likely as at none.
    """
    count = min(views, len(scene.train))
    chosen = [scene.train[index * len(scene.train) // count] for index in range(count)]
    size = camera.width, camera.height
    total = torch.zeros(len(depths), 6, size[1], size[0])
    seen, colour = torch.zeros(len(depths), size[1], size[0]), torch.zeros(len(depths), 3, size[1], size[0])
    for view in chosen:
        layers = torch.cat([premultiplied(view), view.valid()[None].float()])
        maps = homographies_to(camera, depths, view.camera)
        for plane, to_view in enumerate(maps):
            values, inside, _ = warp(layers[None], to_view[None], size)
            rgb, alpha = values[0, :3], values[0, 3]
            counts = inside[0] * (values[0, 4] >= WHOLE)
            total[plane, :3] += counts * rgb
            total[plane, 3] += counts * alpha
            total[plane, 4] += counts * rgb.square().sum(dim=0) / 3
            seen[plane] += counts
    n = seen.clamp_min(1)
    colour = total[:, :3] / total[:, 3:4].clamp_min(1e-3)
    mean = total[:, :3] / n[:, None]
    variance = (total[:, 4] / n - mean.square().mean(dim=1)).clamp_min(0)
    disagreement = variance.sqrt() / agreement + (FEW - seen).clamp_min(0)
    weights = torch.softmax(-disagreement, dim=0) * (total[:, 3] / n)
    return colour.clamp(0, 1), layer_alphas_from_weights(weights)


def premultiplied(view: View) -> Float[Tensor, "4 h w"]:
    """Return a view's colour times alpha, and alpha, as a layer to warp."""
    alpha = view.opacity()
    return torch.cat([(view.colour() * alpha[..., None]).permute(2, 0, 1), alpha[None]])
