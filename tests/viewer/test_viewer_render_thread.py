"""Sizes follow the measured speed, and newer work ends older work."""

import itertools
import threading
import time

import pytest

from invgraphics.viewer.render_thread import RenderThread
from invgraphics.viewer.resolution import MIN_PIXELS, PYRAMID_FACTOR, TARGET_SECONDS, AdaptiveResolution


@pytest.mark.parametrize(("per_pixel", "fixed"), [(1e-6, 0.0), (1e-5, 0.02), (1e-4, 0.0), (3e-5, 0.05)])
def test_the_pace_settles_at_what_the_renderer_manages(per_pixel: float, fixed: float) -> None:
    pace = AdaptiveResolution()
    for _ in range(20):
        pixels = round(pace.pixels)
        pace.update(pixels, fixed + per_pixel * pixels)
    assert fixed + per_pixel * pace.pixels == pytest.approx(TARGET_SECONDS, rel=0.05)


def test_the_budget_falls_fast_and_rises_slowly() -> None:
    pace = AdaptiveResolution(pixels=10_000)
    pace.update(10_000, 60.0)
    assert pace.pixels == 1_250
    pace.update(1_250, 1e-9)
    assert pace.pixels == 2_500
    for _ in range(30):
        pace.update(10_000, 1e3)
    assert pace.pixels == MIN_PIXELS


@pytest.mark.parametrize("pixels", [600, 5_000, 40_000, 250_000, 479_000, 480_000, 10**6])
def test_pictures_grow_from_what_is_fast_to_the_whole(pixels: float) -> None:
    scales = AdaptiveResolution(pixels=pixels).pyramid_scales(800, 600)
    assert scales[-1] == 1.0 and scales == sorted(set(scales))
    if pixels < 480_000:
        assert (scales[0] ** 2 * 480_000) == pytest.approx(pixels)
        work = sum(scale**2 for scale in scales[:-1])
        assert work < 0.35 or len(scales) == 2, "what leads to the whole picture costs little of it"
        assert all(finer / coarser <= PYRAMID_FACTOR**1.5 for coarser, finer in itertools.pairwise(scales))
    assert AdaptiveResolution(pixels=pixels).pyramid_scales(800, 600, skip_coarse=True) == [1.0]


def test_strips_are_as_long_as_a_coarse_picture() -> None:
    assert AdaptiveResolution(pixels=1000).strip_rows(100) == 10
    assert AdaptiveResolution(pixels=1000).strip_rows(5000) == 1


@pytest.fixture
def worker():
    complaints = []
    one = RenderThread(lambda key, error: complaints.append((key, error)))
    one.complaints = complaints
    one.start()
    yield one
    one.stop()


def _wait(condition, seconds: float = 5.0) -> None:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.002)
    assert condition()


def test_a_newer_job_ends_an_older_one_after_its_piece(worker) -> None:
    done, started, go = [], threading.Event(), threading.Event()

    def long(name: str):
        for piece in range(1000):
            done.append((name, piece))
            started.set()
            go.wait(5)
            yield 0.0

    def short(name: str):
        done.append((name, "all"))
        yield 0.0

    worker.submit("a", long("old"))
    started.wait(5)
    for index in range(5):
        worker.submit("a", short(f"new {index}"))
    go.set()
    _wait(lambda: ("new 4", "all") in done)
    assert done == [("old", 0), ("new 4", "all")], "one piece of the old one, and only the newest"


def test_what_has_just_begun_goes_before_what_refines(worker) -> None:
    done, go = [], threading.Event()

    def job(name: str, pieces: int):
        for piece in range(pieces):
            if name == "gate":
                go.wait(5)
            done.append(f"{name}{piece}")
            yield 0.0

    worker.submit("gate", job("gate", 1))
    worker.submit("a", job("a", 3))
    worker.submit("b", job("b", 2))
    go.set()
    _wait(lambda: len(done) == 6)
    assert done == ["gate0", "a0", "b0", "a1", "b1", "a2"]


def test_a_pause_is_kept_and_broken_by_news(worker) -> None:
    done = []

    def job(name: str, pause: float):
        done.append((name, time.monotonic()))
        yield pause
        done.append((name, time.monotonic()))

    worker.submit("a", job("a", 0.15))
    _wait(lambda: len(done) == 2)
    assert done[1][1] - done[0][1] >= 0.15
    worker.submit("b", job("b", 60.0))
    _wait(lambda: len(done) == 3)
    worker.submit("b", job("c", 0.0))
    _wait(lambda: len(done) == 5)
    assert [name for name, _ in done] == ["a", "a", "b", "c", "c"]


def test_a_job_that_fails_is_complained_about_and_the_next_one_done(worker) -> None:
    done = []

    def broken():
        yield 0.0
        raise ValueError("no such picture")

    def sound():
        done.append(1)
        yield 0.0

    worker.submit("a", broken())
    _wait(lambda: bool(worker.complaints))
    assert worker.complaints[0][0] == "a" and "no such picture" in str(worker.complaints[0][1])
    worker.submit("a", sound())
    _wait(lambda: done == [1])


def test_what_is_forgotten_is_not_done(worker) -> None:
    done, started, go = [], threading.Event(), threading.Event()

    def gate():
        started.set()
        go.wait(5)
        yield 0.0

    def job():
        done.append(1)
        yield 0.0

    worker.submit("gate", gate())
    started.wait(5)
    worker.submit("a", job())
    worker.cancel("a")
    go.set()
    worker.stop()
    assert done == []


def test_what_is_cancelled_lets_go_at_once(worker) -> None:
    """A film's encoder and folder, with no other task that would wake the thread; those left at the end too."""
    ended, begun = [], threading.Event()

    def film(name: str):
        try:
            begun.set()
            while True:
                yield 60.0
        finally:
            ended.append(name)

    worker.submit("film", film("cancelled"))
    begun.wait(5)
    worker.cancel("film")
    _wait(lambda: ended == ["cancelled"])
    begun.clear()
    worker.submit("film", film("replaced"))
    begun.wait(5)
    begun.clear()
    worker.submit("film", film("left"))
    begun.wait(5)
    _wait(lambda: ended == ["cancelled", "replaced"])
    worker.stop()
    assert ended == ["cancelled", "replaced", "left"]
