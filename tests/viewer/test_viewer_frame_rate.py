"""While the camera moves, resolution falls until ten frames a second hold: a fake renderer on a fake clock."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from invgraphics.core import Camera, Rendering, Scene
from invgraphics.testing import toy_scene
from invgraphics.viewer.cameras import ViewerCamera
from invgraphics.viewer.progressive import ProgressiveRenderer, RenderRequest, ViewerFrame

TENTH = 0.1


class Clock:
    """Seconds that pass only when something says that it takes time."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class FakeRun:
    """A run that renders constant images in ``fixed + per_pixel * pixels`` seconds."""

    def __init__(self, clock: Clock, per_pixel: float, fixed: float, independent_pixels: bool) -> None:
        self.clock, self.per_pixel, self.fixed = clock, per_pixel, fixed
        self.independent_pixels = independent_pixels
        self.scene: Scene = toy_scene(views=2, size=8)

    def to_local(self, camera: Camera, scene: Scene) -> Camera:
        return camera

    def render(self, camera: Camera, geometry: bool, crop: None = None) -> Rendering:
        self.clock.now += self.fixed + self.per_pixel * camera.width * camera.height
        size = camera.height, camera.width
        return Rendering(torch.full((*size, 3), 0.5), torch.ones(size), torch.ones(size))


def _moving(runs: tuple[FakeRun, ...], clock: Clock, encoding: float, layout: str) -> Callable[[], tuple[float, ViewerFrame]]:
    """A function that moves the camera and returns the seconds until the frame, and the frame."""
    renderer = ProgressiveRenderer(runs, clock)  # type: ignore[arg-type]
    angles = itertools.count()

    def move() -> tuple[float, ViewerFrame]:
        angle = next(angles) / 50
        pose = torch.eye(4)
        pose[0, 3], pose[2, 3] = math.sin(angle), -math.cos(angle)
        frames: list[ViewerFrame] = []

        def encode(frame: ViewerFrame) -> None:
            clock.now += encoding
            frames.append(frame)

        began = clock.now
        task = renderer.render(RenderRequest(ViewerCamera(pose, 0.8, 1.5), (900, 600), layout=layout), encode)
        next(task)  # the next movement replaces the task after its first frame
        return clock.now - began, frames[0]

    return move


@pytest.mark.parametrize("independent_pixels", [True, False])
@pytest.mark.parametrize(("per_pixel", "fixed", "encoding"), [(1e-6, 0.0, 0.0), (1e-5, 0.02, 0.01), (3e-6, 0.03, 0.03)])
def test_resolution_falls_until_ten_frames_a_second_hold(
    per_pixel: float, fixed: float, encoding: float, independent_pixels: bool
) -> None:
    clock = Clock()
    run = FakeRun(clock, per_pixel, fixed, independent_pixels)
    move = _moving((run,), clock, encoding, "first")
    for _ in range(12):
        move()
    steady = [move() for _ in range(30)]
    assert max(seconds for seconds, _ in steady) <= TENTH
    fine = steady[-1][1].size
    affordable = min((TENTH - fixed - encoding) / per_pixel, 800 * 533)
    assert fine[0] * fine[1] > 0.5 * affordable, "no coarser than it has to be"

    run.per_pixel *= 20  # into the thick of it
    slow = list(itertools.takewhile(lambda pair: pair[0] > TENTH, (move() for _ in range(20))))
    assert 1 <= len(slow) <= 3, "ten a second again after three frames"
    after = [move() for _ in range(30)]
    assert max(seconds for seconds, _ in after) <= TENTH
    assert np.prod(after[-1][1].size) < np.prod(fine)


@pytest.mark.parametrize("layout", ["split", "side by side"])
def test_two_runs_share_the_tenth_of_a_second(layout: str) -> None:
    clock = Clock()
    pair = FakeRun(clock, 1e-4, 0.0, True), FakeRun(clock, 1e-6, 0.01, False)
    move = _moving(pair, clock, 0.01, layout)
    for _ in range(12):
        move()
    assert max(move()[0] for _ in range(30)) <= TENTH


def test_refinement_over_empty_background_does_not_slow_the_next_movement() -> None:
    """Strips of the lower half of the image cost nothing."""
    clock = Clock()

    class HalfEmpty(FakeRun):
        def render(self, camera: Camera, geometry: bool, crop: None = None) -> Rendering:
            below_centre = float(camera.principal_point[1]) < camera.height / 2  # a strip of the lower half
            self.per_pixel = 1e-9 if below_centre else 1e-5
            return super().render(camera, geometry, crop)

    run = HalfEmpty(clock, 1e-5, 0.0, independent_pixels=True)
    renderer = ProgressiveRenderer((run,), clock)  # type: ignore[arg-type]
    request = RenderRequest(ViewerCamera(torch.eye(4), 0.8, 1.5), (900, 600))
    for _ in range(12):
        next(renderer.render(request, lambda _: None))
    frames: list[ViewerFrame] = []
    for _ in renderer.render(request, frames.append):
        pass
    assert frames[-1].final
    began = clock.now
    next(renderer.render(request, frames.append))
    assert clock.now - began <= TENTH
