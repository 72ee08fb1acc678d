"""Volume rendering against closed forms, finite differences and a change of frame."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from invgraphics.core import Bounds, Camera, Context, Field, FieldValues, Quantity, Rays, Samples, Scene, harmonics
from invgraphics.core.transforms import se3_exp
from invgraphics.fields.analytic import GaussianBlob, Slab, Sphere
from invgraphics.renderers.occupancy import OccupancyConfig
from invgraphics.renderers.proposals import ProposalsConfig
from invgraphics.renderers.samplers import HierarchicalConfig, StratifiedConfig
from invgraphics.renderers.volumetric import Volumetric, VolumetricConfig, query

F64 = torch.float64
SAMPLERS = [StratifiedConfig(256), HierarchicalConfig(128, 128), OccupancyConfig(resolution=8, steps_per_diagonal=512)]


def box(space: str = "box") -> Bounds:
    return Bounds(torch.full((3,), -1.5, dtype=F64), torch.full((3,), 1.5, dtype=F64), space)


def renderer(sampler: object, scene: Scene) -> Volumetric:
    return VolumetricConfig(sampler).build(scene)


@pytest.mark.parametrize("sampler", SAMPLERS, ids=lambda config: type(config).__name__)
@pytest.mark.parametrize("sigma", [0.3, 2.0])
def test_slab_has_alpha_one_minus_exp(
    make_scene: Callable[..., Scene], make_camera: Callable[..., Camera], sampler: object, sigma: float
) -> None:
    """The whole box is filled, so intervals cut at its faces make the sum exact, but for rays that stop early."""
    field, rays = Slab(sigma, -9, 9, colour=(0.2, 0.5, 0.8)).double(), make_camera().rays()
    rendering, _ = renderer(sampler, make_scene()).render_rays(field, rays, Context(box()))
    expected = 1 - torch.exp(-field.optical_depth(box().clip(rays)).detach())
    assert float(expected.max()) > 0.5
    torch.testing.assert_close(rendering.alpha, expected, atol=1e-7 if sigma < 1 else 1e-3, rtol=0)
    torch.testing.assert_close(rendering.rgb, rendering.alpha[:, None] * field.colour)


@pytest.mark.parametrize("sampler", SAMPLERS, ids=lambda config: type(config).__name__)
@pytest.mark.parametrize("space", ["box", "contracted"])
def test_blob_equals_its_line_integral(
    make_scene: Callable[..., Scene], make_camera: Callable[..., Camera], sampler: object, space: str
) -> None:
    shape = torch.tensor([[0.10, 0.03, 0.0], [0.03, 0.06, 0.01], [0.0, 0.01, 0.04]])
    blob, rays = GaussianBlob(4.0, shape, (0.1, 0.0, -0.1)).double(), make_camera().rays()
    rendering, _ = renderer(sampler, make_scene(space)).render_rays(blob, rays, Context(box(space)))
    expected = 1 - torch.exp(-blob.optical_depth(rays.within(rays.near, torch.full_like(rays.far, 20.0))).detach())
    assert float(expected.max()) > 0.8
    torch.testing.assert_close(rendering.alpha, expected, atol=2e-3, rtol=0)


def test_depth_and_normal_of_an_opaque_ball(make_scene: Callable[..., Scene], make_camera: Callable[..., Camera]) -> None:
    ball, rays = Sphere(2000.0, 0.8).double(), make_camera().rays()
    ctx = replace(Context(box()), geometry=True)
    rendering, _ = renderer(StratifiedConfig(2000), make_scene()).render_rays(ball, rays, ctx)
    middle = -(rays.origins * rays.directions).sum(dim=1)
    gap = 0.8**2 - (rays.origins.square().sum(dim=1) - middle**2)
    hit, clear = gap > 0.02, gap < 0
    assert int(hit.sum()) > 10
    torch.testing.assert_close(rendering.depth[hit], (middle - gap.clamp_min(0).sqrt())[hit], atol=3e-3, rtol=0)
    points = rays.origins + rendering.depth[:, None] * rays.directions
    assert rendering.normal is not None
    torch.testing.assert_close(rendering.normal[hit], points[hit] / 0.8, atol=2e-2, rtol=0)
    torch.testing.assert_close(rendering.normal[hit].norm(dim=1), torch.ones(int(hit.sum()), dtype=F64))
    assert bool((rendering.depth[clear] == torch.inf).all())
    assert not rendering.normal[clear].any()


def test_depth_of_a_fog(make_scene: Callable[..., Scene], make_camera: Callable[..., Camera]) -> None:
    """Constant density over [near, far]: the mean distance of absorption, 1/sigma - L / (exp(sigma L) - 1) behind near."""
    fog, rays, ctx = Sphere(0.25, 99.0).double(), make_camera().rays(), replace(Context(box()), geometry=True)
    rendering, _ = renderer(StratifiedConfig(512), make_scene()).render_rays(fog, rays, ctx)
    clipped = box().clip(rays)
    length = clipped.far - clipped.near
    expected = clipped.near + 1 / 0.25 - length / torch.expm1(0.25 * length)
    seen = rendering.alpha >= 0.5
    assert int(seen.sum()) > 20
    assert int((~seen & (rendering.alpha > 0)).sum()) > 5
    torch.testing.assert_close(rendering.depth[seen], expected[seen], atol=1e-4, rtol=0)
    assert bool((rendering.depth[~seen] == torch.inf).all())
    assert rendering.normal is not None
    assert not rendering.normal[~seen].any()


def test_normals_face_the_camera(make_scene: Callable[..., Scene], make_camera: Callable[..., Camera]) -> None:
    """Inside a ball whose middle lies behind the eye, outward normals point away from the eye and must be turned."""
    ball, rays = Sphere(20.0, 9.0, (0.0, -6.0, 0.0)).double(), make_camera().rays()
    ctx = replace(Context(box()), geometry=True)
    rendering, _ = renderer(StratifiedConfig(32), make_scene()).render_rays(ball, rays, ctx)
    assert rendering.normal is not None
    seen = rendering.alpha >= 0.5
    assert int(seen.sum()) > 50
    assert bool(((rendering.normal * rays.directions).sum(dim=1)[seen] < -0.5).all())


def test_no_normal_unless_wanted_and_offered(make_scene: Callable[..., Scene], make_camera: Callable[..., Camera]) -> None:
    make, rays = renderer(StratifiedConfig(8), make_scene()), make_camera().rays()
    assert make.render_rays(Sphere(1.0, 1.0).double(), rays, Context(box()))[0].normal is None
    assert make.render_rays(Slab(1.0, 0, 1).double(), rays, Context(box(), geometry=True))[0].normal is None


def test_gradients_to_field_and_pose(make_scene: Callable[..., Scene], make_camera: Callable[..., Camera]) -> None:
    """Finite differences of a whole image through the box clipping, the sampler, the field and the compositing."""
    blob, view = GaussianBlob(3.0, 0.1, (0.1, 0.0, -0.1), (0.3, 0.6, 0.9)).double(), make_camera(5, 4, 6.0)
    volumetric, cotangent = renderer(StratifiedConfig(24), make_scene()), torch.randn(4, 5, 5, dtype=F64)
    names = [name for name, _ in blob.named_parameters()]

    def render(twist: torch.Tensor, *parameters: torch.Tensor) -> torch.Tensor:
        class Substituted(Field):
            provides = blob.provides

            def query(self, samples: Samples, want: Quantity) -> FieldValues:
                return torch.func.functional_call(blob, dict(zip(names, parameters, strict=True)), (samples, want))

        moved = view.moved(se3_exp(twist) @ view.cam_to_world)
        rendering, _ = volumetric.render_image(Substituted(), moved, Context(box()))
        depth = torch.where(rendering.alpha >= 0.5, rendering.depth, 0.0)
        image = torch.cat([rendering.rgb, rendering.alpha[..., None], depth[..., None]], dim=2)
        return (image * cotangent).sum()

    blob.forward = blob.query  # type: ignore[method-assign]  # functional_call calls forward
    leaves = [parameter.detach().clone().requires_grad_() for parameter in blob.parameters()]
    assert torch.autograd.gradcheck(render, (torch.zeros(6, dtype=F64, requires_grad=True), *leaves), atol=1e-6)


@pytest.mark.parametrize("sampler", SAMPLERS, ids=lambda config: type(config).__name__)
def test_turning_world_and_cameras_together_changes_nothing(
    make_scene: Callable[..., Scene], make_camera: Callable[..., Camera], sampler: object
) -> None:
    """Contracted bounds, whose sampling does not depend on the orientation; colour is directional (SH of degree 2)."""
    covariance, centre = torch.diag(torch.tensor([0.05, 0.1, 0.2])).double(), torch.tensor([0.2, 0.1, 0.0]).double()
    sh = torch.randn(9, 3).double() * 0.4
    motion, view = se3_exp(torch.tensor([0.7, -1.1, 0.4, 0.0, 0.0, 0.0]).double()), make_camera()
    turn = motion[:3, :3]
    blob = GaussianBlob(6.0, covariance, centre, sh).double()
    moved = GaussianBlob(6.0, turn @ covariance @ turn.T, turn @ centre, harmonics.rotate(sh[None], turn)[0]).double()
    volumetric, ctx = renderer(sampler, make_scene("contracted")), Context(box("contracted"))
    before, _ = volumetric.render_image(blob, view, ctx)
    after, _ = volumetric.render_image(moved, view.moved(motion @ view.cam_to_world), ctx)
    unturned, _ = volumetric.render_image(blob, view.moved(motion @ view.cam_to_world), ctx)
    torch.testing.assert_close(after.rgb, before.rgb, atol=1e-5, rtol=0)
    torch.testing.assert_close(after.depth, before.depth, atol=1e-4, rtol=0)
    assert float((unturned.rgb - before.rgb).detach().abs().max()) > 0.05


def test_rays_that_miss_see_nothing(make_scene: Callable[..., Scene]) -> None:
    away = Rays.make(torch.full((3, 3), 9.0), torch.nn.functional.normalize(torch.ones(3, 3), dim=1))
    for sampler in SAMPLERS:
        rendering, trace = renderer(sampler, make_scene()).render_rays(Sphere(9.0, 1.0), away, Context(make_scene().bounds))
        assert not rendering.rgb.any()
        assert not rendering.alpha.any()
        assert bool((rendering.depth == torch.inf).all())
        assert trace.samples is not None
        assert len(trace.samples) == 0


def test_chunks_do_not_show(make_scene: Callable[..., Scene], make_camera: Callable[..., Camera]) -> None:
    ball, scene, view = Sphere(4.0, 0.8), make_scene(), make_camera().to(torch.float32)
    make = renderer(StratifiedConfig(32), scene)
    whole, _ = make.render_image(ball, view, Context(scene.bounds, geometry=True))
    parts, _ = make.render_image(ball, view, Context(scene.bounds, geometry=True, chunk=100))
    torch.testing.assert_close(parts.rgb, whole.rgb)
    assert parts.normal is not None
    assert whole.normal is not None
    torch.testing.assert_close(parts.normal, whole.normal)
    values = query(ball, Samples.at(torch.randn(50, 3)), Quantity.SDF | Quantity.DENSITY, chunk=7)
    assert values.sdf is not None
    assert values.sdf.shape == (50,)
    assert values.radiance is None


def test_updates_reach_the_sampler(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene()
    make = renderer(OccupancyConfig(resolution=8), scene)
    make.update(Sphere(50.0, 0.3), Context(scene.bounds, training=True))
    assert not make.sampler.occupied.all()  # type: ignore[union-attr]
    assert {"sampler.ema", "sampler.occupied", "sampler.step"} == set(make.state_dict())


@pytest.mark.parametrize(("space", "reach", "scale"), [("contracted", 1.0, 0.5**2), ("box", 2.0, (0.5 / 3.0) ** 2)])
def test_near_samples_of_a_trained_level_pull_less_too(
    make_scene: Callable[..., Scene], space: str, reach: float, scale: float
) -> None:
    """Mip-NeRF's coarse level, which has a loss of its own: else it would fit what the other one keeps off."""
    rays = Rays.make(torch.zeros(1, 3, dtype=F64), torch.tensor([[0.0, 0.0, 1.0]], dtype=F64))
    pulls = []
    for used in (0.0, reach):
        field = Slab(20.0, 0.495, 0.505, colour=(0.2, 0.5, 0.8)).double()
        field.colour = torch.nn.Parameter(field.colour.detach().clone())
        sampler = ProposalsConfig(counts=(4000,), count=4, train_levels=True)
        model = VolumetricConfig(sampler, gradient_reach=used).build(make_scene(space))
        _, trace = model.render_rays(field, rays, Context(box(space), training=True))
        (level,) = trace.levels
        assert level.values is not None and level.weights is not None and level.values.radiance is not None
        shown = (level.weights[:, None] * level.values.radiance).sum()
        pulls.append(torch.autograd.grad(shown, field.colour)[0])
    torch.testing.assert_close(pulls[1] / pulls[0], torch.full((3,), scale, dtype=F64), rtol=0.1, atol=0)


@pytest.mark.parametrize(
    ("space", "starts", "reach", "scales"),
    [
        ("contracted", (0.0,), 1.0, (0.5**2,)),
        ("box", (0.0,), 2.0, ((0.5 / 3.0) ** 2,)),
        ("box", (-2.0,), 2.0, (1.0,)),
        ("box", (0.0, -2.0), 2.0, ((0.5 / 3.0) ** 2, 1.0)),
    ],
)
def test_near_samples_pull_less_but_look_the_same(
    make_scene: Callable[..., Scene], space: str, starts: tuple[float, ...], reach: float, scales: tuple[float, ...]
) -> None:
    """A slab before cameras within and outside a box: its colour's gradient is scaled for those within, by their distance."""
    origins = torch.tensor([[0.0, 0.0, start] for start in starts], dtype=F64)
    rays = Rays.make(origins, torch.tensor([[0.0, 0.0, 1.0]], dtype=F64).expand(len(starts), 3))
    pictures, gradients = [], []
    for used in (0.0, reach):
        field = Slab(20.0, 0.495, 0.505, colour=(0.2, 0.5, 0.8)).double()
        field.colour = torch.nn.Parameter(field.colour.detach().clone())
        model = VolumetricConfig(StratifiedConfig(4000), gradient_reach=used).build(make_scene(space))
        rendering, _ = model.render_rays(field, rays, Context(box(space), training=True))
        pictures.append(rendering.rgb.detach())
        gradients.append(
            torch.stack([torch.autograd.grad(rgb.sum(), field.colour, retain_graph=True)[0] for rgb in rendering.rgb])
        )
    torch.testing.assert_close(pictures[1], pictures[0], atol=0.02, rtol=0.1)
    expected = torch.tensor(scales, dtype=F64)[:, None].expand(-1, 3)
    torch.testing.assert_close(gradients[1] / gradients[0], expected, rtol=0.1, atol=0)
