"""Exposure per photograph, optimised with the scene: a colour map of each training view, applied to its renderings.

Cameras choose exposure and white balance anew for every photograph. A field that must show all of them as they are explains the
differences by fog or by colours that change with the view. Scene and maps are known only up to a common map (a gauge): here the
training views' mean map is the identity, and held-out views, whose exposure is unknown, are shown under it.

Maps may follow other errors too, the more numbers they have. Gaussians, 600 steps at 128 px, one seed, on bricks, fence,
materials, fox and dtu_scan24, of which each photograph was given an exposure: PSNR rises with a spread of 0.6 stops by 0.6 to
1.5 dB (gains) and 0.3 to 1.6 (affine maps), with 0.3 stops by 0.1 to 0.8 (gains) and, on the first four, -0.5 to 0.2 (affine).
On colmap_statue, not chosen on, it rises by 1.5 and 1.0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from invgraphics.core import Rendering, Scene, Trace
from invgraphics.training.optimiser import GroupConfig, OptimiserConfig

LEAST_SPREAD = 0.1
"""Spread of a scene's exposures, in logarithms of display values, from which they are fitted unasked; 0.3 stops are 0.095.
Photographs under one exposure spread too, as surfaces shine: bonsai_photos 0.04, colmap_beer 0.06 (colmap_statue 0.21)."""


@dataclass(frozen=True)
class ExposureConfig:
    """Optimisation of an exposure per training view; the rates are those of 3DGS's exposure compensation.

    Attributes:
        optimise: whether exposures are optimised at all; for studies that compare with and without.
        model: ``gain``: a factor for each colour channel; ``affine``: a 3 x 4 map of colours (3DGS).
        lr: learning rate at the start.
        final: at the end.
    """

    optimise: bool = True
    model: Literal["gain", "affine"] = "gain"
    lr: float = 1e-2
    final: float = 1e-3

    def __post_init__(self) -> None:
        if not (self.lr > 0 and self.final > 0):
            raise ValueError("learning rates must be positive.")

    @property
    def note(self) -> str:
        """How held-out views are shown, for the table of the protocol."""
        map_kind = "affine map of colours" if self.model == "affine" else "gain per colour channel"
        return f"mean of the training views, of which each has its own {map_kind}; none is fitted to a held-out view"

    def optimiser(self, config: OptimiserConfig) -> OptimiserConfig:
        """The recipe's optimiser with a group for exposures."""
        return replace(config, groups=config.groups | {"exposures": GroupConfig("exposure", self.lr, self.final)})


class Exposures(nn.Module):
    """Colour maps of n training views, initially the identity; differentiable.

    A rendering's colour c becomes ``A c + b`` (``affine``) or ``g * c`` (``gain``), in the scene's colour space, before any
    background. Maps are relative to the mean of all views: of matrices and offsets, of gains the geometric mean.

    Args:
        config: settings.
        views: number of training views.
    """

    def __init__(self, config: ExposureConfig, views: int) -> None:
        super().__init__()
        self.config = config
        shape = (3, 4) if config.model == "affine" else (3,)
        # `forward` stacks all of them, so that Adam's momentum goes on moving the views that a step does not see, as in 3DGS:
        # a view is seen once in as many steps as there are views, and moved by those alone it is still on its way at the end.
        self.raw = nn.ParameterList([nn.Parameter(torch.zeros(shape)) for _ in range(views)])

    def forward(self) -> Float[Tensor, "n_plus_1 3 4"]:
        """Matrices ``[A | b]`` of all views, then the identity, which index -1 takes.

        The mean carries no gradient: it only shifts all views alike.
        """
        raw = torch.stack(list(self.raw))
        relative = raw - raw.detach().mean(dim=0)
        identity = torch.eye(3, 4, dtype=raw.dtype, device=raw.device)
        if self.config.model == "affine":
            maps = identity + relative
        else:
            maps = torch.nn.functional.pad(torch.diag_embed(relative.exp()), (0, 1))
        return torch.cat([maps, identity[None]])

    def expose(self, rendering: Rendering, trace: Trace, views: Int[Tensor, " n"] | int) -> tuple[Rendering, Trace]:
        """Apply the views' maps to a rendering and to the radiance of its trace, of which losses make further pictures.

        Args:
            rendering: premultiplied; packed rays (n,) for ``views`` of every ray, else a whole picture.
            trace: behind it.
            views: training views, -1 for none, which changes nothing.
        """
        maps = self()
        chosen = maps[views]
        rgb = torch.einsum("...ij,...j->...i", chosen[..., :3], rendering.rgb) + rendering.alpha[..., None] * chosen[..., 3]
        return replace(rendering, rgb=rgb), trace if isinstance(views, int) else _exposed(trace, chosen)


def _exposed(trace: Trace, maps: Float[Tensor, "n 3 4"]) -> Trace:
    """A trace of n packed rays, its levels included, with each ray's map applied to the radiance of its samples."""
    levels = tuple(_exposed(level, maps) for level in trace.levels)
    if trace.samples is None or trace.values is None or trace.values.radiance is None:
        return replace(trace, levels=levels)
    of_sample = maps[trace.samples.ray]
    radiance = torch.einsum("mij,mj->mi", of_sample[..., :3], trace.values.radiance) + of_sample[..., 3]
    return replace(trace, levels=levels, values=replace(trace.values, radiance=radiance))


def exposure_config(chosen: ExposureConfig | None, scene: Scene) -> ExposureConfig | None:
    """Select a fit's settings of exposures; ``None`` to fit none.

    Args:
        chosen: of the recipe. Without any, exposures are fitted where the scene's photographs differ in them.
        scene: to fit.
    """
    config = ExposureConfig() if chosen is None and (scene.exposure_spread or 0.0) >= LEAST_SPREAD else chosen
    return config if config is not None and config.optimise else None


def make_exposures(chosen: ExposureConfig | None, scene: Scene) -> Exposures | None:
    """Exposures of the training views as parameters; ``None`` where none are fitted (see `exposure_config`)."""
    config = exposure_config(chosen, scene)
    return None if config is None else Exposures(config, len(scene.train))
