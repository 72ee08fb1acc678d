"""What stands beside the picture: choices, and what is known about the runs."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from invgraphics.viewer.colouring import SHOWN
from invgraphics.viewer.painting import LAYOUTS, Painted
from invgraphics.viewer.subject import Subject

ANYWHERE = "anywhere"
"""The name, among those of the views, of a camera that belongs to no photograph."""
SMALLEST, LARGEST = 64, 2048
"""Pixels along a picture's longest side that can be chosen."""

BACKGROUNDS = {"the scene's": None, "white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
"""What can be put behind predictions; scores keep the scene's own."""

Answer = Callable[[], Awaitable[None]]


@dataclass(frozen=True)
class Answers:
    """What to do when a person has changed something: the picture's content, the camera's place, what the browser draws; or
    wants the picture as a file."""

    picture: Answer
    place: Answer
    drawn: Answer
    saved: Answer


class Controls:
    """The controls of one browser.

    Args:
        gui: viser's interface of that browser.
        subjects: one or two runs.
        views: names of the photographs to choose from.
        longest: most pixels along a picture's longest side, at the start.
        answers: what to call.
    """

    def __init__(self, gui: Any, subjects: Sequence[Subject], views: Sequence[str], longest: int, answers: Answers) -> None:
        self._subjects = subjects
        self.shown = gui.add_dropdown(
            "Show", SHOWN, hint="Truth and error are known at photographs only; choosing them goes to the nearest one."
        )
        self.view = gui.add_dropdown("View", (ANYWHERE, *views), hint="Puts the camera where a photograph was taken.")
        several = len(subjects) > 1
        self.layout = gui.add_dropdown("Runs", LAYOUTS if several else ("first",), visible=several)
        self.share = gui.add_slider("Split at", 0.0, 1.0, 0.01, 0.5, visible=several)
        self.background = gui.add_dropdown(
            "Background", tuple(BACKGROUNDS), hint="Behind predictions. Scores and errors keep the scene's own."
        )
        self.cameras = gui.add_checkbox("Cameras", False, hint="The photographs, where they were taken; a click goes there.")
        self.splats = gui.add_checkbox(
            "Splats drawn by the browser",
            False,
            visible=subjects[0].has_gaussians,
            hint="Smooth while moving. Colours without view dependence; the run's own renderer is not used.",
        )
        top = max(LARGEST, longest)
        self.longest = gui.add_slider(
            "Most pixels", min(SMALLEST, longest), top, 1, longest, hint="Along the longer side, when the camera rests."
        )
        save = gui.add_button("Save picture", hint="The picture as it is now, as a PNG file, without the browser's drawings.")
        self._status = gui.add_html("")
        self._facts = gui.add_html("")
        self.tell_facts()
        for handle in (self.shown, self.layout, self.share, self.longest, self.background):
            _answer(handle, answers.picture)

        async def saved(_: Any) -> None:
            await answers.saved()

        save.on_click(saved)
        _answer(self.view, answers.place)
        for handle in (self.cameras, self.splats):
            _answer(handle, answers.drawn)

    def tell_facts(self) -> None:
        """Show what is known about the runs, as of now."""
        self._facts.content = "".join(_facts_of(subject) for subject in self._subjects)

    def tell(self, painted: Painted, note: str = "") -> None:
        """Show what is known about the picture."""
        width, height = painted.size
        took = f" in {painted.seconds:.2f} s" if painted.seconds else ""
        lines = [f"{width} × {height} pixels{took}{'' if painted.finest else ', getting finer'}"]
        if painted.psnr:
            lines.append("PSNR of this view: " + ", ".join(f"{value:.2f} dB" for value in painted.psnr))
        self.say(*lines, painted.legend, note)

    def say(self, *lines: str) -> None:
        """Show lines of text in place of what is known about the picture."""
        self._status.content = _block("".join(f"<div>{escape(line)}</div>" for line in lines if line))


def _answer(handle: Any, answer: Answer) -> None:
    """Call ``answer`` when a person changes a control, not when the program does."""

    async def changed(event: Any) -> None:
        if event.client is not None:
            await answer()

    handle.on_update(changed)


def _facts_of(subject: Subject) -> str:
    rows = "".join(f"<div>{escape(name)}: {escape(value)}</div>" for name, value in subject.facts().items())
    return _block(f"<div><b>{escape(subject.name)}</b></div>{rows}")


def _block(content: str) -> str:
    return f'<div style="padding:0.2em 0.75em 0.5em;font-size:0.8rem;line-height:1.4">{content}</div>'
