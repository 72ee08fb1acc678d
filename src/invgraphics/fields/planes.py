"""A multi-plane image as a field: RGBA planes before a reference camera, with NeX's view dependence as an option."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from invgraphics.core import Camera, Context, Field, FieldValues, Planes, Quantity, Samples, Scene
from invgraphics.core.compositing import layer_alphas_from_weights
from invgraphics.core.field import resize_to_stored
from invgraphics.core.planes import WIDEST, inverse_depths, mean_camera, widened, widest_angle
from invgraphics.errors import InputError, NotComposableError
from invgraphics.fields.mlp import Mlp
from invgraphics.fields.plane_sweep import plane_sweep

EPS = 1e-4
"""Colours and opacities are kept this far from 0 and 1 before their logit is taken."""
POINT_SHARE = 1e-3
"""Share of the scene's points that may lie before the nearest plane, and behind the farthest."""
FAR_RATIO = 100.0
"""Farthest over nearest depth where the scene has neither points nor a box (Zhou et al. 2018: planes from 1 to 100)."""
BASIS_OCTAVES = 3


@dataclass(frozen=True)
class PlanesConfig:
    """Settings of a multi-plane image and its initialisation.

    Attributes:
        count: number of planes, evenly spaced in inverse depth.
        near: depth of the first plane, local units; 0 takes the scene's (its points, its box, or its near bound).
        far: depth of the last one; 0 takes the scene's.
        margin: most by which planes exceed the reference camera's picture on either side, in widths or heights of it.
        texels: texels per pixel of the training pictures.
        init: ``sweep`` starts from a plane sweep (Collins 1996): each texel is the mean of the training views' colours there,
            as opaque as these agree; ``uniform`` is grey, and every plane contributes alike.
        sweep_views: most training views of the sweep, evenly spaced.
        agreement: standard deviation of colours over views at which a texel counts 1/e of one whose views agree.
        basis: basis functions of the viewing direction (NeX has 8); 0 for colour without view dependence.
        basis_width: width of the network that they come from.
        basis_texels: coefficients of the basis per texel along each edge.
    """

    title: ClassVar[str] = "multi-plane image"

    count: int = 32
    near: float = 0.0
    far: float = 0.0
    margin: float = 0.5
    texels: float = 1.0
    init: Literal["sweep", "uniform"] = "sweep"
    sweep_views: int = 16
    agreement: float = 0.05
    basis: int = 0
    basis_width: int = 32
    basis_texels: float = 0.25

    def __post_init__(self) -> None:
        if self.count < 2 or self.sweep_views < 1:
            raise ValueError("a multi-plane image has at least 2 planes, and a sweep at least 1 view.")
        if min(self.near, self.far, self.margin, self.basis) < 0 or (self.far and self.far <= self.near):
            raise ValueError("near, far, margin and basis must not be negative, and far must exceed near.")
        if min(self.texels, self.agreement, self.basis_texels, self.basis_width) <= 0:
            raise ValueError("texels, agreement, basis_texels and basis_width must be positive.")

    def build(self, scene: Scene) -> PlaneField:
        """Place the planes before the mean of the training cameras, and initialise them.

        Raises:
            InputError: the cameras do not look one way, or there is no room for planes before them.
        """
        camera, depths = self.placed(scene)
        shape = (self.count, camera.height, camera.width)
        if self.init == "sweep":
            rgb, alpha = plane_sweep(scene, camera, depths, self.sweep_views, self.agreement)
        else:
            rgb = torch.full((self.count, 3, *shape[1:]), 0.5)
            alpha = layer_alphas_from_weights(torch.full(shape, 1 / self.count))
        return self.from_planes(Planes(camera, depths, rgb, alpha))

    def placed(self, scene: Scene) -> tuple[Camera, Float[Tensor, " p"]]:
        """Reference camera, widened to hold what the training views see, and depths of the planes.

        Raises:
            InputError: as `build`.
        """
        cameras = [view.camera for view in scene.train]
        angle = widest_angle(cameras)
        if angle > WIDEST:
            raise InputError(
                f"The cameras of scene '{scene.name}' look up to {angle:.0f} degrees away from their mean direction: "
                f"planes before one camera show them nothing.",
                f"A multi-plane image needs views from one side, within {WIDEST:.0f} degrees, as those of 'shelf' or of LLFF.",
            )
        reference = mean_camera(cameras)
        near, far = depth_span(scene, reference)
        near, far = self.near or near, self.far or far
        if not 0 < near < far:
            remedy = "Set field.near and field.far to distances along the mean viewing direction."
            raise InputError(f"Planes of scene '{scene.name}' cannot range from {near:.3g} to {far:.3g}.", remedy)
        width, height = (max(1, round(self.texels * edge)) for edge in (reference.width, reference.height))
        wide = widened(reference.resized(width, height), cameras, (near, far), self.margin)
        return wide, inverse_depths(near, far, self.count).to(wide.focal)

    def from_planes(self, planes: Planes) -> PlaneField:
        """A field that starts as ``planes``, without view dependence."""
        camera = planes.camera
        tensors = {
            "rgb_logits": planes.rgb.clamp(EPS, 1 - EPS).logit(),
            "alpha_logits": planes.alpha.clamp(EPS, 1 - EPS).logit(),
        }
        network = None
        if self.basis:
            rows, columns = (max(2, round(self.basis_texels * edge)) for edge in (camera.height, camera.width))
            tensors["coefficients"] = torch.zeros(len(planes), self.basis, 3, rows, columns)
            inputs = 3 * (2 * BASIS_OCTAVES + 1)
            network = Mlp(inputs=inputs, layers=2, width=self.basis_width, outputs=self.basis)
        return PlaneField(camera, planes.depths, tensors, network)


def depth_span(scene: Scene, reference: Camera) -> tuple[float, float]:
    """Nearest and farthest depth along the reference camera's axis of what a scene shows, beyond all its training cameras.

    From the scene's points, else from the corners of its box; in endless space without points, from its near bound to
    `FAR_RATIO` times that.
    """
    reference = reference.to(torch.float64)
    ahead = max(float(reference.project(view.camera.position.double()[None])[1]) for view in scene.train)
    least = ahead + scene.bounds.near
    if scene.points is not None and len(scene.points):
        z = reference.project(scene.points.position.double())[1]
        z = z[z > least]
        if len(z) > 1:
            near, far = np.quantile(z.numpy(), (POINT_SHARE, 1 - POINT_SHARE))  # torch's takes 16 million numbers at most
            return 0.98 * float(near), 1.02 * float(far)
    if scene.bounds.space == "contracted":
        return least, FAR_RATIO * least
    corners = torch.cartesian_prod(*torch.stack([scene.bounds.lo, scene.bounds.hi], dim=1).double())
    z = reference.project(corners)[1]
    return max(least, float(z.min())), float(z.max())


class FixedPlanes(Field):
    """Field of constant planes, for rendering without fitting."""

    provides = Quantity.PLANES

    def __init__(self, planes: Planes) -> None:
        super().__init__()
        self._planes = planes

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """Refuse pointwise queries: this field has planes only."""
        raise NotComposableError(f"FixedPlanes has no {want.words()} at points.", "It provides planes.")

    def primitives(self, want: Quantity, ctx: Context) -> Planes:
        """The planes."""
        return self._planes if want == Quantity.PLANES else super().primitives(want, ctx)


class PlaneField(Field):
    """p planes of w x h texels. Parameters are stored before activation (a sigmoid); `primitives` activates them.

    Args:
        camera: reference camera, of the planes' size.
        depths: of the planes along its axis, ascending.
        tensors: ``rgb_logits`` (p, 3, h, w), ``alpha_logits`` (p, h, w), and where there is a basis ``coefficients``
            (p, k, 3, i, j).
        basis: network of the encoded viewing direction, where there is one.
    """

    provides = Quantity.PLANES
    rgb_logits: Tensor
    alpha_logits: Tensor
    coefficients: Tensor | None
    pose: Tensor
    focal: Tensor
    centre: Tensor
    depths: Tensor

    def __init__(
        self, camera: Camera, depths: Float[Tensor, " p"], tensors: dict[str, Tensor], basis: Mlp | None = None
    ) -> None:
        super().__init__()
        for name in ("rgb_logits", "alpha_logits", "coefficients"):
            setattr(self, name, nn.Parameter(tensors[name].contiguous()) if name in tensors else None)
        self.basis = basis
        self.register_buffer("pose", camera.cam_to_world.detach().clone())
        self.register_buffer("focal", camera.focal.detach().clone())
        self.register_buffer("centre", camera.principal_point.detach().clone())
        self.register_buffer("depths", depths.detach().clone())

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Resize to the checkpoint's texels first, whose number follows from the points that a fit had."""
        for name in ("rgb_logits", "alpha_logits", "coefficients"):
            stored, parameter = state_dict.get(prefix + name), getattr(self, name)
            if isinstance(stored, Tensor) and parameter is not None and stored.shape[0] == parameter.shape[0]:
                resize_to_stored(parameter, stored)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    @property
    def camera(self) -> Camera:
        """The reference camera."""
        height, width = self.alpha_logits.shape[1:]
        return Camera(self.pose, self.focal, self.centre, width, height)

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """Refuse pointwise queries: opacity is on the planes only, where a density would be infinite."""
        raise NotComposableError(f"PlaneField has no {want.words()} at points.", "It provides planes.")

    def primitives(self, want: Quantity, ctx: Context) -> Planes:
        """The activated planes."""
        if want != Quantity.PLANES:
            return super().primitives(want, ctx)
        basis = None if self.basis is None else self.evaluate_basis
        return Planes(
            self.camera, self.depths, self.rgb_logits.sigmoid(), self.alpha_logits.sigmoid(), self.coefficients, basis
        )

    def primitive_count(self) -> int:
        """Number of texels."""
        return self.alpha_logits.numel()

    def evaluate_basis(self, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n k"]:
        """Basis functions of unit directions in the reference camera's axes, in [-1, 1]."""
        assert self.basis is not None
        scales = torch.pi * 2.0 ** torch.arange(BASIS_OCTAVES, dtype=directions.dtype, device=directions.device)
        phase = (directions[:, :, None] * scales).flatten(1)
        return self.basis(torch.cat([directions, phase.sin(), phase.cos()], dim=1)).tanh()
