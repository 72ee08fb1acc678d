"""Helpers of the teaching notebooks: plot style, rows of pictures, sliders, films, and the PSNR of one picture.

>>> from invgraphics import notebook
>>> notebook.style()                                                    # doctest: +SKIP
>>> notebook.show([picture, truth], ["rendered", "truth"])              # doctest: +SKIP
"""

from __future__ import annotations

import atexit
import inspect
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Rendering, Scene, View
from invgraphics.metrics.protocols import protocol_named, score
from invgraphics.report.figures.style import SERIES

BLUE, ORANGE, GREEN, PURPLE = (tone.light for tone in SERIES[:4])

Picture: TypeAlias = Float[Tensor, "h w 3"] | Float[Tensor, "h w"] | np.ndarray
Range: TypeAlias = tuple[float, float, float] | Sequence[float]
"""Positions of a slider: ``(first, last, step)`` as a tuple, or a list of the values themselves."""

TITLE = 0.24
"""Height of a line of title above a picture, inches."""


def style() -> None:
    """Set the look of all plots that follow: colours of the reports, no frame above and right, pictures at twice the pixels."""
    plt.rcParams |= {
        "figure.dpi": 90,
        "figure.constrained_layout.use": True,
        "font.size": 9,
        "axes.titlesize": 10,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
        "axes.prop_cycle": plt.cycler(color=[tone.light for tone in SERIES]),
    }
    if "ipykernel" in sys.modules:  # elsewhere there is no notebook whose pictures could be finer
        from matplotlib_inline.backend_inline import set_matplotlib_formats  # pyright: ignore[reportMissingImports]

        set_matplotlib_formats("retina")


def row(
    images: Sequence[Picture], titles: Sequence[str] = (), *, width: float = 9.2, columns: int = 0, **options: Any
) -> np.ndarray:
    """Draw pictures side by side, without axes, and return their axes to draw more on them.

    Args:
        images: colours in [0, 1], or one number per pixel.
        titles: one per picture; none where they run out.
        width: of the figure in inches.
        columns: pictures in a row; 0 for one row of them all.
        options: for matplotlib's ``imshow``, of every picture.

    Returns:
        An axis for each picture, in order; ``axes[0].figure`` is the figure.
    """
    columns = columns or len(images)
    rows = -(-len(images) // columns)
    height, wide = images[0].shape[:2]
    titled = min(rows, -(-len(titles) // columns))
    tall = rows * width / columns * height / wide + TITLE * titled
    _, grid = plt.subplots(rows, columns, figsize=(width, tall), squeeze=False)
    axes = grid.ravel()
    for axis in axes:
        axis.axis("off")
    for index, (axis, image) in enumerate(zip(axes, images, strict=False)):
        axis.imshow(np.asarray(image), **options)
        axis.set_title(titles[index] if index < len(titles) else "", fontsize=10 if columns < 6 else 8)
    return axes[: len(images)]


def show(images: Sequence[Picture], titles: Sequence[str] = (), **options: Any) -> None:
    """Show pictures side by side; arguments as for `row`."""
    row(images, titles, **options)
    plt.show()


def sliders(**positions: Range) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorate a function that draws a figure with one slider per argument, which redraws it.

    Args:
        positions: of each argument's slider; it begins at the argument's default.

    Example:
        >>> @notebook.sliders(count=(2, 64, 2), density=[0.5, 1, 5, 20])           # doctest: +SKIP
        ... def draw(count=8, density=5):
        ...     plt.plot(...)
    """
    from ipywidgets import FloatSlider, IntSlider, SelectionSlider, interact  # pyright: ignore[reportMissingImports]

    def attach(draw: Callable[..., None]) -> Callable[..., None]:
        controls: dict[str, Any] = {}
        for name, places in positions.items():
            value = inspect.signature(draw).parameters[name].default
            if isinstance(places, tuple):
                first, last, step = places
                kind = IntSlider if all(isinstance(number, int) for number in places) else FloatSlider
                controls[name] = kind(value, min=first, max=last, step=step)
            else:
                controls[name] = SelectionSlider(options=list(places), value=value)

        def redraw(**values: float) -> None:
            draw(**values)
            plt.show()

        interact(redraw, **controls)
        return draw

    return attach


def scratch() -> Path:
    """Create a temporary working folder for a notebook's files and change to it; it is removed when the kernel ends."""
    folder = tempfile.TemporaryDirectory(prefix="invgraphics-notebook-")
    atexit.register(folder.cleanup)
    os.chdir(folder.name)
    return Path(folder.name)


def video(path: Path, width: int) -> None:
    """Embed a film in the notebook's page.

    Args:
        path: of an mp4.
        width: on the page, px.
    """
    from IPython.display import Video, display  # pyright: ignore[reportMissingImports]

    display(Video(str(path), embed=True, width=width))


def psnr(rendering: Rendering, view: View, scene: Scene) -> float:
    """PSNR in dB of one rendering against its view, under the protocol that scores fits."""
    return score(rendering, view, scene, protocol_named("default"), only=["psnr"]).values["psnr"]
