"""Checks of shapes on entry to operations: compiled kernels would read foreign memory where lengths differ."""

from __future__ import annotations

from torch import Tensor

from invgraphics.core.field import Gaussians
from invgraphics.core.ngp import HashGrid
from invgraphics.core.rays import Rays


def check_rows(name: str, count: int, **tensors: Tensor | None) -> None:
    """Check that tensors have one row for each of the ``count`` things called ``name``; ``None`` passes.

    Raises:
        ValueError: another number of rows.
    """
    for key, tensor in tensors.items():
        if tensor is not None and (tensor.ndim == 0 or tensor.shape[0] != count):
            raise ValueError(f"There are {count} {name}, but '{key}' has the shape {tuple(tensor.shape)}.")


def check_columns(columns: int, **tensors: Tensor | None) -> None:
    """Check that tensors are matrices of that many columns; ``None`` passes.

    Raises:
        ValueError: another shape.
    """
    for key, tensor in tensors.items():
        if tensor is not None and (tensor.ndim != 2 or tensor.shape[1] != columns):
            raise ValueError(f"'{key}' has the shape (n, {columns}), not {tuple(tensor.shape)}.")


def check_gaussians(gaussians: Gaussians) -> None:
    """Check that all quantities of Gaussians have a row for each."""
    check_rows("Gaussians", len(gaussians), **vars(gaussians))
    check_columns(3, means=gaussians.means, scales=gaussians.scales)
    check_columns(4, quaternions=gaussians.quaternions)


def checked_rays(rays: Rays, start: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]:
    """What kernels read of rays: origins, directions, near and far, and where marches start; all with a row for each ray."""
    check_rows("rays", len(rays), directions=rays.directions, near=rays.near, far=rays.far, start=start)
    check_columns(3, origins=rays.origins, directions=rays.directions)
    return rays.origins, rays.directions, rays.near, rays.far, start


def check_cube(occupied: Tensor) -> None:
    """Check that the cells of an occupancy grid are a cube.

    Raises:
        ValueError: they are not.
    """
    if occupied.ndim != 3 or len(set(occupied.shape)) != 1:
        raise ValueError(f"'occupied' has the shape (r, r, r), not {tuple(occupied.shape)}.")


def check_table(table: Tensor, grid: HashGrid | None) -> None:
    """Check that a hash grid's table has all its entries.

    Raises:
        ValueError: it has more or fewer.
    """
    if grid is not None and (table.ndim != 2 or table.shape[0] != grid.entries):
        raise ValueError(f"The hash grid has {grid.entries} entries, but 'table' has the shape {tuple(table.shape)}.")


def check_adam(
    values: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], rates: Tensor | None, rows: Tensor | None
) -> None:
    """Check that an Adam step has a gradient, or one for each of ``rows``, two moments and a rate for all of its values.

    Raises:
        ValueError: other numbers of them.
        IndexError: the first or the last row is not there.
    """
    width = values.shape[-1]
    count = values.numel() // max(width, 1)
    expected = values.numel() if rows is None else len(rows) * width
    if gradient.numel() != expected or any(moment.numel() != values.numel() for moment in moments):
        shapes = ", ".join(str(tuple(tensor.shape)) for tensor in (values, gradient, *moments))
        raise ValueError(f"Values, gradient and moments of an Adam step do not fit together: {shapes}.")
    if rates is not None and rates.numel() != count:
        raise ValueError(f"There are {count} rows, but 'rates' has the shape {tuple(rates.shape)}.")
    if rows is not None and rows.device.type == "cpu" and len(rows) and not 0 <= int(rows[0]) <= int(rows[-1]) < count:
        raise IndexError(f"Rows {int(rows[0])} to {int(rows[-1])} have a gradient, but there are {count} rows.")
