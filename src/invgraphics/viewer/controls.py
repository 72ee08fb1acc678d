"""Control panel of one browser: outputs, layout, overlays, and status of the runs."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from invgraphics.core import View
from invgraphics.tools.colorize import NEEDS_TRUTH, OUTPUTS
from invgraphics.viewer.cameras import ViewerCamera
from invgraphics.viewer.crop import CropBox
from invgraphics.viewer.loaded_run import LoadedRun
from invgraphics.viewer.progressive import LAYOUTS, RenderRequest, ViewerFrame

FREE_CAMERA = "free camera"
"""Entry of the view list for a camera that is at no photograph."""
SMALLEST, LARGEST = 64, 2048
"""Range of the resolution limit, pixels along the longer side."""

FOVS = 5, 120
"""Range of the field of view, degrees."""

BACKGROUNDS = {"the scene's": None, "white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
"""Name -> colour behind predictions; scores keep the scene's own."""

Callback = Callable[[], Awaitable[None]]


@dataclass(frozen=True)
class Callbacks:
    """Coroutines called on user input.

    Attributes:
        output: what is rendered has changed.
        view: a photograph was chosen.
        overlays: what the browser draws itself has changed.
        save: the current image is wanted as a file.
        fov: another field of view was chosen.
    """

    output: Callback
    view: Callback
    overlays: Callback
    save: Callback
    fov: Callback


class Controls:
    """The control panel of one browser.

    Args:
        gui: viser's interface of that browser.
        runs: one or two runs.
        views: names of the photographs to choose from.
        max_size: initial limit of the longer side, pixels.
        callbacks: called on user input.
    """

    def __init__(self, gui: Any, runs: Sequence[LoadedRun], views: Sequence[str], max_size: int, callbacks: Callbacks) -> None:
        self._runs = runs
        self.output = gui.add_dropdown(
            "Show", OUTPUTS, hint="Truth and error are known at photographs only; choosing them goes to the nearest one."
        )
        self.view = gui.add_dropdown("View", (FREE_CAMERA, *views), hint="Puts the camera where a photograph was taken.")
        self.fov = gui.add_slider(
            "Field of view",
            *FOVS,
            1,
            50,
            hint="From top to bottom, in degrees. At a photograph it is the photograph's: others leave it.",
        )
        several = len(runs) > 1
        self.layout = gui.add_dropdown("Runs", LAYOUTS if several else ("first",), visible=several)
        self.split = gui.add_slider("Split at", 0.0, 1.0, 0.01, 0.5, visible=several)
        self.background = gui.add_dropdown(
            "Background", tuple(BACKGROUNDS), hint="Behind predictions. Scores and errors keep the scene's own."
        )
        self.cameras = gui.add_checkbox("Cameras", False, hint="The photographs, where they were taken; a click goes there.")
        self.splats = gui.add_checkbox(
            "Splats drawn by the browser",
            False,
            visible=any(run.has_gaussians for run in runs),
            hint="Smooth while moving. Colours without view dependence; the run's own renderer is not used.",
        )
        top = max(LARGEST, max_size)
        self.max_size = gui.add_slider(
            "Most pixels", min(SMALLEST, max_size), top, 1, max_size, hint="Along the longer side, when the camera rests."
        )
        save = gui.add_button("Save picture", hint="The picture as it is now, as a PNG file, without the browser's drawings.")
        self._status = gui.add_html("")
        self._facts = gui.add_html("")
        self.update_summary()
        for handle in (self.output, self.layout, self.split, self.max_size, self.background):
            on_change(handle, callbacks.output)

        async def saved(_: Any) -> None:
            await callbacks.save()

        save.on_click(saved)
        on_change(self.view, callbacks.view)
        on_change(self.fov, callbacks.fov)
        for handle in (self.cameras, self.splats):
            on_change(handle, callbacks.overlays)

    def update_summary(self, notice: str = "") -> None:
        """Update name, training progress and scores of the runs, under a line of text."""
        above = status_block(escape(notice)) if notice else ""
        self._facts.content = above + "".join(_facts_of(run) for run in self._runs)

    def show_fov(self, radians: float) -> None:
        """Show a vertical field of view; one beyond the slider's range at its end."""
        degrees = min(max(round(math.degrees(radians)), FOVS[0]), FOVS[1])
        if degrees != self.fov.value:
            self.fov.value = degrees

    @property
    def one_camera(self) -> bool:
        """Whether the whole window shows one camera, so that what the browser draws fits the picture."""
        return self.layout.value != "side by side"

    @property
    def splat_run(self) -> LoadedRun | None:
        """The run whose splats the browser draws: the second if that is shown alone, and the other one if it has none."""
        if not self.splats.value:
            return None
        wanted = self._runs[::-1] if self.layout.value == "second" else self._runs
        return next((run for run in wanted if run.has_gaussians), None)

    def show_splat_status(self, run: LoadedRun, cropped: bool) -> None:
        """Show whose splats the browser draws, and which controls have no effect on them."""
        alone = {"first": self._runs[0], "second": self._runs[-1]}.get(self.layout.value)
        idle = {"Show": self.output.value != "prediction", "Crop": cropped, "Runs": len(self._runs) > 1 and run is not alone}
        names = ", ".join(name for name, without_effect in idle.items() if without_effect)
        self.show_status(
            "Drawn by the browser: colours without view dependence.",
            f"These are the splats of {run.name}." if len(self._runs) > 1 else "",
            f"Without effect on them: {names}." if names else "",
        )

    @property
    def free_output(self) -> str:
        """What is shown where there is no photograph: the prediction for outputs that are known at photographs only."""
        return "prediction" if self.output.value in NEEDS_TRUTH else self.output.value

    def request(
        self, camera: ViewerCamera, window: tuple[int, int], view: View | None, crop: CropBox | None, skip_coarse: bool
    ) -> RenderRequest:
        """What the controls ask to render, at photograph ``view`` or with a free camera; the rest as in `RenderRequest`."""
        return RenderRequest(
            camera=camera,
            window=window,
            output=self.free_output if view is None else self.output.value,
            view=view,
            layout=self.layout.value,
            split=float(self.split.value),
            max_size=int(self.max_size.value),
            skip_coarse=skip_coarse,
            background=BACKGROUNDS[self.background.value],
            crop=crop,
        )

    def show_frame(self, frame: ViewerFrame, note: str = "") -> None:
        """Show size, render time, PSNR and legend of a frame."""
        width, height = frame.size
        took = f" in {frame.seconds:.2f} s" if frame.seconds else ""
        lines = [f"{width} × {height} pixels{took}{'' if frame.final else ', getting finer'}"]
        if frame.psnr:
            lines.append("PSNR of this view: " + ", ".join(f"{value:.2f} dB" for value in frame.psnr))
        self.show_status(*lines, frame.legend, note)

    def show_status(self, *lines: str) -> None:
        """Replace the status by lines of text."""
        self._status.content = status_block("".join(f"<div>{escape(line)}</div>" for line in lines if line))


def on_change(handle: Any, callback: Callback) -> None:
    """Register ``callback`` for changes by the user, not by the program."""

    async def changed(event: Any) -> None:
        if event.client is not None:
            await callback()

    handle.on_update(changed)


def _facts_of(run: LoadedRun) -> str:
    rows = "".join(f"<div>{escape(name)}: {escape(value)}</div>" for name, value in run.summary().items())
    return status_block(f"<div><b>{escape(run.name)}</b></div>{rows}")


def status_block(content: str) -> str:
    """HTML of small text in the control panel."""
    return f'<div style="padding:0.2em 0.75em 0.5em;font-size:0.8rem;line-height:1.4">{content}</div>'


def jump_notice(output: str, view: str) -> str:
    """The reason why choosing an output has moved the camera."""
    return f"Moved to the nearest photograph, {view}: the {output} is known at photographs only."
