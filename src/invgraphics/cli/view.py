"""``invgraphics view``: interactive viewer of runs in a browser."""

from __future__ import annotations

import contextlib
import os
import sys
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from invgraphics.cli.arguments import SMALLEST
from invgraphics.errors import InputError


@dataclass(frozen=True)
class View:
    """View a run in a browser, or two of one scene side by side: at reduced resolution while moving, at full size at rest.

    Shows prediction, truth, error, depth and normals, and the photographs where they were taken. Ctrl-C stops it.

    Attributes:
        folder: The folder of a run.
        other: Another run of the same scene, to compare.
        live: Follow a fit that runs in another process: wait for its first checkpoint, and show each newer one when it is
            written (fit --checkpoint-every 5s writes them more often).
        view: Test view to start at.
        host: Address to listen at. The default is reachable from this machine only; 0.0.0.0 from any machine.
        port: Port to listen at; 0 for any that is free.
        allow_host: Another name at which browsers reach the viewer, as a proxy's or a container's host; requests to others are
            refused.
        max_size: Most pixels along the pictures' longer side.
        no_open: Do not open the page in a browser.
        scene: Another copy of the scene, for instance where the data set has moved.
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    other: Annotated[Positional[Path | None], arg(metavar="[RUN2]", help_behavior_hint="(default: none)")] = None
    live: bool = False
    view: Annotated[int, arg(metavar="N")] = 0
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1"
    port: Annotated[int, arg(metavar="N")] = 8080
    allow_host: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = ()
    max_size: Annotated[int, arg(metavar="N")] = 800
    no_open: Annotated[bool, arg(help_behavior_hint="(default: it is opened, where there is a screen)")] = False
    scene: Annotated[str | None, arg(metavar="SCENE", help_behavior_hint="(default: the run's own)")] = None

    def run(self) -> int:
        """Serve until Ctrl-C; returns exit status 0."""
        if self.max_size < SMALLEST:
            raise InputError(f"--max-size cannot be {self.max_size}.", f"Expected {SMALLEST} pixels or more.")

        from invgraphics.viewer.launch import ViewerConfig, is_loopback, open_viewer, url_host

        runs = (self.folder,) if self.other is None else (self.folder, self.other)
        config = ViewerConfig(runs, self.live, self.view, self.host, self.port, self.max_size, self.scene, self.allow_host)
        with open_viewer(config, _notify) as viewer:
            url = f"http://{url_host(self.host)}:{viewer.port}"
            if not is_loopback(self.host):
                _notify(f"Everyone who can reach port {viewer.port} of this machine can view these runs.")
            print(f"Serving {' and '.join(map(str, runs))}: {url} (Ctrl-C to stop)", flush=True)
            if not self.no_open and _has_screen():
                webbrowser.open(url)
            with contextlib.suppress(KeyboardInterrupt):
                viewer.serve(self.live)
        return 0


def _has_screen() -> bool:
    """Whether there is a display; without one ``webbrowser`` would start a text browser in the terminal."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _notify(sentence: str) -> None:
    print(sentence, file=sys.stderr, flush=True)
