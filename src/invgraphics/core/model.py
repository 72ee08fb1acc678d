"""A model: a field and the renderer through which it is seen, checked against each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from invgraphics.core.believable import check_pose
from invgraphics.core.bounds import Bounds
from invgraphics.core.camera import Camera
from invgraphics.core.contributions import Contributions
from invgraphics.core.field import Field, Gaussians, Quantity
from invgraphics.core.finite import describe_non_finite
from invgraphics.core.renderer import Renderer, check
from invgraphics.core.rendering import Context, Rendering
from invgraphics.errors import InputError


@dataclass(frozen=True, eq=False)
class Model:
    """A field seen through a renderer: what a fit fits, and what renders pictures afterwards.

    Attributes:
        field: the scene's parameterisation.
        renderer: what makes pictures of it.
        bounds: the region that the field describes, local frame.

    Raises:
        NotComposableError: the renderer needs a quantity that the field does not provide.

    Example:
        >>> from invgraphics.core import Model
        >>> from invgraphics.renderers.samplers import StratifiedConfig
        >>> from invgraphics.renderers.volumetric import VolumetricConfig
        >>> from invgraphics.testing import TwoBalls, toy_scene
        >>> scene = toy_scene(views=2, size=8)
        >>> model = Model(TwoBalls(), VolumetricConfig(StratifiedConfig(32)).build(scene), scene.bounds)
        >>> model.render(scene.test[0].camera).rgb.shape
        torch.Size([8, 8, 3])
    """

    field: Field
    renderer: Renderer
    bounds: Bounds

    def __post_init__(self) -> None:
        check(self.field, self.renderer)

    @property
    def device(self) -> torch.device:
        """Where the model's tensors are."""
        return self.bounds.lo.device

    @property
    def parts(self) -> dict[str, nn.Module]:
        """``field`` and ``renderer`` by name, as checkpoints and optimisers know them."""
        return {"field": self.field, "renderer": self.renderer}

    @torch.no_grad()
    def render(self, camera: Camera, *, normals: bool = True) -> Rendering:
        """Render a picture as evaluation does: without randomness or gradients.

        Args:
            camera: on any device, in any precision; the picture is returned on the same device, in the model's.
            normals: whether normals are rendered, where the model has some; without them a picture can be faster.

        Returns:
            Premultiplied colour in the scene's colour space, alpha, depth in local units and normals, (height, width).
        """
        rendering, _ = self.renderer.render_image(self.field, self._like_model(camera), self.context(normals=normals))
        return rendering.detach().to(camera.focal.device)

    def _like_model(self, camera: Camera) -> Camera:
        """The camera on the model's device, in its precision.

        Raises:
            InputError: it is no camera, has no size, or a pose that is not rigid.
        """
        if not isinstance(camera, Camera):
            raise InputError(f"A {type(camera).__name__} is no camera.", "That of a view is view.camera.")
        check_pose(camera, "the camera")
        return camera.to(self.device).to(self.bounds.lo.dtype)

    @torch.no_grad()
    def contributions(self, camera: Camera, pixel: tuple[int, int]) -> Contributions:
        """Everything that `render` composites into one pixel.

        Args:
            camera: on any device, in any precision; the contributions are returned on the same device.
            pixel: column and row, from 0.

        Raises:
            NotComposableError: the renderer has no per-ray contributions to list.
        """
        found = self.renderer.contributions(self.field, self._like_model(camera), pixel, self.context())
        return found.to(camera.focal.device)

    @torch.no_grad()
    def gaussians(self) -> Gaussians:
        """The field's Gaussians, activated and smoothed as the renderer reads them.

        Raises:
            NotComposableError: it is not made of Gaussians.
        """
        return self.field.primitives(Quantity.GAUSSIANS, self.context())

    def context(self, *, normals: bool = False) -> Context:
        """The circumstances of an evaluation; ``normals`` as for `render`."""
        return Context(self.bounds, training=False, geometry=normals)

    def describe_non_finite(self) -> str:
        """Describe parameters, buffers and activated Gaussians that are NaN or infinite; empty if all are finite."""
        parts = self.state_dict()
        if Quantity.GAUSSIANS in self.field.provides:
            parts["gaussians"] = {name: value for name, value in vars(self.gaussians()).items() if isinstance(value, Tensor)}
        return describe_non_finite(parts)

    def to(self, device: torch.device | str) -> Model:
        """Move the model's tensors; modules move in place, as torch's do."""
        return Model(self.field.to(device), self.renderer.to(device), self.bounds.to(device))

    def state_dict(self) -> dict[str, dict[str, Tensor]]:
        """All tensors of `parts`, by part, as checkpoints hold them."""
        return {name: dict(part.state_dict()) for name, part in self.parts.items()}

    def load_state_dict(self, state: Mapping[str, Mapping[str, Any]]) -> None:
        """Take over the tensors of a `state_dict` or of a checkpoint, which may hold more than a model.

        Raises:
            RuntimeError: they do not fit.
        """
        for name, part in self.parts.items():
            part.load_state_dict(state.get(name, {}))
