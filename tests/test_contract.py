"""The contract suffices: what third-party packages would plug in, in at most 60 lines each and with no edit to the package."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import normalize, softplus

from invgraphics import kernels
from invgraphics.core import (
    Bounds,
    Camera,
    Context,
    Encoding,
    Field,
    FieldValues,
    Gaussians,
    Quantity,
    RayRenderer,
    Rays,
    Renderer,
    Rendering,
    Sampler,
    Samples,
    Trace,
    check,
)
from invgraphics.core.transforms import look_at, quaternion_to_matrix, se3_exp
from invgraphics.errors import NotComposableError
from invgraphics.fields.analytic import GaussianBlob, Sphere
from invgraphics.fields.neural import NeuralFieldConfig
from invgraphics.kernels.types import ALPHA_MIN, Footprints
from invgraphics.renderers.quadrature import integrate
from invgraphics.renderers.samplers import (
    StratifiedConfig,
    from_spacing,
    hit_indices,
    pack_intervals,
    quantiles,
    sample_pdf,
    stratified_edges,
)
from invgraphics.renderers.splatting import Splatting, SplattingConfig
from invgraphics.renderers.volumetric import Volumetric
from invgraphics.testing import toy_scene

PLUG_IN_LINES = 60
BOX = Bounds(torch.full((3,), -1.5), torch.full((3,), 1.5))


def eye_at(x: float, y: float, z: float, size: int = 16, focal: float = 20.0) -> Camera:
    pose = look_at(torch.tensor([x, y, z]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return Camera(pose, torch.full((2,), focal), torch.full((2,), size / 2), size, size)


def volumetric(count: int = 32) -> Volumetric:
    return Volumetric(StratifiedConfig(count).build(toy_scene(views=2, size=4)))


# (a) A proposal sampler (mip-NeRF 360): a density network of its own, taught by the final weights.


class ProposalSampler(Sampler):
    """Draws the final edges from a small network's weights; the network learns through `interlevel` only."""

    def __init__(self, coarse: int = 24, fine: int = 16) -> None:
        super().__init__()
        self.coarse, self.fine = coarse, fine
        self.net = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 32), nn.ReLU(), nn.Linear(32, 1))

    def sample(self, rays: Rays, field: Field, ctx: Context) -> tuple[Samples, tuple[Trace, ...]]:
        hit = hit_indices(rays)
        spacing = stratified_edges(rays[hit], self.coarse, ctx)
        coarse = pack_intervals(rays, hit, from_spacing(spacing, ctx.bounds))
        own = softplus(5 * self.net(2 * ctx.bounds.to_unit(coarse.position) - 1)[:, 0])
        weights, _, _ = kernels.composite(own * coarse.delta, own[:, None], coarse.ray, len(rays))
        drawn = quantiles(len(hit), self.fine + 1, ctx, like=spacing)
        edges = sample_pdf(spacing, weights.detach().view(len(hit), -1) + 1e-3, drawn)
        level = Trace(coarse, FieldValues(density=own), weights, rays=len(rays))
        return pack_intervals(rays, hit, from_spacing(edges, ctx.bounds)), (level,)


def interlevel(trace: Trace) -> Tensor:
    """A fine weight beyond the proposal weights that its interval touches is punished (mip-NeRF 360, equation 13)."""
    assert trace.samples is not None
    assert trace.weights is not None
    (level,) = trace.levels
    assert level.samples is not None
    assert level.weights is not None
    hit = len(torch.unique(trace.samples.ray))
    fine, coarse = trace.samples, level.samples
    f0, f1, w = (x.detach().view(hit, -1, 1) for x in (fine.t0, fine.t1, trace.weights))
    c0, c1, bound = (x.view(hit, 1, -1) for x in (coarse.t0, coarse.t1, level.weights))
    touched = (bound * ((c0 < f1) & (c1 > f0))).sum(dim=2)
    return ((w[..., 0] - touched).clamp_min(0).square() / (w[..., 0] + 1e-6)).mean()


def test_proposal_sampler() -> None:
    torch.manual_seed(0)
    blob, sampler = GaussianBlob(60.0, 0.02, (0.3, 0.0, 0.2)).requires_grad_(False), ProposalSampler()
    renderer = Volumetric(sampler)
    camera = eye_at(0.0, -4.0, 0.5)
    rays = camera.rays()[::3]
    optimiser = torch.optim.Adam(renderer.parameters(), lr=1e-2)
    assert {name.partition(".")[0] for name, _ in renderer.named_parameters()} == {"sampler"}

    def share_inside() -> float:
        _, trace = renderer.render_rays(blob, camera.rays(camera.project(blob.centre[None])[0]), Context(BOX))
        assert trace.samples is not None
        return float(((trace.samples.position - blob.centre).norm(dim=1) < 0.4).float().mean())

    before, losses = share_inside(), []
    for _ in range(100):
        _, trace = renderer.render_rays(blob, rays, Context(BOX, training=True))
        losses.append(interlevel(trace))
        optimiser.zero_grad()
        losses[-1].backward()
        optimiser.step()
    assert float(losses[-1].detach()) < 0.3 * float(losses[0].detach())
    assert share_inside() > 1.5 * before


# (b) An integrated encoding (mip-NeRF): the expectation of sines over the sample's cone frustum.


class Integrated(Encoding):
    """E[sin], E[cos] of 2^k pi x for x ~ N(unit, covariance): each octave fades as the cone outgrows it (equation 14)."""

    needs_covariance: ClassVar[bool] = True

    def __init__(self, octaves: int = 6) -> None:
        super().__init__()
        self.width = 6 * octaves
        self.register_buffer("scale", torch.pi * 2.0 ** torch.arange(octaves))

    def forward(self, unit: Tensor, covariance: Tensor | None = None) -> Tensor:
        assert covariance is not None
        phase = (unit[:, :, None] * self.scale).flatten(1)
        variance = (covariance.diagonal(dim1=1, dim2=2)[:, :, None] * self.scale**2).flatten(1)
        return torch.cat([phase.sin(), phase.cos()], dim=1) * torch.exp(-variance / 2).repeat(1, 2)


@dataclass(frozen=True)
class IntegratedConfig:
    octaves: int = 6

    def build(self) -> Integrated:
        return Integrated(self.octaves)


def test_integrated_encoding() -> None:
    torch.manual_seed(0)
    scene = toy_scene(views=2, size=8)
    config = NeuralFieldConfig(encoding=IntegratedConfig(), layers=2, width=32, skip=-1, colour_layers=1, colour_width=32)
    field = config.build(scene)
    # What reaches the encoding is the cone's mean and covariance in unit coordinates: check against points drawn from it.
    rays = scene.train[0].camera.resized(2, 2).rays()[:1]
    samples = Samples.on(rays, torch.zeros(1, dtype=torch.int64), torch.tensor([2.8]), torch.tensor([3.1]))
    caught: list[tuple[Tensor, Tensor]] = []
    field.encoding.register_forward_pre_hook(lambda _, arguments: caught.append(arguments))
    field.query(samples, Quantity.DENSITY)
    unit, covariance = caught[0]
    root = torch.linalg.cholesky(samples.covariance[0])
    points = scene.bounds.to_unit(samples.cone_mean + torch.randn(200_000, 3) @ root.T)
    sharp = field.encoding(points, torch.zeros(len(points), 3, 3)).mean(dim=0)
    torch.testing.assert_close(field.encoding(unit, covariance)[0], sharp, atol=1e-2, rtol=0)
    # And it learns: a few steps towards the toy scene's picture.
    optimiser, losses = torch.optim.Adam(field.parameters(), lr=5e-3), []
    for _ in range(40):
        rendering, _ = volumetric(24).render_image(field, scene.train[0].camera, Context(scene.bounds, training=True))
        losses.append((rendering.over(scene.background) - scene.train[0].over(scene.background)).square().mean())
        optimiser.zero_grad()
        losses[-1].backward()
        optimiser.step()
    assert float(losses[-1].detach()) < 0.3 * float(losses[0].detach())


# (c) An SDF renderer with a learnable sharpness (NeuS).


class NeuS(RayRenderer):
    """Opacity is the relative drop of a logistic function of the signed distance across an interval (NeuS, equation 13)."""

    requires: ClassVar[Quantity] = Quantity.SDF | Quantity.RADIANCE | Quantity.NORMAL

    def __init__(self, count: int = 48, sharpness: float = 15.0) -> None:
        super().__init__()
        self.sampler = StratifiedConfig(count).build(toy_scene(views=2, size=4))
        self.log_sharpness = nn.Parameter(torch.tensor(sharpness).log())

    def render_rays(self, field: Field, rays: Rays, ctx: Context) -> tuple[Rendering, Trace]:
        samples, _ = self.sampler.sample(ctx.bounds.clip(rays), field, ctx)
        values = field.query(samples, self.requires)
        assert values.sdf is not None
        assert values.normal is not None
        # The distance at the interval's ends, from its value and slope in the middle; rising distances are not surfaces.
        drop = -(values.normal * samples.direction).sum(dim=1).clamp_max(0) * samples.delta / 2
        sharpness = self.log_sharpness.exp()
        enter, leave = (torch.sigmoid(sharpness * (values.sdf + sign * drop)) for sign in (1, -1))
        alpha = ((enter - leave) / (enter + 1e-6)).clamp(0, 1 - 1e-6)
        return integrate(rays, samples, values, -torch.log1p(-alpha))


class PaintedBall(Field):
    """A ball whose radius can be learnt, painted with waves."""

    provides = Quantity.SDF | Quantity.RADIANCE | Quantity.NORMAL

    def __init__(self, radius: float) -> None:
        super().__init__()
        self.radius = nn.Parameter(torch.tensor(radius))

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        offset = samples.position * torch.tensor([1.0, 1.1, 0.9])
        paint = 0.5 + 0.5 * torch.sin(4 * samples.position + torch.tensor([0.0, 1.0, 2.0]))
        return FieldValues(sdf=offset.norm(dim=1) - self.radius, radiance=paint, normal=normalize(offset, dim=1))


def test_sdf_renderer_with_learnable_sharpness() -> None:
    camera, truth = eye_at(1.0, -3.0, 1.0), PaintedBall(0.8)
    with torch.no_grad():
        target, _ = NeuS(128, sharpness=200.0).render_image(truth, camera, Context(BOX))
    field, renderer = PaintedBall(0.5), NeuS()
    with pytest.raises(NotComposableError, match="sdf"):
        check(GaussianBlob(1.0, 1.0), renderer)
    check(Sphere(1.0, 1.0), renderer)
    optimiser = torch.optim.Adam([*field.parameters(), *renderer.parameters()], lr=3e-2)
    for _ in range(80):
        rendering, _ = renderer.render_image(field, camera, Context(BOX, training=True))
        loss = (rendering.rgb - target.rgb).square().mean() + (rendering.alpha - target.alpha).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert float(field.radius.detach()) == pytest.approx(0.8, abs=0.02)
    assert float(renderer.log_sharpness.detach().exp()) > 25
    # A closed surface is opaque, and its depth is where the ray meets it.
    ball, sharp = Sphere(1.0, 0.8), NeuS(256, sharpness=400.0)
    middle, _ = sharp.render_rays(ball, eye_at(0, -3, 0).rays(torch.tensor([[8.0, 8.0]])), Context(BOX))
    assert float(middle.alpha.detach()) > 0.999
    assert float(middle.depth.detach()) == pytest.approx(2.2, abs=0.01)


# (d) A field conditioned on a latent code, over two scenes.


class BlobFamily(nn.Module):
    """A hypernetwork: a code becomes the parameters of a coloured Gaussian blob."""

    def __init__(self, width: int = 4) -> None:
        super().__init__()
        self.codes = nn.Embedding(2, width)
        self.net = nn.Sequential(nn.Linear(width, 32), nn.Tanh(), nn.Linear(32, 7))

    def at(self, code: Tensor) -> Field:
        return Blob(self.net(code))


class Blob(Field):
    provides = Quantity.DENSITY | Quantity.RADIANCE

    def __init__(self, values: Tensor) -> None:
        super().__init__()
        self.centre, self.colour, self.size = values[:3], values[3:6].sigmoid(), 0.3 * values[6].exp()

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        squared = (samples.position - self.centre).square().sum(dim=1)
        return FieldValues(density=8 * torch.exp(-squared / (2 * self.size**2)), radiance=self.colour.expand(len(samples), 3))


def test_latent_conditioned_field() -> None:
    torch.manual_seed(0)
    truths = [
        GaussianBlob(8.0, 0.06, (0.4, 0.1, 0.2), (0.9, 0.2, 0.1)),
        GaussianBlob(8.0, 0.12, (-0.3, 0.0, -0.2), (0.1, 0.3, 0.9)),
    ]
    camera, renderer, family = eye_at(0.5, -3.5, 0.8, 12, 14.0), volumetric(), BlobFamily()
    with torch.no_grad():
        targets = [renderer.render_image(truth, camera, Context(BOX))[0].rgb for truth in truths]

    def loss(code: int, scene: int) -> Tensor:
        field = family.at(family.codes.weight[code])
        check(field, renderer)
        return (renderer.render_image(field, camera, Context(BOX))[0].rgb - targets[scene]).square().mean()

    before = [float(loss(i, i).detach()) for i in range(2)]
    optimiser = torch.optim.Adam(family.parameters(), lr=1e-2)
    for _ in range(120):
        optimiser.zero_grad()
        (loss(0, 0) + loss(1, 1)).backward()
        optimiser.step()
    assert family.codes.weight.grad is not None
    assert bool(family.codes.weight.grad.any(dim=1).all())
    after = [float(loss(i, i).detach()) for i in range(2)]
    assert all(late < 0.1 * early for early, late in zip(before, after, strict=True))
    assert float(loss(0, 1).detach()) > 10 * max(after)


# (e) A multi-plane image: coloured, half-transparent pictures at fixed depths in front of a camera.


@dataclass(frozen=True, eq=False)
class Planes:
    """RGBA pictures (d, 4, h, w), straight colour, on planes z = depth of a reference camera, near to far."""

    rgba: Tensor
    depths: Tensor
    camera: Camera


class PlaneField(Field):
    provides = Quantity.PLANES

    def __init__(self, rgba: Tensor, depths: Tensor, camera: Camera) -> None:
        super().__init__()
        self.rgba, self.depths, self.camera = nn.Parameter(rgba), depths, camera

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        raise NotComposableError("A plane field has nothing to say at points.")

    def primitives(self, want: Quantity, ctx: Context) -> Any:
        return (
            Planes(self.rgba.clamp(0, 1), self.depths, self.camera)
            if want == Quantity.PLANES
            else super().primitives(want, ctx)
        )


class PlaneRenderer(RayRenderer):
    """Intersects rays with the planes, looks the pictures up, and composites."""

    requires: ClassVar[Quantity] = Quantity.PLANES

    def render_rays(self, field: Field, rays: Rays, ctx: Context) -> tuple[Rendering, Trace]:
        planes: Planes = field.primitives(Quantity.PLANES, ctx)
        reference, (d, _, h, w) = planes.camera, planes.rgba.shape
        forward = reference.cam_to_world[:3, 2]
        height = ((rays.origins - reference.position) @ forward)[:, None]
        t = (planes.depths - height) / (rays.directions @ forward)[:, None]
        pixels, _ = reference.project(rays.at(t).reshape(-1, 3))
        at = (2 * pixels / torch.tensor([w, h]) - 1).view(len(rays), d, 2).transpose(0, 1)[:, :, None]
        looked_up = nn.functional.grid_sample(planes.rgba, at, align_corners=False)[..., 0].permute(2, 0, 1)
        rgb, alpha = looked_up[:, :, :3].reshape(-1, 3), looked_up[:, :, 3].reshape(-1).clamp_max(1 - 1e-6)
        ray = torch.arange(len(rays)).repeat_interleave(d)
        samples = Samples.on(rays, ray, t.reshape(-1), t.reshape(-1))
        return integrate(rays, samples, FieldValues(radiance=rgb), -torch.log1p(-alpha))


def test_plane_field() -> None:
    torch.manual_seed(0)
    camera, rgba = eye_at(0.0, -3.0, 0.0, 16, 16.0), torch.rand(3, 4, 16, 16)
    field, renderer = PlaneField(rgba, torch.tensor([2.0, 3.0, 4.0]), camera), PlaneRenderer()
    with pytest.raises(NotComposableError, match="density"):
        check(field, volumetric())
    check(field, renderer)
    # From the reference camera: plain "over" of the pictures, far to near.
    rendering, _ = renderer.render_image(field, camera, Context(BOX))
    expected = torch.zeros(3, 16, 16)
    for picture in rgba.flip(0):
        expected = picture[:3] * picture[3] + (1 - picture[3]) * expected
    torch.testing.assert_close(rendering.rgb.permute(2, 0, 1), expected, atol=1e-4, rtol=0)
    # A step to the right moves a plane by focal * step / depth to the left: one pixel at depth 2 for a step of 1/8.
    aside = camera.moved(camera.cam_to_world + nn.functional.pad(camera.cam_to_world[:3, :1] / 8, (3, 0, 0, 1)))
    only_first = PlaneField(rgba[:1], torch.tensor([2.0]), camera)
    here, there = (renderer.render_image(only_first, view, Context(BOX))[0] for view in (camera, aside))
    torch.testing.assert_close(there.rgb[:, :-1], here.rgb[:, 1:], atol=1e-4, rtol=0)
    # And it learns.
    learner = PlaneField(torch.full_like(rgba, 0.5), field.depths, camera)
    optimiser, losses = torch.optim.Adam(learner.parameters(), lr=5e-2), []
    for _ in range(60):
        pairs = [[renderer.render_image(f, view, Context(BOX))[0].rgb for f in (field, learner)] for view in (camera, aside)]
        losses.append(torch.stack([(truth.detach() - guess).square().mean() for truth, guess in pairs]).sum())
        optimiser.zero_grad()
        losses[-1].backward()
        optimiser.step()
    assert float(losses[-1].detach()) < 0.1 * float(losses[0].detach())


# (f) Disc splats (2DGS): the same Gaussians, flattened to their two longest axes, by homographies.


class DiscSplatting(Renderer):
    """Each disc's (u, v, 1) goes to the pixel by K W^T [s_u a, s_v b, centre - eye]; the rasteriser wants the inverse."""

    requires: ClassVar[Quantity] = Quantity.GAUSSIANS

    def render_image(self, field: Field, camera: Camera, ctx: Context) -> tuple[Rendering, Trace]:
        gaussians: Gaussians = field.primitives(Quantity.GAUSSIANS, ctx)
        scales, axis = gaussians.scales.sort(dim=1, descending=True)
        turned = quaternion_to_matrix(gaussians.quaternions)
        tangents = turned.gather(2, axis[:, None, :2].expand(-1, 3, 2)) * scales[:, None, :2]
        lens = torch.diag_embed(torch.cat([camera.focal, camera.focal.new_ones(1)]))
        lens = lens + nn.functional.pad(camera.principal_point[:, None], (2, 0, 0, 1))
        to_pixel = lens @ camera.cam_to_world[:3, :3].T
        plane = torch.cat([tangents, (gaussians.means - camera.position)[:, :, None]], dim=2)
        footprints, rgb = kernels.splat_project(gaussians, camera)
        discs = Footprints(**(vars(footprints) | {"homography": torch.linalg.inv(to_pixel @ plane)}))
        sums, alpha = kernels.splat_rasterise(discs, rgb, camera.width, camera.height)
        return Rendering(sums, alpha, torch.full_like(alpha, torch.inf)), Trace()


class Splats(Field):
    provides = Quantity.GAUSSIANS

    def __init__(self, count: int, dtype: torch.dtype = torch.float32, flat: bool = False) -> None:
        super().__init__()
        self.means = nn.Parameter(torch.randn(count, 3, dtype=dtype) * 0.4)
        self.quaternions = nn.Parameter(torch.randn(count, 4, dtype=dtype))
        self.scales = torch.rand(count, 3, dtype=dtype) * 0.15 + 0.15
        if flat:
            self.scales[:, 2] = 0.01
        self.sh = nn.Parameter(torch.randn(count, 1, 3, dtype=dtype))

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        raise NotComposableError("Splats have nothing to say at points.")

    def primitives(self, want: Quantity, ctx: Context) -> Gaussians:
        return Gaussians(self.means, self.quaternions, self.scales, torch.full_like(self.means[:, 0], 0.8), self.sh)


def test_disc_splat() -> None:
    torch.manual_seed(0)
    camera = eye_at(0.5, -3.0, 0.7, 12, 14.0).to(torch.float64)
    one, renderer = Splats(1, torch.float64, flat=True), DiscSplatting()
    check(one, renderer)
    rendering, _ = renderer.render_image(one, camera, Context(BOX))
    rays, axes = camera.rays(), quaternion_to_matrix(one.quaternions.detach())[0]
    t = ((one.means - rays.origins) @ axes[:, 2]) / (rays.directions @ axes[:, 2])
    local = (rays.at(t) - one.means) @ axes[:, :2] / one.scales[0, :2]
    response = 0.8 * torch.exp(-0.5 * local.square().sum(dim=1)).view(12, 12)
    clear = response > 0.05  # the square around it may cut fainter parts off
    torch.testing.assert_close(rendering.alpha[clear], response[clear], atol=1e-5, rtol=0)
    assert int(clear.sum()) > 5
    assert ALPHA_MIN < 0.05

    several, cotangent = Splats(4, torch.float64, flat=True), torch.randn(12, 12, 3, dtype=torch.float64)

    def shaded(means: Tensor, quaternions: Tensor, twist: Tensor) -> Tensor:
        posed = Splats(4, torch.float64, flat=True)
        del posed.means, posed.quaternions
        posed.means, posed.quaternions, posed.scales, posed.sh = means, quaternions, several.scales, several.sh
        moved = camera.moved(se3_exp(twist) @ camera.cam_to_world)
        return (renderer.render_image(posed, moved, Context(BOX))[0].rgb * cotangent).sum()

    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(shaded, (several.means, several.quaternions, twist), eps=1e-7, atol=1e-4, rtol=1e-4)


# (g) Pose refinement, through each renderer.


def refine(renderer: Renderer, field: Field, camera: Camera, steps: int = 60) -> tuple[float, float]:
    """Pose error (of the twist, radians and local units together) before and after fitting the pose to one picture."""
    with torch.no_grad():
        target, _ = renderer.render_image(field, camera, Context(BOX))
    wrong = torch.tensor([0.03, -0.04, 0.03, 0.05, -0.06, 0.04])
    twist = nn.Parameter(torch.zeros(6))
    optimiser = torch.optim.Adam([twist], lr=8e-3)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.97)

    def pose() -> Tensor:
        return se3_exp(twist) @ se3_exp(wrong) @ camera.cam_to_world

    def error() -> float:
        return float((pose() @ torch.linalg.inv(camera.cam_to_world) - torch.eye(4)).detach().norm())

    before = error()
    for _ in range(steps):
        rendering, _ = renderer.render_image(field, camera.moved(pose()), Context(BOX))
        loss = (rendering.rgb - target.rgb).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return before, error()


class ManyBlobs(Field):
    """Soft coloured blobs, which a pose can be read from."""

    provides = Quantity.DENSITY | Quantity.RADIANCE

    def __init__(self, count: int = 6) -> None:
        super().__init__()
        self.centres, self.colours = torch.randn(count, 3) * 0.5, torch.rand(count, 3)

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        share = torch.exp(-(samples.position[:, None] - self.centres).square().sum(dim=2) / 0.08) + 1e-9
        return FieldValues(density=6 * share.sum(dim=1), radiance=share @ self.colours / share.sum(dim=1, keepdim=True))


CELLS: dict[str, tuple[Callable[[], Renderer], Callable[[], Field]]] = {
    "volumetric": (lambda: volumetric(48), ManyBlobs),
    "neus": (lambda: NeuS(48, 30.0), lambda: PaintedBall(0.8)),
    "splatting": (lambda: Splatting(SplattingConfig()), lambda: Splats(12)),
}


@pytest.mark.parametrize("cell", CELLS)
def test_pose_refinement(cell: str) -> None:
    torch.manual_seed(1)
    make_renderer, make_field = CELLS[cell]
    before, after = refine(make_renderer(), make_field(), eye_at(0.5, -3.0, 0.7))
    assert before > 0.05
    assert after < 0.35 * before


@pytest.mark.parametrize(
    "parts",
    [
        (ProposalSampler, interlevel),
        (Integrated, IntegratedConfig),
        (NeuS,),
        (BlobFamily, Blob),
        (Planes, PlaneField, PlaneRenderer),
        (DiscSplatting,),
        (refine,),
    ],
    ids=lambda parts: parts[0].__name__,
)
def test_plug_ins_are_short(parts: tuple[Any, ...]) -> None:
    assert sum(len(inspect.getsource(part).splitlines()) for part in parts) <= PLUG_IN_LINES
