"""Batches of training pixels: random rays of several views or one whole view, over the step's background."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.core import Batch, Camera, Rays, Scene, View
from invgraphics.core.camera import rays_through
from invgraphics.scenes.scales import resized_view
from invgraphics.training.views.pixels import RandomPixels


@dataclass(frozen=True)
class BatchConfig:
    """Size and image scale of a step's batch.

    Attributes:
        rays: rays of a step, for ray renderers. With ``samples`` set it is only the start.
        views: most views that one step's rays come from.
        samples: target number of samples per step: the ray count follows what is kept (Instant-NGP); 0 keeps ``rays``.
        resolution: image scale of each phase of the fit; the last should be 1.
        until: progress at which each phase but the last ends; one fewer than ``resolution``.
        start_size: longest edge in pixels near which a fit begins where its photographs are larger: these are halved while
            that brings them closer to it (on a logarithmic scale), and doubled step by step; 0 begins with all pixels. Steps
            on small pictures are cheap, so that a short budget holds many (Kerbl et al. 2023, section 7.1, begin at a quarter).
        start_until: progress from which on all pixels are fitted; each size before has an equal part of what precedes.
        foreground: share of the rays that are drawn among the pixels with alpha, where a view has such: what is small in
            its pictures is otherwise learnt from few rays, and a field that begins with empty space may stay empty.
        foreground_least: least share of a view's rays that meet pixels with alpha. Where an object fills more of its
            pictures than that, all pixels are drawn alike.
        foreground_until: progress at which both end, and rays are drawn from all pixels alike. It is early that a field
            can become empty for good; NeRF's own code crops the pictures to their middle at first, for the same reason.
        opaque: whether opaque photographs of an unbounded scene are fitted over a random background too: every ray must then
            end at a surface, and dark surfaces cannot be learnt as empty space.
    """

    rays: int = 1024
    views: int = 32
    samples: int = 0
    resolution: tuple[float, ...] = (1.0,)
    until: tuple[float, ...] = ()
    start_size: int = 0
    start_until: float = 0.5
    opaque: bool = False
    foreground: float = 0.0
    foreground_least: float = 0.0
    foreground_until: float = 1.0

    def __post_init__(self) -> None:
        if self.rays < 1 or self.views < 1 or self.samples < 0:
            raise ValueError("'rays' and 'views' must be at least 1, 'samples' at least 0.")
        if len(self.until) != len(self.resolution) - 1 or list(self.until) != sorted(self.until):
            raise ValueError("'until' must hold one rising progress value fewer than 'resolution' has entries.")
        if not all(0 < scale <= 1 for scale in self.resolution):
            raise ValueError("'resolution' must hold scales in (0, 1].")
        if self.start_size < 0 or not 0 < self.start_until <= 1:
            raise ValueError("'start_size' must be at least 0, and 'start_until' in (0, 1].")
        for name in ("foreground", "foreground_least", "foreground_until"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"'{name}' must be in [0, 1], not {getattr(self, name)}.")

    def scale_at(self, progress: float, edge: int) -> float:
        """Image scale at a point of the fit, of a photograph whose longer edge is ``edge`` pixels."""
        scale = self.resolution[sum(progress >= end for end in self.until)]
        halvings = self.halvings(edge)
        done = int(progress / self.start_until * halvings)
        return scale if done >= halvings else min(scale, 0.5 ** (halvings - done))

    def halvings(self, edge: int) -> int:
        """How often ``start_size`` halves a photograph whose longer edge is ``edge`` pixels, at the start of a fit."""
        return max(0, round(math.log2(edge / self.start_size))) if self.start_size else 0

    def favours_foreground(self, progress: float) -> bool:
        """Whether pixels with alpha may be drawn more often than others, at a point of the fit."""
        favoured = max(self.foreground, self.foreground_least) > 0
        return favoured and (progress < self.foreground_until or self.foreground_until == 1)

    def foreground_share(self, covered: float) -> float:
        """Share of a view's rays drawn among its pixels with alpha, which are the share ``covered`` of all its pixels."""
        # Of the rays that are drawn from all pixels, the share `covered` meets the object as well.
        missing = (self.foreground_least - covered) / (1 - covered) if covered < self.foreground_least else 0.0
        return max(self.foreground, missing)


class RefinedCameras(Protocol):
    """Training cameras whose poses are optimised (`invgraphics.training.poses.Poses`)."""

    def cameras(self, views: Int[Tensor, " k"]) -> list[Camera]:
        """Cameras of some views, differentiable in their poses."""
        ...

    def camera(self, view: int) -> Camera:
        """Camera of one view, differentiable in its pose."""
        ...


class Batches:
    """Draws each step's batch; all randomness comes from the generator it is given."""

    MAX_RAYS = 1 << 16

    def __init__(
        self,
        config: BatchConfig,
        scene: Scene,
        generator: torch.Generator,
        device: torch.device,
        refined: RefinedCameras | None = None,
    ) -> None:
        self._refined = refined
        self._config, self._scene, self._generator, self._device = config, scene, generator, device
        self._order = torch.zeros(0, dtype=torch.int64)
        self._rays = config.rays
        self._scaled_views: dict[int, tuple[float, View]] = {}
        self._pixels = RandomPixels(generator)
        self._pool = _Pool()

    def background(self) -> Float[Tensor, 3]:
        """Background of a step: random where photographs have alpha, so that empty space must be learnt; else the scene's.

        See `BatchConfig.opaque` for the one exception.
        """
        if self._scene.has_alpha or (self._config.opaque and self._scene.bounds.space == "contracted"):
            return torch.rand(3, generator=self._generator)
        return self._scene.background

    def rays(self, progress: float = 1.0) -> tuple[Rays, Batch]:
        """Random rays of up to ``views`` random training views, at the image scale of this point of the fit."""
        background = self.background()
        train, config = self._scene.train, self._config
        count = min(config.views, len(train), self._rays)
        chosen = torch.randperm(len(train), generator=self._generator)[:count]
        shares = [self._rays // count + (i < self._rays % count) for i in range(count)]
        views = [self._scaled(int(view), progress) for view in chosen]
        inside = [0] * count
        if config.favours_foreground(progress):
            inside = [self._foreground_ray_count(*one) for one in zip(chosen.tolist(), views, shares, strict=True)]
        drawn = zip(chosen.tolist(), views, shares, inside, strict=True)
        flat = [self._pixels.draw(index, view, n, foreground=k) for index, view, n, k in drawn]
        which = torch.repeat_interleave(torch.arange(count), torch.tensor(shares))
        wide = torch.tensor([view.camera.width for view in views])[which]
        index = torch.cat(flat)
        pixels = torch.stack([index % wide, index // wide], dim=1) + 0.5
        if self._refined is None:
            rays = rays_through([view.camera for view in views], which, pixels, chosen[which])
        else:
            # The cameras are on the parameters' device, and so must be the pixels.
            which, pixels, chosen = (values.to(self._device) for values in (which, pixels, chosen))
            refined = self._refined.cameras(chosen)
            cameras = [camera.resized(*size_of(view)) for camera, view in zip(refined, views, strict=True)]
            rays = rays_through(cameras, which, pixels, chosen[which])
        batch = Batch(*_composited(views, flat, background), background)
        return rays.to(self._device), batch.to(self._device)

    def _foreground_ray_count(self, index: int, view: View, count: int) -> int:
        """Number of a view's ``count`` rays that are drawn from its foreground, the pixels with alpha."""
        covered = 0.0 if view.alpha is None else self._pixels.covered(index, view)
        return round(self._config.foreground_share(covered) * count) if covered else 0

    def observe(self, samples: int) -> None:
        """Adapt the number of rays to the target number of samples, given the ``samples`` that the latest rays had."""
        if self._config.samples and samples:
            wanted = self._rays * self._config.samples / samples
            self._rays = int(min(max(0.5 * self._rays + 0.5 * wanted, 128), self.MAX_RAYS))

    def image(self, progress: float) -> tuple[Camera, Batch]:
        """Camera and batch of one whole training view; views come in random permutations."""
        background = self.background()
        if len(self._order) == 0:
            self._order = torch.randperm(len(self._scene.train), generator=self._generator)
        index, self._order = int(self._order[0]), self._order[1:]
        view = self._scaled(index, progress)
        # Moved as bytes, a quarter of the floats that they become.
        batch = _whole(_pictures_to(view, self._device), background.to(self._device), index)
        camera = view.camera if self._refined is None else self._refined.camera(index).resized(*size_of(view))
        return camera.to(self._device), batch

    def _scaled(self, index: int, progress: float) -> View:
        """A training view at the image scale of a point of the fit, area-averaged; the last scale's are kept as bytes."""
        view = self._scene.train[index]
        scale = self._config.scale_at(progress, max(size_of(view)))
        if scale == 1:
            self._scaled_views.pop(index, None)
            return view
        if index not in self._scaled_views or self._scaled_views[index][0] != scale:
            width, height = (max(1, round(edge * scale)) for edge in size_of(view))
            small = resized_view(view, width, height)
            if small.mask is not None and not bool(small.mask.any()):
                return view  # its valid pixels are narrower than these
            self._scaled_views[index] = scale, self._pool.store(small)
        return self._scaled_views[index][1]

    def state(self) -> dict[str, Tensor]:
        """Tensors that a resumed fit needs."""
        return {"order": self._order, "rays": torch.tensor(self._rays)}

    def load(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state`."""
        self._order, self._rays = state["order"], int(state["rays"])


class _Pool:
    """Storage of many small pictures in few large blocks, each of which is freed when none of its pictures is in use.

    A picture that stayed where it was made would lie in the memory of the large temporary ones it was made from, which the
    allocator could then not reuse: 100 photographs of 800 x 800 pixels took 0.8 GB.
    """

    BLOCK = 16 << 20
    ALIGNMENT = 64

    def __init__(self) -> None:
        self._block, self._used = torch.empty(0, dtype=torch.uint8), 0

    def store(self, view: View) -> View:
        """Copy a view's picture, alpha and mask to the pool; returns the view with the copies."""
        names = [name for name in ("image", "alpha", "mask") if getattr(view, name) is not None]
        return replace(view, **{name: self._copy(getattr(view, name)) for name in names})

    def _copy(self, tensor: Tensor) -> Tensor:
        size = tensor.numel() * tensor.element_size()
        if self._used + size > len(self._block):
            self._block, self._used = torch.empty(max(self.BLOCK, size), dtype=torch.uint8, device=tensor.device), 0
        place = self._block[self._used : self._used + size].view(tensor.dtype).view(tensor.shape)
        self._used += -(-size // self.ALIGNMENT) * self.ALIGNMENT
        return place.copy_(tensor)


def size_of(view: View) -> tuple[int, int]:
    """Width and height in pixels."""
    return view.camera.width, view.camera.height


def _pictures_to(view: View, device: torch.device) -> View:
    """The view with picture, alpha and mask on a device."""
    alpha, mask = (None if tensor is None else tensor.to(device) for tensor in (view.alpha, view.mask))
    return replace(view, image=view.image.to(device), alpha=alpha, mask=mask)


def _whole(view: View, background: Tensor, index: int) -> Batch:
    """A batch of all pixels of a view; masked-out ones become background, so that SSIM windows over them are unaffected."""
    colour, alpha = view.over(background), view.opacity()
    if view.mask is None:
        return Batch(colour, alpha, background, index)
    mask = view.mask.bool()
    return Batch(torch.where(mask[..., None], colour, background), alpha * mask, background, index, mask)


def _composited(views: list[View], flat: list[Tensor], background: Tensor) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Colour in front of the background, and alpha, at pixels of several views, one view after another.

    Views of one format are joined before their bytes are converted, which makes the conversions few.
    """
    kinds = {(view.image.dtype, None if view.alpha is None else view.alpha.dtype) for view in views}
    if len(kinds) > 1:
        parts = [(view.over(background, index), view.opacity(index)) for view, index in zip(views, flat, strict=True)]
        return torch.cat([colour for colour, _ in parts]), torch.cat([alpha for _, alpha in parts])
    image = torch.cat([view.image.reshape(-1, 3)[index] for view, index in zip(views, flat, strict=True)])
    alphas = [view.alpha.reshape(-1)[index] for view, index in zip(views, flat, strict=True) if view.alpha is not None]
    strip = replace(views[0], image=image[None], alpha=torch.cat(alphas)[None] if alphas else None)
    return strip.over(background)[0], strip.opacity()[0]
