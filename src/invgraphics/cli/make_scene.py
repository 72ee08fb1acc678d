"""``invgraphics make-scene``: render a scene's ground truth with Mitsuba, cached by content."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from invgraphics.cli.arguments import parse_size
from invgraphics.errors import InputError


@dataclass(frozen=True)
class MakeScene:
    """Render a scene's ground truth with Mitsuba: colour, alpha, depth, normals, points and mesh. Done once, then cached.

    Attributes:
        scene: A built-in scene (see `invgraphics list scenes`), or the path of a scene.toml.
        views: Training views.
        test_views: Test views.
        size: Size of the pictures; one number is the longest side.
        spp: Samples per pixel of the training views; the others keep their proportion.
        instances: Instances of a class of objects (chairs, mugs), one seed each; a ninth of them stay unseen by the fit.
        seed: Seed of cameras and of the renderer's noise.
        out: Copy the data set here.
    """

    scene: Annotated[Positional[str], arg(metavar="SCENE")]
    views: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: the scene's own)")] = None
    test_views: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: the scene's own)")] = None
    size: Annotated[str | None, arg(metavar="WIDTHxHEIGHT|N", help_behavior_hint="(default: the scene's own)")] = None
    spp: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: the scene's own)")] = None
    instances: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: the class's own)")] = None
    seed: int = 0
    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: the cache only)")] = None

    def run(self) -> int:
        """Render, or find in the cache; prints the data set's folder. Returns exit status 0."""
        size = None if self.size is None else self._size(self.size)
        if self.out is not None:
            _check_target(self.out)

        from invgraphics.experiments.progress import Reporter
        from invgraphics.scenes.mitsuba import make
        from invgraphics.scenes.mitsuba.spec import description_path, read

        with Reporter(f"rendering {self.scene}") as reporter:
            folder = make(
                self.scene if self.instances is None else read(description_path(self.scene)).with_instances(self.instances),
                size=size,
                train=self.views,
                test=self.test_views,
                spp=self.spp,
                seed=self.seed,
                out=self.out,
                progress=lambda done, total, what: reporter.show(done / max(total, 1), what),
            )
        print(folder)
        return 0

    def _size(self, text: str) -> tuple[int, int]:
        """Width and height in pixels; a longest side alone keeps the scene's aspect ratio."""
        size = parse_size(text)
        if isinstance(size, tuple):
            return size

        from invgraphics.scenes.mitsuba.spec import description_path, read

        width, height = read(description_path(self.scene)).size
        return round(size * width / max(width, height)), round(size * height / max(width, height))


def _check_target(out: Path) -> None:
    """Check before rendering that the copy can be written."""
    taken = out.exists() and (not out.is_dir() or (any(out.iterdir()) and not (out / "truth.json").is_file()))
    if taken:
        raise InputError(f"{out} already exists and holds something else.", "Choose a new or empty folder.")
    out.parent.mkdir(parents=True, exist_ok=True)
