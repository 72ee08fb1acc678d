"""Compare and teach differentiable rendering: NeRF volume rendering versus splatting, under one protocol.

>>> import invgraphics as ig
>>> scene = ig.load_scene("bricks")                                    # doctest: +SKIP
>>> fit = ig.fit("splatting/gaussians", scene, budget="30s")           # doctest: +SKIP
>>> fit.model.render(scene.test[0].camera)                             # doctest: +SKIP

All names below are imported when they are first used: importing the package imports no torch. So are the packages below it:
``ig.core.transforms``, ``ig.renderers.volumetric``.
"""

import importlib
from typing import TYPE_CHECKING, Any

from invgraphics import thread_pools as thread_pools  # sets what torch reads when it is imported
from invgraphics.lazy import submodules

if TYPE_CHECKING:
    from invgraphics.api import ablate as ablate
    from invgraphics.api import compare as compare
    from invgraphics.api import evaluate as evaluate
    from invgraphics.api import fit as fit
    from invgraphics.api import load_method as load_method
    from invgraphics.api import load_run as load_run
    from invgraphics.api import load_scene as load_scene
    from invgraphics.api import load_study as load_study
    from invgraphics.api import save_scene as save_scene
    from invgraphics.core import Camera as Camera
    from invgraphics.core import Gaussians as Gaussians
    from invgraphics.core import Model as Model
    from invgraphics.core import Rendering as Rendering
    from invgraphics.core import Scene as Scene
    from invgraphics.core import View as View
    from invgraphics.errors import InputError as InputError
    from invgraphics.errors import NumericalError as NumericalError
    from invgraphics.plugins import register as register

__all__ = [
    "Camera",
    "Gaussians",
    "InputError",
    "Model",
    "NumericalError",
    "Rendering",
    "Scene",
    "View",
    "ablate",
    "compare",
    "evaluate",
    "fit",
    "load_method",
    "load_run",
    "load_scene",
    "load_study",
    "register",
    "save_scene",
]

_HOMES = {
    "Camera": "invgraphics.core",
    "Gaussians": "invgraphics.core",
    "InputError": "invgraphics.errors",
    "Model": "invgraphics.core",
    "NumericalError": "invgraphics.errors",
    "Rendering": "invgraphics.core",
    "Scene": "invgraphics.core",
    "View": "invgraphics.core",
    "ablate": "invgraphics.api",
    "compare": "invgraphics.api",
    "evaluate": "invgraphics.api",
    "fit": "invgraphics.api",
    "load_method": "invgraphics.api",
    "load_run": "invgraphics.api",
    "load_scene": "invgraphics.api",
    "load_study": "invgraphics.api",
    "register": "invgraphics.plugins",
    "save_scene": "invgraphics.api",
}
"""Public name -> the module that has it."""


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        return submodules(__name__)(name)
    globals()[name] = value = getattr(importlib.import_module(_HOMES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
