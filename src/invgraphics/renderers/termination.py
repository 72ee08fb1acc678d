"""Early ray termination: leaves out samples behind opaque surfaces, with few queries of the field."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.core import FieldValues, Rays, Samples
from invgraphics.kernels.types import March

Query = Callable[[Samples], FieldValues]
"""Values of a field at samples, outside the graph; the density at least."""


def visible_samples(rays: Rays, march: March, query: Query, transmittance: float, chunk: int | None) -> Samples:
    """Samples up to which the transmittance is at least ``transmittance``, with the values queried on the way.

    Their positions carry the gradients of the rays; the values carry none.

    Each ray's first ``chunk`` intervals are queried, then half as many again of those rays that are not opaque yet, and so
    on: each chunk is one query for all rays together, and there are few of them even where nothing is opaque.

    Args:
        rays: the n rays marched.
        march: their intervals.
        query: the field's density, and features where they are of use.
        transmittance: least transmittance, in [0, 1).
        chunk: intervals per ray of the first query, >= 1; ``None`` queries all at once, which takes a GPU less time than
            several rounds with less work in each.
    """
    kept, found = _intervals_before_depth(
        rays, march, query, -math.log(transmittance) if transmittance > 0 else math.inf, chunk
    )
    samples = Samples.on(rays, march.ray[kept], march.t0[kept], march.t1[kept])
    return replace(samples, density=found.density, features=found.features)


@torch.no_grad()
def _intervals_before_depth(
    rays: Rays, march: March, query: Query, most: float, chunk: int | None
) -> tuple[Int[Tensor, " k"], FieldValues]:
    """Intervals behind an optical depth of ``most`` at most, and their values."""
    counts = torch.bincount(march.ray, minlength=len(rays))
    first = counts.cumsum(0) - counts
    reached = torch.zeros_like(march.t0, dtype=torch.bool)
    found, order = [], []
    depth = rays.near.new_zeros(len(rays))
    going, done = torch.nonzero(counts)[:, 0], 0
    if chunk is None:
        chunk = int(counts.max()) if len(going) else 1
    while len(going):
        left = counts[going] - done
        # One row per ray that goes on, one column per interval of this chunk; the last rows' ends stay empty.
        table = rays.near.new_zeros(len(going), chunk)
        there = torch.arange(chunk, device=left.device) < left[:, None]
        place = torch.nonzero(there.view(-1))[:, 0]
        index = (first[going] + done)[place // chunk] + place % chunk
        t0, t1 = march.t0[index], march.t1[index]
        values = query(Samples.on(rays, march.ray[index], t0, t1))
        assert values.density is not None
        found.append(values)
        order.append(index)
        table.view(-1)[place] = values.density * (t1 - t0)
        sums = torch.nn.functional.pad(table.cumsum(dim=1), (1, 0)) + depth[going, None]
        reached[index] = sums[:, :-1].reshape(-1)[place] <= most
        depth[going] = sums[:, -1]
        going = going[(left > chunk) & (sums[:, -1] <= most)]
        done, chunk = done + chunk, chunk + (chunk + 1) // 2
    kept = torch.nonzero(reached)[:, 0]
    if not found:
        return kept, FieldValues(density=march.t0[kept])
    # Where each kept interval was in the order of the queries.
    at = torch.empty_like(march.ray).index_copy_(0, torch.cat(order), torch.arange(sum(map(len, order)), device=kept.device))
    at = at[kept]
    features = [values.features for values in found if values.features is not None]
    density = torch.cat([values.density for values in found if values.density is not None])[at]
    return kept, FieldValues(density=density, features=torch.cat(features)[at] if features else None)


def contributing_samples(
    weights: Float[Tensor, " m"], ray: Int[Tensor, " m"], rays: int, max_error: float
) -> Int[Tensor, " k"]:
    """Indices of samples whose complement contributes at most ``max_error`` to each ray."""
    counts = torch.bincount(ray, minlength=rays)
    return torch.nonzero(weights * counts[ray] > max_error)[:, 0]


def joined(parts: list[March]) -> March:
    """Concatenate consecutive parts of a march, sorted by ray; the sort is stable, which keeps distances in order."""
    ray = torch.cat([part.ray for part in parts])
    order = torch.argsort(ray, stable=True)
    t0, t1 = (torch.cat([getattr(part, name) for part in parts])[order] for name in ("t0", "t1"))
    return March(ray[order], t0, t1, parts[-1].resume)
