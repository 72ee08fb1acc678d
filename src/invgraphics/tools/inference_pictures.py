"""Pictures of an inferred instance: its input, its hidden side and its normals, as they are and as each model shows them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch

from invgraphics.core import Model, Scene, View
from invgraphics.experiments.evaluate import display
from invgraphics.files import write_picture

TRUTH = "truth"
ROWS = ("input view", "hidden side", "normals of the hidden side")
"""Of a picture, from top to bottom."""


def hidden_view(scene: Scene, observed: View) -> View:
    """The test view of an instance that looks from the side opposite to an observed view."""
    forward = observed.camera.cam_to_world[:3, 2]
    own = [view for view in scene.test if view.subject == observed.subject]
    return min(own, key=lambda view: float(forward @ view.camera.cam_to_world[:3, 2]))


def draw_instance(path: Path, scene: Scene, models: Mapping[str, Model], observed: View) -> None:
    """Draw an instance in the rows of `ROWS`: the truth, then each model's reconstruction, hidden side and its normals."""
    from PIL import Image

    hidden = hidden_view(scene, observed)
    first = [view.over(scene.background) for view in (observed, hidden)]
    columns = [(*first, shown_normals(hidden.normal, first[1]))]
    for model in models.values():
        seen, picture = model.render(observed.camera, normals=False), model.render(hidden.camera)
        behind = picture.over(scene.background)
        columns.append((seen.over(scene.background), behind, shown_normals(picture.normal, behind)))
    upper, middle, lower = (torch.cat(row, dim=1) for row in zip(*columns, strict=True))
    rows = torch.cat([display(upper, scene), display(middle, scene), (lower.clamp(0, 1) * 255).round().to(torch.uint8)])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_picture(path, Image.fromarray(rows.numpy()), optimize=True)


def shown_normals(normal: torch.Tensor | None, like: torch.Tensor) -> torch.Tensor:
    """Normals as colours, (n + 1) / 2 over white; white where there are none."""
    if normal is None:
        return torch.ones_like(like)
    hit = normal.square().sum(dim=-1, keepdim=True) > 0
    return torch.where(hit, (normal + 1) / 2, 1.0)
