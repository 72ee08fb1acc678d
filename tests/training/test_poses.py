"""Poses that are fitted too: the exponential map, gradients through every family of renderers, windows, recovery, resuming."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from invgraphics import kernels
from invgraphics.core import Bounds, Context, Field, FieldValues, Model, Quantity, RayRenderer, Samples, Scene, View
from invgraphics.core.colour import quantise
from invgraphics.core.ngp import HashGrid
from invgraphics.core.transforms import se3_exp
from invgraphics.experiments.build import build_model, build_plan
from invgraphics.fields.encodings.frequency import FrequencyConfig
from invgraphics.fields.encodings.hash import HashConfig
from invgraphics.kernels import reference
from invgraphics.metrics.poses import pose_errors
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT
from invgraphics.scenes.degrade import TrainingData, degrade
from invgraphics.testing import toy_cameras
from invgraphics.training.batches import BatchConfig
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit, Plan
from invgraphics.training.hooks import FitState, Hook
from invgraphics.training.localise import PoseDescent, refine_pose
from invgraphics.training.losses import PhotometricLoss
from invgraphics.training.optimiser import OptimiserConfig
from invgraphics.training.poses import Poses, PosesConfig, coarse_to_fine_encodings, motion_about
from invgraphics.training.prune import trace_random_rays

CPU = torch.device("cpu")
ON = "training.poses.optimise=true"
METHODS = ["volumetric/nerf", "volumetric/hash", "splatting/gaussians"]


def same(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(
        a[part].keys() == b[part].keys() and all(torch.equal(a[part][name], b[part][name]) for name in a[part]) for part in a
    )


class Blobs(Field):
    """Soft coloured blobs, which a pose can be read from; nothing to learn."""

    provides = Quantity.DENSITY | Quantity.RADIANCE

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(3)
        self.centres, self.colours = (
            torch.randn(7, 3, generator=generator) * 0.45,
            torch.rand(7, 3, generator=generator),
        )

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        share = torch.exp(-(samples.position[:, None] - self.centres).square().sum(dim=2) / 0.08) + 1e-9
        return FieldValues(density=6 * share.sum(dim=1), radiance=share @ self.colours / share.sum(dim=1, keepdim=True))


@pytest.fixture(scope="module")
def blobs() -> Scene:
    """Six photographs of the blobs, and one to test."""
    bounds = Bounds(-torch.ones(3), torch.ones(3))
    scene = Scene("blobs", (), (), torch.zeros(3), bounds)
    renderer, field = VolumetricConfig(StratifiedConfig(48)).build(scene), Blobs()
    views = []
    for index, camera in enumerate(toy_cameras(7, 20)):
        picture, _ = renderer.render_image(field, camera, Context(bounds))
        views.append(View(camera, quantise(picture.over(torch.zeros(3))), f"view{index}"))
    return scene.with_views(train=tuple(views[:6]), test=tuple(views[6:]))


def test_exponential_map_is_that_of_the_matrix() -> None:
    generator = torch.Generator().manual_seed(0)
    twists = torch.randn(40, 6, generator=generator, dtype=torch.float64)
    lengths = torch.tensor([0.0, 1e-9, 1e-4, 0.0999, 0.1001, 1.0, 3.1, 7.0], dtype=torch.float64).repeat(5)
    twists[:, :3] *= (lengths / twists[:, :3].norm(dim=1))[:, None]
    x, y, z = twists[:, :3].unbind(dim=1)
    generators = torch.zeros(40, 4, 4, dtype=torch.float64)
    generators[:, 2, 1], generators[:, 0, 2], generators[:, 1, 0] = x, y, z
    generators[:, 1, 2], generators[:, 2, 0], generators[:, 0, 1] = -x, -y, -z
    generators[:, :3, 3] = twists[:, 3:]
    torch.testing.assert_close(se3_exp(twists), torch.linalg.matrix_exp(generators), atol=1e-13, rtol=1e-12)
    torch.testing.assert_close(se3_exp(twists[0]), se3_exp(twists)[0])
    for place in (0, 2, 4, 5):
        assert torch.autograd.gradcheck(se3_exp, twists[place].clone().requires_grad_())


def test_zero_residuals_are_the_given_poses_and_rows_do_not_mix(blobs: Scene) -> None:
    poses = Poses.of(PosesConfig(), blobs)
    for index, view in enumerate(blobs.train):
        torch.testing.assert_close(poses.camera(index).cam_to_world, view.camera.cam_to_world, atol=1e-6, rtol=0)
    poses.camera(2).position.sum().backward()
    assert [shift.grad is not None for shift in poses.translation] == [False, False, True, False, False, False]


RENDERERS = {
    "hash": ("volumetric/hash", ["renderer.sampler.type=stratified", "renderer.sampler.count=24"]),
    "frequency": ("volumetric/nerf", ["renderer.sampler.type=stratified", "renderer.sampler.count=24"]),
    "splatting": ("splatting/gaussians", []),
    "exact": ("gaussian-volume/exact", ["field.count=60", "field.max_init=60"]),
    "sorted": ("gaussian-volume/sorted", ["field.count=60", "field.max_init=60"]),
}


def liven(field: Field) -> None:
    """Make an unfitted field show something everywhere."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, parameter in field.named_parameters():
            if name.endswith(("table", "sh_dc")):
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.5)
            if name.endswith("log_scales"):
                parameter.clamp_(min=-2.0)


@pytest.mark.parametrize("family", RENDERERS)
def test_gradients_of_a_pose(family: str, scene: Scene, small: Callable) -> None:
    """Through the field's positions and directions, against finite differences in float64."""
    name, settings = RENDERERS[family]
    model = build_model(small(name, *settings), scene, 0, CPU)
    liven(model.field)
    field, renderer = model.field.double(), model.renderer.double()
    camera = scene.train[0].camera.resized(8, 8).to(torch.float64)
    ctx = Context(scene.bounds.to(torch.float64))
    cotangent = torch.rand(8, 8, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))

    def shown(twist: Tensor) -> Tensor:
        picture, _ = renderer.render_image(field, camera.moved(camera.cam_to_world @ se3_exp(twist)), ctx)
        return (picture.rgb * cotangent).sum()

    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(shown(twist), twist)
    step, numeric = 1e-8, []  # less than the distance to any edge of a cell
    with torch.no_grad():
        for axis in torch.eye(6, dtype=torch.float64):
            numeric.append((shown(step * axis) - shown(-step * axis)) / (2 * step))
    assert float(gradient.abs().max()) > 1e-3
    torch.testing.assert_close(gradient, torch.stack(numeric), atol=2e-4 * float(gradient.abs().max()), rtol=2e-3)


@pytest.mark.parametrize("stop", ["always", "evaluation"])
def test_marching_keeps_the_gradients_of_positions(stop: str, scene: Scene, small: Callable) -> None:
    """The same samples with and without early termination pull at the pose alike, from the compiled kernels."""
    gradients = []
    for how in (stop, "never"):
        settings = [f"renderer.sampler.stop={how}", "renderer.sampler.transmittance=0.0"]
        model = build_model(small("volumetric/hash", *settings), scene, 0, CPU)
        liven(model.field)
        twist = torch.zeros(6, requires_grad=True)
        camera = scene.train[0].camera
        moved = camera.moved(camera.cam_to_world @ se3_exp(twist))
        picture, _ = model.renderer.render_image(model.field, moved, model.context())
        gradients.append(torch.autograd.grad(picture.rgb.square().sum(), twist)[0])
    assert float(gradients[0].abs().min()) > 0
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-4, atol=1e-4 * float(gradients[1].abs().max()))


def test_a_loss_on_slopes_reaches_the_table_through_the_compiled_kernel() -> None:
    grid = HashGrid(levels=4, features=3, log2_size=8, base=2, finest=40)
    generator = torch.Generator().manual_seed(0)
    points, table = torch.rand(60, 3, generator=generator) * 1.2 - 0.1, torch.randn(grid.entries, 3, generator=generator)
    cotangent, weight = torch.randn(60, 12, generator=generator), torch.randn(60, 3, generator=generator)
    results = []
    for encode, dtype in ((kernels.hash_encode, torch.float32), (reference.hash_encode, torch.float64)):
        unit, entries, given = (x.to(dtype).clone().requires_grad_() for x in (points, table, cotangent))
        features, _ = encode(unit, entries, grid)
        (slope,) = torch.autograd.grad(features, unit, given, create_graph=True)
        results.append([slope, *torch.autograd.grad((slope * weight.to(dtype)).sum(), [entries, given])])
    for ours, true in zip(*([part.detach() for part in parts] for parts in results), strict=True):
        assert float((ours - true).abs().max()) <= 1e-4 * float(true.abs().max())


def test_motions_turn_about_their_pivot() -> None:
    twist = torch.randn(4, 6, dtype=torch.float64)
    depth = torch.rand(4, dtype=torch.float64) + 1
    motion = motion_about(twist, depth)
    pivot = torch.tensor([[0.0, 0.0, 0.0, 1.0]]).double().repeat(4, 1)
    pivot[:, 2] = depth
    origin = torch.tensor([0.0, 0.0, 0.0, 1.0]).double()
    moved = (motion @ pivot[:, :, None])[:, :, 0]
    torch.testing.assert_close(moved - pivot, se3_exp(twist) @ origin - origin)
    torch.testing.assert_close(motion[:, :, :3], se3_exp(twist)[:, :, :3])


def test_window_opens_from_coarse_to_fine() -> None:
    config = PosesConfig(window=(0.2, 0.6))
    assert [config.alpha(progress) for progress in (0.0, 0.2, 0.6, 1.0)] == [0.0, 0.0, 1.0, 1.0]
    assert config.alpha(0.4) == pytest.approx(0.5)
    points = torch.rand(5, 3)
    for settings in (FrequencyConfig(octaves=4), HashConfig(levels=5, log2_size=8, finest=64)):
        encoding = settings.build()
        assert not any("window_alpha" in key for key in encoding.state_dict())
        plain = encoding(points)
        encoding.add_window()
        assert torch.equal(encoding(points), plain)
        assert encoding.window_alpha is not None
        encoding.window_alpha.fill_(0.4)
        reached = encoding.always + 0.4 * (encoding.levels - encoding.always)
        expected = [(1 - math.cos(math.pi * min(max(reached - k, 0), 1))) / 2 for k in range(encoding.levels)]
        weights = encoding.level_weights()
        assert weights is not None
        assert weights.tolist() == pytest.approx(expected, abs=1e-6)
        older = {name.replace("window_alpha", "detail"): value.clone() for name, value in encoding.state_dict().items()}
        assert "detail" in older
        encoding.window_alpha.fill_(0.0)
        assert int((encoding(points) - plain).abs().gt(0).any(dim=0).sum()) > 0
        encoding.load_state_dict(older)  # of a checkpoint of an earlier version
        assert float(encoding.window_alpha) == pytest.approx(0.4)


@pytest.mark.parametrize("name", METHODS)
def test_without_poses_nothing_is_different(name: str, scene: Scene, small: Callable) -> None:
    plain = small(name)
    assert "training" not in plain.table
    fits = []
    for method in (plain, small(name, "training.poses.optimise=false")):
        fit = Fit(build_plan(method, scene, Budget(steps=6), 0, CPU))
        fit.run(lambda loss: False)
        assert "poses" not in fit.state()
        fits.append(fit.state())
    assert same(*fits)


@pytest.mark.parametrize("name", METHODS)
def test_resumed_with_poses_equals_uninterrupted(name: str, scene: Scene, small: Callable, tmp_path) -> None:
    shown = degrade(scene, TrainingData(pose_noise=2.0), 0)

    def fresh() -> Fit:
        return Fit(build_plan(small(name, ON), shown, Budget(steps=24), 0, CPU))

    whole, first, second = fresh(), fresh(), fresh()
    whole.run(lambda loss: False)
    first.run(lambda loss: first.steps == 11)
    checkpoint.save(tmp_path / CHECKPOINT, first.state())
    torch.manual_seed(99)
    second.load(checkpoint.load(tmp_path / CHECKPOINT), seconds=1.0)
    second.run(lambda loss: False)
    assert same(whole.state(), second.state())
    assert whole.plan.poses is not None
    assert all(bool(turn.any()) for turn in whole.plan.poses.rotation)
    opened = [encoding.window_alpha for encoding in coarse_to_fine_encodings(whole.plan.model)]
    assert all(alpha is not None and float(alpha) == 1.0 for alpha in opened)
    assert bool(opened) == name.startswith("volumetric")


def test_poses_come_back(blobs: Scene) -> None:
    """Known field, 4 degrees and 4 per cent of error."""
    shown = degrade(blobs, TrainingData(pose_noise=4.0), 1)
    config = PosesConfig(rotation_lr=3e-2, translation_lr=1e-2, window=(0.0, 0.0), rotation_warmup=0.0, translation_warmup=0.0)
    poses = Poses.of(config, shown)
    plan = Plan(
        model=Model(Blobs(), VolumetricConfig(StratifiedConfig(32)).build(shown), shown.bounds),
        scene=shown,
        losses=[PhotometricLoss()],
        hooks=[],
        optimiser=config.optimiser(OptimiserConfig(), view_share=1.0),
        batches=BatchConfig(rays=1200, views=6),
        budget=Budget(steps=250),
        poses=poses,
    )
    before = pose_errors(poses().detach(), poses.reference, blobs.extent)
    Fit(plan).run(lambda loss: False)
    after = pose_errors(poses().detach(), poses.reference, blobs.extent)
    assert float(before.rotation_degrees.median()) > 2
    assert float(after.rotation_degrees.median()) < 0.25 * float(before.rotation_degrees.median())
    assert float(after.translation_per_cent.median()) < 0.4 * float(before.translation_per_cent.median())


def test_a_photograph_is_composited_once_for_all_steps(blobs: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    over, made = View.over, []
    monkeypatch.setattr(View, "over", lambda view, *rest: made.append(view) or over(view, *rest))
    model = Model(Blobs(), VolumetricConfig(StratifiedConfig(8)).build(blobs), blobs.bounds)
    refine_pose(model, blobs.test[0], blobs, PoseDescent(steps=5, rays=20))
    assert len(made) == 1


def test_a_photograph_finds_its_pose(blobs: Scene) -> None:
    view = blobs.test[0]
    wrong = view.camera.moved(view.camera.cam_to_world @ se3_exp(torch.tensor([0.08, -0.06, 0.1, 0.1, -0.1, 0.15])))
    model = Model(Blobs(), VolumetricConfig(StratifiedConfig(32)).build(blobs), blobs.bounds)
    misplaced = View(wrong, view.image, view.name)
    found = refine_pose(model, misplaced, blobs, PoseDescent(steps=150, lr=2e-2, final=5e-4, rays=300))
    error = (found.cam_to_world - view.camera.cam_to_world).norm()
    assert float(error) < 0.15 * float((wrong.cam_to_world - view.camera.cam_to_world).norm())


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"window": (0.5, 0.1)}, "window"),
        ({"rotation_lr": 0.0}, "learning rates"),
        ({"test_steps": -1}, "test_steps"),
        ({"resolution": (0.5, 2.0)}, "resolution"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        PosesConfig(**settings)


class RaysOfHooks(Hook):
    """Notes where the rays begin that hooks trace."""

    def after_step(self, state: FitState) -> None:
        assert isinstance(state.renderer, RayRenderer)
        traced = [trace.samples for trace in trace_random_rays(state, state.renderer, 60)]
        middle = [
            (each.position - 0.5 * (each.t0 + each.t1)[:, None] * each.direction)[0] for each in traced if each is not None
        ]
        self.hooks = torch.stack(middle)


def test_rays_of_hooks_begin_where_the_fitted_cameras_are(blobs: Scene) -> None:
    poses = Poses.of(PosesConfig(), blobs)
    with torch.no_grad():
        poses.translation[0].copy_(torch.tensor([0.0, 0.0, -0.3]))
    hook = RaysOfHooks()
    plan = Plan(
        model=Model(Blobs(), VolumetricConfig(StratifiedConfig(4)).build(blobs), blobs.bounds),
        scene=blobs,
        losses=[PhotometricLoss()],
        hooks=[hook],
        optimiser=PosesConfig(rotation_lr=1e-9, translation_lr=1e-9).optimiser(OptimiserConfig(), view_share=1.0),
        batches=BatchConfig(rays=64, views=6),
        budget=Budget(steps=1),
        poses=poses,
    )
    Fit(plan).run(lambda loss: False)
    given = torch.stack([view.camera.position for view in blobs.train])
    moved = (hook.hooks - given).norm(dim=1)
    torch.testing.assert_close(moved, torch.tensor([0.3] + [0.0] * (len(given) - 1)), atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("scales", "until"), [((0.5, 1.0), (0.5,)), ((0.25, 0.5, 1.0), (0.1, 0.5)), ((0.1, 0.2, 0.5, 1.0), (0.1, 0.3, 0.5))]
)
def test_image_scales_end_with_the_window(scales: tuple[float, ...], until: tuple[float, ...]) -> None:
    config = PosesConfig(resolution=scales, window=(0.1, 0.5)).batches(BatchConfig())
    assert config.resolution == scales and config.until == pytest.approx(until)


def test_hooks_trace_no_rays_through_masked_pixels(blobs: Scene) -> None:
    """Nothing is fitted to what they would see."""
    size = blobs.train[0].camera.width
    left = torch.zeros(blobs.train[0].camera.height, size, dtype=torch.bool)
    left[:, : size // 4] = True
    masked = blobs.with_views(train=tuple(replace(view, mask=left) for view in blobs.train))
    renderer = VolumetricConfig(StratifiedConfig(4)).build(masked)
    ctx = Context(masked.bounds, training=True, generator=torch.Generator().manual_seed(0))
    state = FitState(Blobs(), renderer, None, masked, ctx, 0)  # type: ignore[arg-type]
    for trace, view in zip(trace_random_rays(state, renderer, 60), masked.train, strict=True):
        assert trace.samples is not None
        pixels, z = view.camera.project(trace.samples.position)
        assert bool((pixels[z > 0.1, 0] < size // 4).all()) and bool((pixels[z > 0.1, 0] >= 0).all())
