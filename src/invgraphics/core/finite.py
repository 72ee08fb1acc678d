"""Detection of NaN and infinite values in the tensors of a model or fit."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor


def describe_non_finite(parts: Mapping[str, Mapping[str, Tensor]]) -> str:
    """Describe the first tensor with NaN or infinite values, how many it has, and how many more tensors have some.

    Kernels cannot be relied on to show them: splatting culls a Gaussian at NaN, and hash grids clamp positions.

    Args:
        parts: section -> name -> tensor, as `invgraphics.core.Model.state_dict` and checkpoints hold them.

    Returns:
        For instance ``3 of 450 values of 'field.means' are not finite (and 2 more tensors)``; empty if all are finite.
    """
    found = []
    for section, part in parts.items():
        for name, value in part.items():
            if (value.is_floating_point() or value.is_complex()) and not bool(torch.isfinite(value).all()):
                found.append((f"{section}.{name}", value))
    if not found:
        return ""
    name, value = found[0]
    bad, more = int((~torch.isfinite(value)).sum()), len(found) - 1
    others = "" if not more else f" (and {more} more tensor{'s' if more > 1 else ''})"
    verb = "is" if bad == 1 else "are"
    return f"{bad:,} of {value.numel():,} values of '{name}' {verb} not finite{others}"
