"""Shares of a step's rays that meet the foreground, and sizes of the pictures that a fit begins with."""

from dataclasses import replace

import pytest
import torch

from invgraphics.core import Batch, Scene, View
from invgraphics.scenes.scales import resized_view
from invgraphics.testing import toy_scene
from invgraphics.training.batches import BatchConfig, Batches
from invgraphics.training.views import pixels

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def toy() -> Scene:
    return toy_scene(views=1, size=12)


@pytest.fixture
def one_pixel(toy: Scene) -> Scene:
    """One view that has alpha in one pixel of 144."""
    alpha = torch.zeros(12, 12)
    alpha[3, 5] = 1.0
    return replace(toy, train=(replace(toy.train[0], alpha=alpha),))


def test_a_mask_thinner_than_a_small_picture_s_pixels_is_drawn_from_the_large_one(toy: Scene) -> None:
    mask = torch.zeros(12, 12, dtype=torch.bool)
    mask[:, 5] = True
    scene = replace(toy, train=(replace(toy.train[0], mask=mask),))
    config = BatchConfig(rays=40, views=1, resolution=(0.25, 1.0), until=(0.5,))
    rays, _ = Batches(config, scene, torch.Generator().manual_seed(0), CPU).rays(0.0)
    pixels = scene.train[0].camera.project(rays.origins + rays.directions)[0]
    torch.testing.assert_close(pixels[:, 0], torch.full((40,), 5.5), atol=1e-3, rtol=0)


def test_rays_on_the_foreground_are_the_share_asked_for(one_pixel: Scene) -> None:
    batches = Batches(BatchConfig(rays=200, views=1, foreground=0.75), one_pixel, torch.Generator().manual_seed(0), CPU)
    _, batch = batches.rays()
    assert 150 <= int((batch.alpha > 0).sum()) <= 156
    _, batch = Batches(BatchConfig(rays=200, views=1), one_pixel, torch.Generator().manual_seed(0), CPU).rays()
    assert int((batch.alpha > 0).sum()) < 8


@pytest.mark.parametrize("solid", [[40], [40, 41, 90], list(range(0, 144, 2))])
@pytest.mark.parametrize("masked", [False, True])
def test_all_of_the_foreground_is_drawn_alike(toy: Scene, solid: list[int], masked: bool) -> None:
    """Whether it fills half of the picture, or is so small that hardly a pixel drawn at random shows it."""
    alpha, mask = torch.zeros(144), torch.ones(144, dtype=torch.bool)
    alpha[solid] = 1.0
    mask[141:] = False  # none of them has alpha in the first two cases
    view = replace(toy.train[0], alpha=alpha.view(12, 12), mask=mask.view(12, 12) if masked else None)
    config = BatchConfig(rays=28_800, views=1, foreground=1.0)
    rays, batch = Batches(config, replace(toy, train=(view,)), torch.Generator().manual_seed(0), CPU).rays()
    assert len(batch.alpha) == 28_800 and bool((batch.alpha > 0).all())
    column, row = view.camera.project(rays.origins + rays.directions)[0].floor().long().unbind(dim=1)
    counts = torch.bincount(12 * row + column, minlength=144).double()
    expected = 28_800 * alpha.double() * (mask if masked else 1)
    expected *= 28_800 / expected.sum()
    shown = expected > 0
    assert not counts[~shown].any()
    chi_square = float(((counts - expected)[shown] ** 2 / expected[shown]).sum())
    freedom = int(shown.sum()) - 1
    assert chi_square <= freedom + 4 * (2 * freedom) ** 0.5


@pytest.mark.parametrize("valid", [[40], [40, 41, 90], list(range(0, 144, 2))])
def test_all_pixels_within_a_mask_are_drawn_alike(toy: Scene, valid: list[int]) -> None:
    mask = torch.zeros(144, dtype=torch.bool)
    mask[valid] = True
    view = replace(toy.train[0], mask=mask.view(12, 12))
    config = BatchConfig(rays=28_800, views=1)
    rays, _ = Batches(config, replace(toy, train=(view,)), torch.Generator().manual_seed(0), CPU).rays()
    column, row = view.camera.project(rays.origins + rays.directions)[0].floor().long().unbind(dim=1)
    counts = torch.bincount(12 * row + column, minlength=144).double()
    assert int(counts.sum()) == 28_800 and not counts[~mask].any()
    expected = 28_800 / len(valid)
    chi_square, freedom = float(((counts[mask] - expected) ** 2 / expected).sum()), len(valid) - 1
    assert chi_square <= freedom + 4 * (2 * freedom) ** 0.5


def test_whole_pictures_are_searched_once_and_a_resumed_fit_draws_the_same(toy: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which takes 2 ms of each of 32 views of 800 x 800 pixels, at every step if nothing were kept."""
    wanted, searched = pixels._wanted, []

    def counted(view: View, with_alpha: bool, flat: torch.Tensor | None = None) -> torch.Tensor:
        searched.extend([] if flat is not None else [view.name])
        return wanted(view, with_alpha, flat)

    monkeypatch.setattr(pixels, "_wanted", counted)
    alpha, mask = torch.zeros(12, 12), torch.zeros(12, 12, dtype=torch.bool)
    alpha[3, 5], mask[3, 4:7] = 1.0, True
    views = tuple(replace(toy.train[0], alpha=alpha, mask=mask, name=name) for name in "abc")
    scene, config = replace(toy, train=views), BatchConfig(rays=300, views=3, foreground=0.5)
    generator = torch.Generator().manual_seed(0)
    batches = Batches(config, scene, generator, CPU)
    for _ in range(4):
        batches.rays()
    assert sorted(searched) == sorted(4 * "abc")  # shares of the mask and of alpha within it, and a list of each
    again = torch.Generator()
    again.set_state(generator.get_state())
    resumed = Batches(config, scene, again, CPU)
    for _ in range(3):
        (rays, _), (same, _) = batches.rays(), resumed.rays()
        assert torch.equal(rays.directions, same.directions)


def test_opaque_photographs_have_no_foreground(toy: Scene) -> None:
    opaque = replace(toy, train=(replace(toy.train[0], alpha=None),))
    drawn = [
        Batches(BatchConfig(rays=40, views=1, foreground_least=least), opaque, torch.Generator().manual_seed(0), CPU).rays()[1]
        for least in (0.0, 0.5)
    ]
    assert drawn[0].target.shape == (40, 3) and torch.equal(drawn[0].target, drawn[1].target)


def test_the_foreground_has_its_share_until_then(one_pixel: Scene) -> None:
    config = BatchConfig(rays=200, views=1, foreground=0.5, foreground_until=0.3)
    batches = Batches(config, one_pixel, torch.Generator().manual_seed(0), CPU)
    seen = [int((batches.rays(progress)[1].alpha > 0).sum()) for progress in (0.0, 0.29, 0.3, 1.0)]
    assert min(seen[:2]) >= 100
    assert max(seen[2:]) < 8
    with pytest.raises(ValueError, match="foreground_until"):
        BatchConfig(foreground_until=1.5)


def test_the_foreground_is_not_looked_for_once_its_share_has_ended(one_pixel: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes as long as a step's rays, or ten times that where photographs are large."""

    def looked(config: BatchConfig, covered: float) -> float:
        raise AssertionError("looked for the foreground")

    monkeypatch.setattr(BatchConfig, "foreground_share", looked)
    config = BatchConfig(rays=20, views=1, foreground_least=0.5, foreground_until=0.3)
    batches = Batches(config, one_pixel, torch.Generator().manual_seed(0), CPU)
    with pytest.raises(AssertionError, match="looked"):
        batches.rays(0.29)
    batches.rays(0.3)
    Batches(BatchConfig(rays=20, views=1), one_pixel, torch.Generator().manual_seed(0), CPU).rays(0.0)


def test_the_least_share_counts_the_rays_that_meet_the_foreground_anyway(toy: Scene) -> None:
    alpha = torch.zeros(12, 12)
    alpha[:3] = 1.0  # a quarter
    scene = replace(toy, train=(replace(toy.train[0], alpha=alpha),))

    def rays(**values: float) -> Batch:
        config = BatchConfig(rays=40_000, views=1, **values)
        return Batches(config, scene, torch.Generator().manual_seed(0), CPU).rays(0.1)[1]

    assert float((rays(foreground_least=0.4).alpha > 0).float().mean()) == pytest.approx(0.4, abs=0.01)
    assert float((rays(foreground=0.4).alpha > 0).float().mean()) == pytest.approx(0.4 + 0.6 / 4, abs=0.01)
    assert torch.equal(rays(foreground_least=0.25).target, rays().target)  # where it is there already, the same rays
    assert torch.equal(rays(foreground_least=0.4, foreground_until=0.1).target, rays().target)
    with pytest.raises(ValueError, match="foreground_least"):
        BatchConfig(foreground_least=-0.1)


def test_the_least_share_is_of_the_pixels_within_the_mask(toy: Scene) -> None:
    alpha, mask = torch.zeros(12, 12), torch.zeros(12, 12, dtype=torch.bool)
    alpha[:3] = 1.0
    mask[:6] = True  # of which half has alpha
    scene = replace(toy, train=(replace(toy.train[0], alpha=alpha, mask=mask),))
    config = BatchConfig(rays=40_000, views=1, foreground_least=0.4)
    _, batch = Batches(config, scene, torch.Generator().manual_seed(0), CPU).rays()
    assert float((batch.alpha > 0).float().mean()) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(
    ("edge", "sizes"),
    [(16, [16]), (22, [22]), (24, [12, 24]), (40, [20, 40]), (48, [12, 24, 48]), (64, [16, 32, 64]), (100, [12, 25, 50, 100])],
)
def test_large_pictures_begin_near_the_size_asked_for(edge: int, sizes: list[int]) -> None:
    """Halved until within a factor of the square root of two of 16 px; every size has an equal part of the first 60 %."""
    scene = toy_scene(views=2, size=edge)
    batches = Batches(BatchConfig(start_size=16, start_until=0.6), scene, torch.Generator().manual_seed(0), CPU)
    parts = len(sizes) - 1
    for part, size in enumerate(sizes[:-1]):
        for progress in (0.6 * part / parts + 1e-6, 0.6 * (part + 1) / parts - 1e-6):
            assert batches.image(progress)[0].width == size
    for progress in (0.6 if parts else 0.0, 1.0):
        assert batches.image(progress)[0].width == edge


def test_pictures_of_different_sizes_begin_alike() -> None:
    small, large = toy_scene(views=1, size=32), toy_scene(views=1, size=64)
    scene = large.with_views(train=(small.train[0], large.train[0]))
    batches = Batches(BatchConfig(start_size=16), scene, torch.Generator().manual_seed(0), CPU)

    def widths(progress: float) -> list[int]:
        drawn = [batches.image(progress) for _ in range(4)]
        return [camera.width for camera, _ in sorted(drawn, key=lambda pair: pair[1].view)]

    assert widths(0.0) == [16, 16, 16, 16]
    assert widths(0.3) == [16, 16, 32, 32]
    assert widths(0.5) == [32, 32, 64, 64]
    with pytest.raises(ValueError, match="start_size"):
        BatchConfig(start_size=-1)
    with pytest.raises(ValueError, match="start_until"):
        BatchConfig(start_until=0.0)


def test_small_pictures_lie_together_and_not_between_what_they_were_made_from(toy: Scene) -> None:
    large = replace(toy, train=tuple(resized_view(view, 96, 96) for view in toy.train) * 3)
    batches = Batches(BatchConfig(start_size=24), large, torch.Generator().manual_seed(0), CPU)
    storages, shown = set(), {}
    for _ in large.train:
        _, batch = batches.image(0.0)
        storages.add(batches._scaled_views[batch.view][1].image.untyped_storage().data_ptr())
        shown[batch.view] = batches._scaled_views[batch.view][1]
    assert len(shown) == len(large.train) > 1
    assert len(storages) == 1
    for index, view in shown.items():
        direct = resized_view(large.train[index], 24, 24)
        assert torch.equal(view.image, direct.image)
        assert view.alpha is not None and direct.alpha is not None
        assert torch.equal(view.alpha, direct.alpha)


def test_of_two_schedules_the_smaller_picture_counts() -> None:
    config = BatchConfig(resolution=(0.5, 1.0), until=(0.1,), start_size=16, start_until=0.4)
    scales = [config.scale_at(progress, 64) for progress in (0.05, 0.15, 0.25, 0.4)]
    assert scales == [0.25, 0.25, 0.5, 1.0]
    assert [config.scale_at(progress, 16) for progress in (0.05, 0.15)] == [0.5, 1.0]
