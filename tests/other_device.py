"""A second device, only pretended: tensors that live on it compute on the CPU, but do not mix with the CPU's.

As on a GPU, an operation that meets tensors of both devices fails, and so does a random draw from the other device's generator,
or a look at memory as NumPy. So code can be checked for forgotten moves where there is no GPU. The device is called ``meta``,
the one name besides ``cpu`` that torch's autograd knows in every build; unlike real meta tensors these hold numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

DEVICE = torch.device("meta")
MOVES = {torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default}
"""Operations that may meet both devices."""


class Elsewhere(Tensor):
    """A tensor on the pretended device; ``held`` has its numbers."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> Elsewhere:
        made = Tensor._make_wrapper_subclass(
            cls, held.size(), strides=held.stride(), storage_offset=held.storage_offset(), dtype=held.dtype, device=DEVICE
        )
        made.held = held
        return made

    def __init__(self, held: Tensor) -> None:
        pass

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})

    def __repr__(self, **_: Any) -> str:  # type: ignore[override]
        return f"elsewhere({self.held!r})"


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
    there, here = [x for x in tensors if isinstance(x, Elsewhere)], [x for x in tensors if not isinstance(x, Elsewhere)]
    if there and func not in MOVES and any(x.ndim > 0 for x in here):
        raise RuntimeError(f"{func}: expected all tensors to be on the same device, but found both")
    wanted = kwargs.get("device")
    away = bool(there) if wanted is None else torch.device(wanted) == DEVICE
    if func is torch.ops.aten.copy_.default:
        away = isinstance(args[0], Elsewhere)
    if away and kwargs.get("generator") is not None:
        raise RuntimeError(f"{func}: the generator is on the CPU, the numbers are not")
    args, kwargs = tree_map(lambda x: x.held if isinstance(x, Elsewhere) else x, (args, kwargs))
    if wanted is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    result = func(*args, **kwargs)
    # What came in comes out again as the same object (in-place operations), what is new is wrapped.
    known = {id(x.held): x for x in there}

    def wrap(x: Any) -> Any:
        if not isinstance(x, Tensor) or not away:
            return x
        return known[id(x)] if id(x) in known else Elsewhere(x)

    return tree_map(wrap, result)


class _Factories(TorchDispatchMode):
    """Catches what no tensor announces: creation on the pretended device."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class _Constructors(TorchFunctionMode):
    """Catches the ways between Python's numbers and tensors, which on a device that knows no numbers would lose them."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func is Tensor.tolist and isinstance(args[0], Elsewhere):
            return args[0].held.tolist()
        if func in (torch.tensor, torch.as_tensor, Tensor.new_tensor):
            like = args[0] if func is Tensor.new_tensor else None
            device = kwargs.pop("device", None) or (None if like is None else like.device)
            if device is not None and torch.device(device) == DEVICE:
                if like is not None:
                    kwargs.setdefault("dtype", like.dtype)
                    args = args[1:]
                return torch.tensor(*args, **kwargs).to(DEVICE)
            kwargs |= {} if device is None else {"device": device}
        return func(*args, **kwargs)


@contextmanager
def other_device() -> Iterator[torch.device]:
    """Within this, the second device is there."""
    before = torch.__future__.get_overwrite_module_params_on_conversion()
    # Parameters that move are made anew: those of a subclass cannot change their data's device in place.
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    try:
        with _Factories(), _Constructors():
            yield DEVICE
    finally:
        torch.__future__.set_overwrite_module_params_on_conversion(before)
