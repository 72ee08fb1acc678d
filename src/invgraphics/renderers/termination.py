"""Early ray termination: samples behind opaque surfaces are left out, with few queries of the field."""

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


def visible_samples(rays: Rays, march: March, query: Query, min_transmittance: float, chunk: int | None) -> Samples:
    """Samples in front of which the transmittance is still at least ``min_transmittance``, with the values queried for it.

    Their positions carry the gradients of the rays; the values carry none.

    Each ray's first ``chunk`` intervals are queried, then half as many again of those rays that are not opaque yet, and so
    on: each chunk is one query for all rays together, and there are few of them even where nothing is opaque.

    Args:
        rays: the n rays marched.
        march: their intervals.
        query: the field's density, and features where they are of use.
        min_transmittance: in [0, 1).
        chunk: intervals per ray of the first query, >= 1; ``None`` queries all at once, which takes a GPU less time than
            several rounds with less work in each.
    """
    max_optical_depth = -math.log(min_transmittance) if min_transmittance > 0 else math.inf
    kept, found = _intervals_before_depth(rays, march, query, max_optical_depth, chunk)
    samples = Samples.on(rays, march.ray[kept], march.t0[kept], march.t1[kept])
    return replace(samples, density=found.density, features=found.features)


@torch.no_grad()
def _intervals_before_depth(
    rays: Rays, march: March, query: Query, max_optical_depth: float, chunk: int | None
) -> tuple[Int[Tensor, " k"], FieldValues]:
    """Indices and field values of the intervals in front of which the optical depth is at most ``max_optical_depth``."""
    counts = torch.bincount(march.ray, minlength=len(rays))
    first = counts.cumsum(0) - counts
    reached = torch.zeros_like(march.t0, dtype=torch.bool)
    found, order = [], []
    optical_depth = rays.near.new_zeros(len(rays))
    active, queried = torch.nonzero(counts)[:, 0], 0
    if chunk is None:
        chunk = int(counts.max()) if len(active) else 1
    while len(active):
        remaining = counts[active] - queried
        # One row per active ray, one column per interval of this chunk; rows of rays with fewer intervals end in zeros.
        table = rays.near.new_zeros(len(active), chunk)
        valid = torch.arange(chunk, device=remaining.device) < remaining[:, None]
        slot = torch.nonzero(valid.view(-1))[:, 0]
        index = (first[active] + queried)[slot // chunk] + slot % chunk
        t0, t1 = march.t0[index], march.t1[index]
        values = query(Samples.on(rays, march.ray[index], t0, t1))
        assert values.density is not None
        found.append(values)
        order.append(index)
        table.view(-1)[slot] = values.density * (t1 - t0)
        sums = torch.nn.functional.pad(table.cumsum(dim=1), (1, 0)) + optical_depth[active, None]
        reached[index] = sums[:, :-1].reshape(-1)[slot] <= max_optical_depth
        optical_depth[active] = sums[:, -1]
        active = active[(remaining > chunk) & (sums[:, -1] <= max_optical_depth)]
        queried, chunk = queried + chunk, chunk + (chunk + 1) // 2
    kept = torch.nonzero(reached)[:, 0]
    if not found:
        return kept, FieldValues(density=march.t0[kept])
    # Position of each kept interval in the order of the queries.
    query_order = torch.arange(sum(map(len, order)), device=kept.device)
    query_position = torch.empty_like(march.ray).index_copy_(0, torch.cat(order), query_order)[kept]
    features = [values.features for values in found if values.features is not None]
    density = torch.cat([values.density for values in found if values.density is not None])[query_position]
    return kept, FieldValues(density=density, features=torch.cat(features)[query_position] if features else None)


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
