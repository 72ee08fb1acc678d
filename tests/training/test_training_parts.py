"""Losses, optimiser, batches, budget and checkpoint, each against an independent route."""

from dataclasses import replace

import pytest
import torch

from invgraphics.core import Batch, Bounds, Context, Rays, Rendering, Samples, Scene, Screen, Trace
from invgraphics.core.samples import FieldValues
from invgraphics.errors import InputError
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT
from invgraphics.training.batches import BatchConfig, Batches
from invgraphics.training.budget import Budget
from invgraphics.training.hooks import FitState, Hook, ShDegreeConfig
from invgraphics.training.losses import CoarseLoss, DistortionLoss, MaskLoss, OpacityLoss, PhotometricLoss, ScaleLoss, SsimLoss
from invgraphics.training.optimiser import GroupConfig, Optimiser, OptimiserConfig

BOX = Bounds(-torch.ones(3), torch.ones(3))
CTX = Context(BOX, training=True)


def _rendering(*shape: int) -> tuple[Rendering, Batch]:
    alpha = torch.rand(*shape)
    picture = Rendering(torch.rand(*shape, 3) * alpha[..., None], alpha, torch.ones(*shape))
    return picture, Batch(torch.rand(*shape, 3), torch.ones(*shape), torch.tensor([0.2, 0.5, 0.9]))


def _samples(rays: int, per_ray: int, spread: float = 1.0) -> Samples:
    edges = spread * torch.rand(rays, per_ray + 1).sort(dim=1).values + 0.5
    directions = torch.nn.functional.normalize(torch.randn(rays, 3), dim=1)
    packed = Rays.make(torch.zeros(rays, 3), directions)
    ray = torch.arange(rays).repeat_interleave(per_ray)
    return Samples.on(packed, ray, edges[:, :-1].reshape(-1), edges[:, 1:].reshape(-1))


def test_photometric_distances() -> None:
    picture, batch = _rendering(7)
    difference = picture.rgb - batch.target
    squared = float((difference**2).mean())
    assert PhotometricLoss(2.0, "mse")(picture, Trace(), batch, CTX) == pytest.approx(2 * squared)
    assert PhotometricLoss(1.0, "l1")(picture, Trace(), batch, CTX) == pytest.approx(float(difference.abs().mean()))
    small = difference.abs() < 0.1
    huber = 10 * torch.where(small, difference**2 / 2, 0.1 * (difference.abs() - 0.05)).mean()
    assert PhotometricLoss(1.0, "huber")(picture, Trace(), batch, CTX) == pytest.approx(float(huber), rel=1e-5)


def test_coarse_loss_is_the_level_composited_by_hand() -> None:
    samples = _samples(5, 4)
    weights, radiance = torch.rand(20) / 4, torch.rand(20, 3)
    level = Trace(samples, FieldValues(radiance=radiance), weights, rays=5)
    picture, batch = _rendering(5)
    colour = (weights[:, None] * radiance).view(5, 4, 3).sum(1)
    colour = colour + (1 - weights.view(5, 4).sum(1, keepdim=True)) * batch.background
    got = CoarseLoss()(picture, Trace(levels=(level,)), batch, CTX)
    assert got == pytest.approx(float(((colour - batch.target) ** 2).mean()), rel=1e-5)


def _distortion(samples: Samples, weights: torch.Tensor, bounds: Bounds, rays: int) -> float:
    picture, batch = _rendering(rays)
    trace = Trace(samples, None, weights, rays=rays)
    return float(DistortionLoss(1.0)(picture, trace, batch, Context(bounds, training=True)))


def _by_hand(t: float, space: str, radius: float) -> float:
    """Mip-NeRF 360's s: distance over the longest ray in a box; distance, then disparity, each over half of [0, 1]."""
    if space == "box":
        return t / (2 * radius)
    return t / radius / 2 if t < radius else 1 - radius / t / 2


@pytest.mark.parametrize("space", ["box", "contracted"])
def test_distortion_is_the_papers_double_integral(space: str) -> None:
    """Equation 14, the integral of w(u) w(v) |u - v| over all pairs of points, by midpoints."""
    bounds, samples, weights = replace(BOX, space=space), _samples(3, 6, spread=3.0), torch.rand(18)
    edges = [[_by_hand(float(t), space, 3**0.5) for t in ends] for ends in zip(samples.t0, samples.t1, strict=True)]
    expected = 0.0
    for i, (a, b) in enumerate(edges):
        for j, (c, d) in enumerate(edges):
            if samples.ray[i] == samples.ray[j]:
                u, v = (torch.linspace(0, 1, 401, dtype=torch.float64)[1:] - 1 / 800 for _ in range(2))
                gaps = (a + (b - a) * u)[:, None] - (c + (d - c) * v)[None]
                expected += float(weights[i] * weights[j] * gaps.abs().mean())
    assert _distortion(samples, weights, bounds, 3) == pytest.approx(expected / 3, rel=1e-4)


def test_distortion_in_a_box_does_not_depend_on_where_the_camera_stands() -> None:
    samples, weights = _samples(2, 5), torch.rand(10)
    moved = replace(samples, t0=samples.t0 + 2.0, t1=samples.t1 + 2.0)
    assert _distortion(moved, weights, BOX, 2) == pytest.approx(_distortion(samples, weights, BOX, 2), rel=1e-4)


def test_losses_see_the_rendering_in_front_of_the_background(scene, make_fit) -> None:
    """Composited once by the step; alpha stays the scene's own."""
    fit = make_fit("volumetric/hash", scene, 2)
    seen = []

    def record(rendering: Rendering, trace: Trace, batch: Batch, ctx: Context) -> torch.Tensor:
        seen.append((rendering, batch))
        return rendering.rgb.sum() * 0

    class Keep(Hook):
        def after_backward(self, state: FitState) -> None:
            seen.append(state.rendering)

    fit.plan = replace(fit.plan, losses=[record, record], hooks=[Keep()])
    fit.step()
    (first, batch), (second, _), raw = seen
    assert first is second and torch.equal(first.alpha, raw.alpha)
    torch.testing.assert_close(first.rgb, raw.rgb + (1 - raw.alpha[:, None]) * batch.background)


def test_ssim_loss_of_the_truth_is_zero() -> None:
    truth = torch.rand(24, 20, 3)
    picture = Rendering(truth, torch.ones(24, 20), torch.ones(24, 20))
    batch = Batch(truth, torch.ones(24, 20), torch.ones(3))
    assert SsimLoss(1.0)(picture, Trace(), batch, CTX) == pytest.approx(0.0, abs=1e-5)


def test_losses_on_gaussians_are_means_over_all_of_them() -> None:
    picture, batch = _rendering(2, 3)
    opacities, scales = torch.tensor([0.2, 0.8]), torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.9]])
    trace = Trace(screen=Screen(torch.zeros(2, 2), torch.tensor([1.0, 0.0]), 3, 2, opacities=opacities, scales=scales))
    assert float(OpacityLoss(2.0)(picture, trace, batch, CTX)) == pytest.approx(2 * 0.5)
    assert float(ScaleLoss(0.5)(picture, trace, batch, CTX)) == pytest.approx(0.5 * 0.4)
    assert float(OpacityLoss()(picture, Trace(), batch, CTX)) == float(ScaleLoss()(picture, Trace(), batch, CTX)) == 0


def test_learning_rates_follow_progress() -> None:
    parameter = torch.nn.Parameter(torch.zeros(2))
    config = OptimiserConfig({"a": GroupConfig("field", 1e-2, 1e-4, warmup=0.1, per_extent=True)})
    optimiser = Optimiser(config, {"field.x": parameter}, extent=3.0)
    optimiser.set_progress(0.5)
    assert optimiser.rates()["a"] == pytest.approx(3 * 1e-3)
    optimiser.set_progress(0.05)
    assert optimiser.rates()["a"] == pytest.approx(3 * 1e-2 * 0.01**0.05 * (0.01 + 0.99 * 0.5))
    cosine = GroupConfig("field", 1.0, 0.2, schedule="cosine")
    assert cosine.rate(0.5) == pytest.approx(0.6)


def test_longest_match_wins_and_every_parameter_needs_a_group() -> None:
    parameters = {"field.encoding.table": torch.nn.Parameter(torch.zeros(1)), "field.net.w": torch.nn.Parameter(torch.zeros(1))}
    both = OptimiserConfig({"all": GroupConfig("field", 1.0), "table": GroupConfig("field.encoding", 2.0)})
    optimiser = Optimiser(both, parameters, 1.0)
    for parameter in parameters.values():
        parameter.grad = torch.ones(1)
    optimiser.step()
    assert float(parameters["field.encoding.table"].detach()) == pytest.approx(-2.0)
    assert float(parameters["field.net.w"].detach()) == pytest.approx(-1.0)
    with pytest.raises(InputError, match=r"No optimiser group matches the parameter 'field\.net\.w'"):
        Optimiser(OptimiserConfig({"table": GroupConfig("field.encoding", 2.0)}), parameters, 1.0)
    with pytest.raises(InputError, match="matches no parameter"):
        Optimiser(OptimiserConfig({"a": GroupConfig("field", 1.0), "b": GroupConfig("field.enc", 1.0)}), parameters, 1.0)


def test_rays_carry_the_right_pixels(scene) -> None:
    batches = Batches(BatchConfig(rays=200, views=5), scene, torch.Generator().manual_seed(0), torch.device("cpu"))
    rays, batch = batches.rays()
    assert len(rays) == 200
    assert len(rays.view.unique()) == 5
    for ray in range(0, 200, 17):
        view = scene.train[int(rays.view[ray])]
        pixel, _ = view.camera.project((rays.origins[ray] + rays.directions[ray])[None])
        x, y = (int(value) for value in pixel[0])
        alpha = float(view.alpha[y, x]) / 255
        expected = view.image[y, x].float() / 255 * alpha + (1 - alpha) * batch.background
        assert torch.allclose(batch.target[ray], expected, atol=1e-6)


def test_background_is_random_only_where_there_is_alpha(scene) -> None:
    generator = torch.Generator().manual_seed(0)
    batches = Batches(BatchConfig(), scene, generator, torch.device("cpu"))
    assert not torch.equal(batches.background(), batches.background())
    from dataclasses import replace

    opaque = scene.with_views(train=tuple(replace(view, alpha=None) for view in scene.train))
    assert torch.equal(Batches(BatchConfig(), opaque, generator, torch.device("cpu")).background(), scene.background)
    # Unless a method asks for it, in endless space: there every ray ends somewhere.
    for space, random in (("box", False), ("contracted", True)):
        placed = replace(opaque, bounds=replace(opaque.bounds, space=space))
        batches = Batches(BatchConfig(opaque=True), placed, generator, torch.device("cpu"))
        assert torch.equal(batches.background(), batches.background()) != random


def test_ray_count_follows_samples(scene) -> None:
    batches = Batches(BatchConfig(rays=100, samples=5000), scene, torch.Generator(), torch.device("cpu"))
    for _ in range(30):
        batches.observe(25 * len(batches.rays()[0]))
    assert len(batches.rays()[0]) == pytest.approx(200, abs=2)


def test_every_view_comes_once_before_any_comes_again(scene) -> None:
    batches = Batches(BatchConfig(), scene, torch.Generator().manual_seed(0), torch.device("cpu"))
    drawn = [batches.image(0.5)[1].view for _ in range(2 * len(scene.train))]
    assert sorted(drawn[: len(scene.train)]) == list(range(len(scene.train)))
    assert sorted(drawn[len(scene.train) :]) == list(range(len(scene.train)))


@pytest.mark.parametrize(("width", "scale"), [(101, 0.5), (101, 0.25), (100, 0.75), (64, 0.5)])
def test_coarse_pictures_show_what_their_cameras_do_at_any_size(scene: Scene, width: int, scale: float) -> None:
    """The mean of a linear ramp over a pixel is the ramp at its centre; a tenth of a pixel is for pixels that are cut."""
    ramp = (torch.arange(width) + 0.5).expand(8, width)[..., None].expand(8, width, 3) / width
    camera = replace(scene.train[0].camera, width=width, height=8)
    view = replace(scene.train[0], camera=camera, image=ramp, alpha=None, depth=None, normal=None)
    config = BatchConfig(resolution=(scale, 1.0), until=(0.5,))
    batches = Batches(config, scene.with_views(train=(view,)), torch.Generator().manual_seed(0), torch.device("cpu"))
    small, batch = batches.image(0.1)
    assert small.width == round(scale * width)
    centres = (torch.arange(small.width) + 0.5) / small.width
    assert float((batch.target[1, :, 0] - centres).abs().max()) < 0.1 / width


def test_lower_resolution_keeps_what_cameras_see(scene) -> None:
    config = BatchConfig(resolution=(0.5, 1.0), until=(0.3,))
    batches = Batches(config, scene, torch.Generator().manual_seed(0), torch.device("cpu"))
    camera, batch = batches.image(0.1)
    full = scene.train[batch.view]
    assert (camera.width, camera.height) == (full.camera.width // 2, full.camera.height // 2)
    expected = full.over(batch.background).view(12, 2, 12, 2, 3).mean(dim=(1, 3))
    assert torch.allclose(batch.target, expected, atol=0.01)
    assert batches.image(0.3)[0].width == full.camera.width


@pytest.mark.parametrize(
    ("text", "seconds", "steps"), [("60s", 60, None), ("1.5m", 90, None), ("1h", 3600, None), ("50steps", None, 50)]
)
def test_budget_reads(text: str, seconds: float | None, steps: int | None) -> None:
    assert Budget.parse(text) == Budget(seconds, steps)


@pytest.mark.parametrize("text", ["-5s", "0s", "0steps", "5", "1.5steps", "fast", "", "5 parsecs", "nan s"])
def test_budget_refuses(text: str) -> None:
    with pytest.raises(InputError, match="is not a budget"):
        Budget.parse(text)


def test_progress_is_whichever_is_further() -> None:
    assert Budget(seconds=10).progress(5, 1000) == 0.5
    assert Budget(seconds=10, steps=100).progress(1, 90) == 0.9
    assert Budget(steps=4).progress(1e9, 8) == 1.0


def test_checkpoint_survives_what_can_happen_to_a_file(tmp_path) -> None:
    path = tmp_path / CHECKPOINT
    state = {"field": {"a.b": torch.randn(3, 2)}, "fit": {"steps": torch.tensor(7)}}
    checkpoint.save(path, state)
    back = checkpoint.load(path)
    assert torch.equal(back["field"]["a.b"], state["field"]["a.b"]) and int(back["fit"]["steps"]) == 7
    assert [entry.name for entry in tmp_path.iterdir()] == [CHECKPOINT]
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(InputError, match="not a readable checkpoint"):
        checkpoint.load(path)
    with pytest.raises(InputError, match="does not exist"):
        checkpoint.load(tmp_path / "none.safetensors")


def test_batch_config_refuses_nonsense() -> None:
    with pytest.raises(ValueError, match="until"):
        BatchConfig(resolution=(0.5, 1.0))
    with pytest.raises(ValueError, match="at least 1"):
        BatchConfig(rays=0)


@pytest.mark.parametrize(
    ("step", "progress", "degree"), [(999, 0.01, 0), (1000, 0.01, 1), (2500, 0.01, 2), (10, 0.45, 2), (9999, 0.9, 3)]
)
def test_bands_come_by_steps_where_the_budget_is_long(step: int, progress: float, degree: int) -> None:
    """One band each 1000 steps or each fifth of the fit, whichever comes first; never more than there are."""
    field = torch.nn.Module()
    field.sh_degree, field.active_degree = 3, 0
    ctx = Context(Bounds(-torch.ones(3), torch.ones(3)), training=True, progress=progress)
    state = FitState(field, None, None, None, ctx, step)
    ShDegreeConfig(start=0.2, interval=0.2, steps=1000).build().before_step(state)
    assert field.active_degree == degree


def test_a_mask_of_pixels_is_no_transparency() -> None:
    """Batches of whole pictures have alpha 0 where a photograph is masked out."""
    picture, batch = _rendering(4, 5)
    mask = torch.rand(4, 5) > 0.3
    opaque = replace(batch, alpha=mask.float(), mask=mask)
    assert float(MaskLoss(2.0)(picture, Trace(), opaque, CTX)) == 0
    clear = replace(opaque, alpha=opaque.alpha * (torch.rand(4, 5) > 0.5))
    assert float(MaskLoss(2.0)(picture, Trace(), clear, CTX)) > 0
