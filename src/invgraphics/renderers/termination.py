"""Early ray termination: leaving out what lies behind opaque surfaces, with as few looks at the field as that takes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.core import FieldValues, Rays, Samples
from invgraphics.kernels.types import March

Look = Callable[[Samples], FieldValues]
"""Asks a field, outside the graph."""


def in_front(rays: Rays, march: March, look: Look, transmittance: float, wave: int) -> Samples:
    """Samples that at least the share ``transmittance`` of the light still reaches, with what was found there on the way.

    Their places carry the gradients of the rays; what was found carries none.

    Each ray's first ``wave`` intervals are looked at, then half as many again of those rays that are not opaque yet, and so
    on: every look is one call for all rays together, and there are few of them even where nothing is opaque.

    Args:
        rays: the n rays marched.
        march: their intervals.
        look: what to ask about them; gives the density at least.
        transmittance: least share of light, in [0, 1).
        wave: intervals per ray of the first look, >= 1.
    """
    kept, found = _reached(rays, march, look, -math.log(transmittance) if transmittance > 0 else math.inf, wave)
    samples = Samples.on(rays, march.ray[kept], march.t0[kept], march.t1[kept])
    return replace(samples, density=found.density, features=found.features)


@torch.no_grad()
def _reached(rays: Rays, march: March, look: Look, most: float, wave: int) -> tuple[Int[Tensor, " k"], FieldValues]:
    """Intervals behind an optical depth of ``most`` at most, and what was found there."""
    counts = torch.bincount(march.ray, minlength=len(rays))
    first = counts.cumsum(0) - counts
    reached = torch.zeros_like(march.t0, dtype=torch.bool)
    found, order = [], []
    depth = rays.near.new_zeros(len(rays))
    going, done = torch.nonzero(counts)[:, 0], 0
    while len(going):
        left = counts[going] - done
        # One row per ray that goes on, one column per interval of this wave; the last rows' ends stay empty.
        table = rays.near.new_zeros(len(going), wave)
        there = torch.arange(wave, device=left.device) < left[:, None]
        place = torch.nonzero(there.view(-1))[:, 0]
        index = (first[going] + done)[place // wave] + place % wave
        t0, t1 = march.t0[index], march.t1[index]
        values = look(Samples.on(rays, march.ray[index], t0, t1))
        assert values.density is not None
        found.append(values)
        order.append(index)
        table.view(-1)[place] = values.density * (t1 - t0)
        sums = torch.nn.functional.pad(table.cumsum(dim=1), (1, 0)) + depth[going, None]
        reached[index] = sums[:, :-1].reshape(-1)[place] <= most
        depth[going] = sums[:, -1]
        going = going[(left > wave) & (sums[:, -1] <= most)]
        done, wave = done + wave, wave + (wave + 1) // 2
    kept = torch.nonzero(reached)[:, 0]
    if not found:
        return kept, FieldValues(density=march.t0[kept])
    # Where each kept interval was in the order of the looks.
    at = torch.empty_like(march.ray).index_copy_(0, torch.cat(order), torch.arange(sum(map(len, order)), device=kept.device))
    at = at[kept]
    features = [values.features for values in found if values.features is not None]
    density = torch.cat([values.density for values in found if values.density is not None])[at]
    return kept, FieldValues(density=density, features=torch.cat(features)[at] if features else None)


def weighty(weights: Float[Tensor, " m"], ray: Int[Tensor, " m"], rays: int, share: float) -> Int[Tensor, " k"]:
    """Indices of the samples that must be looked at so that all others of a ray together weigh no more than ``share``."""
    counts = torch.bincount(ray, minlength=rays)
    return torch.nonzero(weights * counts[ray] > share)[:, 0]
