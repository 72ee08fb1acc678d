"""What a toy would fail: fits learn, depend on the right things only, repeat and resume bit by bit."""

import copy
import itertools
import math
import time
from dataclasses import replace

import pytest
import torch

from invgraphics.core import Scene, View
from invgraphics.errors import InputError, NumericalError
from invgraphics.experiments.recorder import Monitor
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT
from invgraphics.training.clock import SchedulerTimes
from invgraphics.training.fit import Fit

METHODS = ["volumetric/nerf", "volumetric/hash", "splatting/gaussians"]
STEPS = {"volumetric/nerf": 200, "volumetric/hash": 220, "splatting/gaussians": 120}
FAST = {
    "volumetric/nerf": ["optimiser.groups.field.lr=1.5e-2", "optimiser.groups.field.final=2e-3"],
    "volumetric/hash": ["renderer.sampler.grace=8", "optimiser.groups.table.lr=5e-2"],
    "splatting/gaussians": [],
}
"""Rates at which few steps are enough."""


def _psnr(fit) -> float:
    scene = fit.plan.scene
    errors = []
    with torch.no_grad():
        for view in scene.test:
            picture = fit.plan.model.render(view.camera)
            errors.append((picture.over(scene.background).clamp(0, 1) - view.over(scene.background)).square().mean())
    return -10 * math.log10(float(torch.stack(errors).mean()))


def _equal(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(
        a[part].keys() == b[part].keys() and all(torch.equal(a[part][name], b[part][name]) for name in a[part]) for part in a
    )


@pytest.mark.parametrize("name", METHODS)
def test_poses_matter(name: str, scene, make_fit) -> None:
    """Shuffling the training poses costs more than 5 dB, so what is learnt is the scene and not an average."""
    fit = make_fit(name, scene, STEPS[name], 0, *FAST[name])
    fit.run(lambda loss: False)
    order = [(i + 5) % len(scene.train) for i in range(len(scene.train))]
    shuffled = tuple(replace(view, camera=scene.train[j].camera) for view, j in zip(scene.train, order, strict=True))
    wrong = make_fit(name, scene.with_views(train=shuffled), STEPS[name], 0, *FAST[name])
    wrong.run(lambda loss: False)
    assert _psnr(fit) > _psnr(wrong) + 5


@pytest.mark.parametrize("name", ["volumetric/hash", "splatting/gaussians"])
def test_pixels_that_do_not_count_change_nothing(name: str, scene, make_fit) -> None:
    def with_garbage(colour: float) -> Scene:
        def garbage(view: View) -> View:
            mask = torch.arange(view.camera.width).expand(view.camera.height, -1) < view.camera.width // 2
            image = torch.where(mask[..., None], view.over(scene.background), colour)
            return replace(view, image=image, alpha=None, mask=mask)

        return scene.with_views(train=tuple(garbage(view) for view in scene.train))

    states = []
    for colour in (0.0, 0.9):
        fit = make_fit(name, with_garbage(colour), 5)
        fit.run(lambda loss: False)
        states.append(fit.state())
    assert _equal(*states)


def test_the_monitor_sees_every_pixel_of_small_views_once(scene, make_fit, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Monitor, "PIXELS", 4096)
    assert len(scene.test) * scene.test[0].image[..., 0].numel() < 4096
    fit = make_fit("splatting/gaussians", scene, 1)
    assert Monitor(scene, torch.device("cpu")).psnr(fit) == pytest.approx(_psnr(fit), abs=1e-4)


@pytest.mark.parametrize("most", [40, 4096])
def test_the_monitor_looks_only_at_pixels_that_count(scene, make_fit, monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    """Whatever stands where a view is masked out, the curve is the same."""
    monkeypatch.setattr(Monitor, "PIXELS", most)
    fit, found = make_fit("splatting/gaussians", scene, 1), []
    for colour in (0.0, 0.9):
        views = []
        for view in scene.test:
            mask = torch.arange(view.camera.width).expand(view.camera.height, -1) % 3 == 1
            image = torch.where(mask[..., None], view.over(scene.background), colour)
            views.append(replace(view, image=image, alpha=None, mask=mask))
        found.append(Monitor(scene.with_views(test=tuple(views), val=()), torch.device("cpu")).psnr(fit))
    assert found[0] == found[1]


@pytest.mark.parametrize("name", METHODS)
def test_test_pixels_never_reach_the_fit(name: str, scene, make_fit) -> None:
    noise = tuple(replace(view, image=torch.randint(0, 255, view.image.shape, dtype=torch.uint8)) for view in scene.test)
    a, b = make_fit(name, scene, 8), make_fit(name, scene.with_views(test=noise), 8)
    a.run(lambda loss: False)
    b.run(lambda loss: False)
    assert _equal(a.state(), b.state())


@pytest.mark.parametrize("name", METHODS)
def test_seed_decides(name: str, scene, make_fit) -> None:
    fits = [make_fit(name, scene, 5, seed) for seed in (3, 3, 4)]
    for fit in fits:
        fit.run(lambda loss: False)
    assert _equal(fits[0].state(), fits[1].state())
    assert not _equal(fits[0].state(), fits[2].state())


@pytest.mark.parametrize("name", METHODS)
def test_resumed_equals_uninterrupted(name: str, scene, make_fit, tmp_path) -> None:
    """Through the checkpoint file, between two rounds of density control, and across occupancy refreshes."""
    whole = make_fit(name, scene, 40)
    whole.run(lambda loss: False)
    first = make_fit(name, scene, 40)
    first.run(lambda loss: first.steps == 13)
    checkpoint.save(tmp_path / CHECKPOINT, first.state())
    torch.manual_seed(99)
    second = make_fit(name, scene, 40)
    second.load(checkpoint.load(tmp_path / CHECKPOINT), seconds=1.0)
    assert second.steps == 13
    second.run(lambda loss: False)
    assert _equal(whole.state(), second.state())


@pytest.mark.parametrize(("threshold", "prune", "sign"), [(1e-5, 0.005, 1), (1e3, 0.09, -1)])
def test_gaussian_count_goes_up_and_down(threshold: float, prune: float, sign: int, scene, make_fit) -> None:
    """Growth alone raises the count, pruning alone lowers it; nothing changes between rounds."""
    settings = [f"hooks.1.threshold={threshold}", f"hooks.1.prune_opacity={prune}"]
    fit = make_fit("splatting/gaussians", scene, 100, 0, *settings)
    counts = [fit.plan.model.field.primitive_count()]
    fit.run(lambda loss: counts.append(fit.plan.model.field.primitive_count()) or False)
    changes = {step: sign * (b - a) for step, (a, b) in enumerate(itertools.pairwise(counts), start=1)}
    assert max(changes.values()) > 0
    assert min(changes.values()) == 0
    assert all(step % 10 == 0 for step, change in changes.items() if change)


def test_nan_names_step_and_tensor(scene, make_fit) -> None:
    fit = make_fit("volumetric/nerf", scene, 10)

    def poison(loss: float) -> bool:
        if fit.steps == 3:
            with torch.no_grad():
                next(fit.plan.model.field.parameters()).view(-1)[0] = torch.nan
        return False

    name = next(name for name, _ in fit.plan.model.field.named_parameters())
    with pytest.raises(NumericalError, match=rf"Step 3: 1 of [\d,]+ values of 'field\.{name}' is not finite"):
        fit.run(poison)


def test_state_holds_no_clock(scene, make_fit) -> None:
    fit = make_fit("volumetric/nerf", scene, 2)
    fit.run(lambda loss: False)
    before = copy.deepcopy(fit.state())
    fit.seconds += 100
    assert _equal(before, fit.state())


def test_processor_time_is_counted_beside_the_clock(scene, make_fit) -> None:
    fit = make_fit("volumetric/nerf", scene, 3)
    began = time.process_time()
    fit.run(lambda loss: False)
    clocks = fit.clocks()
    assert 0 < clocks["cpu_seconds"] <= time.process_time() - began
    resumed = make_fit("volumetric/nerf", scene, 9)
    resumed.load(fit.state(), clocks["seconds"])
    resumed.resume_clocks(clocks)
    resumed.warmup_step()  # on no clock
    assert (resumed.clocks()["seconds"], resumed.clocks()["cpu_seconds"]) == (clocks["seconds"], clocks["cpu_seconds"])
    if clocks["ran_seconds"] is not None:
        assert resumed.clocks()["ran_seconds"] >= clocks["ran_seconds"] > 0


def test_a_standstill_is_not_optimisation(scene, make_fit, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SchedulerTimes, "standstill", lambda self, seconds, cpu_seconds: 0.75 * seconds)
    fit = make_fit("volumetric/nerf", scene, 3)
    began = time.perf_counter()
    fit.run(lambda loss: False)
    passed = time.perf_counter() - began
    assert fit.standstill_seconds == pytest.approx(3 * fit.seconds)
    assert 0 < fit.seconds + fit.standstill_seconds <= passed
    resumed = make_fit("volumetric/nerf", scene, 9)
    resumed.resume_clocks(fit.clocks())
    assert resumed.standstill_seconds == fit.standstill_seconds > 0


def test_every_fit_sees_to_waiting_threads(scene, make_fit, monkeypatch) -> None:
    calls = []
    monkeypatch.setattr("invgraphics.training.fit.limit_spinning", lambda: calls.append(1))
    make_fit("volumetric/nerf", scene, 1)
    assert calls == [1]


def test_losses_and_hooks_that_break_their_contract_are_named(scene, make_fit) -> None:
    """As those of a plug-in may."""
    fit = make_fit("splatting/gaussians", scene, 3)

    def per_pixel(rendering, trace, batch, ctx) -> torch.Tensor:
        return rendering.rgb - batch.target

    fit.plan = replace(fit.plan, losses=[per_pixel])
    with pytest.raises(InputError, match=r"loss builtins.function returned a tensor of shape \("):
        fit.step()
    fit.plan = replace(fit.plan, losses=[lambda *_: 0.0])
    with pytest.raises(InputError, match=r"returned 0\.0"):
        fit.step()
    with pytest.raises(InputError, match="neither losses nor penalties"):
        Fit(replace(fit.plan, losses=[], penalties=()))
    with pytest.raises(InputError, match=r"The hook builtins\.object is no training\.hooks\.Hook"):
        Fit(replace(fit.plan, hooks=[object()]))
