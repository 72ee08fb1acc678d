"""The conformance suites refuse what breaks a contract, in one way each, and pass the same part unbroken."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import normalize, softplus
from typing_extensions import override

from invgraphics.core import (
    Camera,
    Context,
    Field,
    FieldValues,
    Gaussians,
    Points,
    Quantity,
    Renderer,
    Rendering,
    Samples,
    Scene,
    Trace,
)
from invgraphics.fields.analytic import Sphere
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volumetric import Volumetric
from invgraphics.testing import check_field, check_renderer, toy_scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return toy_scene(views=2, size=8)


class Waves(Field):
    """Density and colour that are sines of the position, and three points."""

    provides = Quantity.DENSITY | Quantity.RADIANCE | Quantity.POINTS

    def __init__(self) -> None:
        super().__init__()
        self.waves = nn.Linear(3, 4)
        self.register_buffer("places", torch.rand(3, 3))

    @override
    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        density, colour = self.waves(samples.position).sin().split([1, 3], dim=1)
        return FieldValues(
            density=softplus(density[:, 0]) if Quantity.DENSITY in want else None,
            radiance=colour.sigmoid() if Quantity.RADIANCE in want else None,
        )

    @override
    def primitives(self, want: Quantity, ctx: Context) -> Points:
        return Points(self.get_buffer("places"), torch.full((3, 3), 0.5))

    @override
    def primitive_count(self) -> int:
        return 3


class Detached(Waves):
    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        values = super().query(samples, want)
        return FieldValues(**{name: None if value is None else value.detach() for name, value in vars(values).items()})


class DetachedColour(Waves):
    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        values = super().query(samples, want)
        return replace(values, radiance=None if values.radiance is None else values.radiance.detach())


class DetachedPositions(Waves):
    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        return super().query(replace(samples, position=samples.position.detach()), want)


class Unregistered(Waves):
    def __init__(self) -> None:
        super().__init__()
        self.offset = torch.rand(3)

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        return super().query(replace(samples, position=samples.position + self.offset), want)


class Generous(Waves):
    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        return super().query(samples, self.provides)


class Forgetful(Waves):
    """Does not take over its biases."""

    def load_state_dict(self, state_dict, *args, **kwargs):
        return super().load_state_dict(state_dict | {"waves.bias": self.waves.bias.detach().clone()}, *args, **kwargs)


class Deaf(Waves):
    """Its parameters are there, and have no effect."""

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        position = samples.position
        nothing = 0 * self.waves.weight.sum()
        return FieldValues(
            density=position[:, 0].sigmoid() + nothing if Quantity.DENSITY in want else None,
            radiance=position.sigmoid() + nothing if Quantity.RADIANCE in want else None,
        )


class NoPoints(Waves):
    def primitives(self, want: Quantity, ctx: Context) -> Points:
        return Field.primitives(self, want, ctx)


class NowherePoints(Waves):
    def primitives(self, want: Quantity, ctx: Context) -> Points:
        return Points(torch.full((3, 3), torch.nan), torch.full((3, 3), 0.5))


class FlatPoints(Waves):
    def primitives(self, want: Quantity, ctx: Context) -> Points:
        return Points(torch.zeros(3, 2), torch.full((3, 3), 0.5))


class Splats(Field):
    """Two Gaussians without any quantity at points."""

    provides = Quantity.GAUSSIANS

    def __init__(self, scale: float = 0.1, opacity: float = 0.5, *, learnt: bool = True) -> None:
        super().__init__()
        self.scale, self.opacity, self.learnt = scale, opacity, learnt
        self.means = nn.Parameter(torch.rand(2, 3))

    @override
    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        raise NotImplementedError

    @override
    def primitives(self, want: Quantity, ctx: Context) -> Gaussians:
        means = self.means if self.learnt else self.means.detach()
        turned = torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4)
        return Gaussians(means, turned, torch.full((2, 3), self.scale), torch.full((2,), self.opacity), torch.zeros(2, 4, 3))

    @override
    def primitive_count(self) -> int:
        return 2


def test_fields_that_keep_the_contract_pass(scene: Scene) -> None:
    for field in (Waves(), Splats()):
        before = {name: value.clone() for name, value in field.state_dict().items()}
        check_field(field, scene)
        assert all(torch.equal(value, before[name]) for name, value in field.state_dict().items()), "as it was"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (Detached, "outside the graph, .*: density, radiance"),
        (DetachedColour, "outside the graph, .*: radiance"),
        (DetachedPositions, "no gradient reaches the positions"),
        (Unregistered, r"neither parameters nor buffers, .*: \['offset'\]"),
        (Generous, "asked for density alone, got radiance too"),
        (Forgetful, "density differs once the state is loaded again"),
        (Deaf, "no gradient reaches the parameters"),
        (NoPoints, "has no points"),
        (NowherePoints, "position of points is not finite"),
        (FlatPoints, r"the shape of position of 3 points is \(3, 2\)"),
        (lambda: Splats(scale=0.0), "scale is not above 0"),
        (lambda: Splats(opacity=1.5), r"opacities of gaussians leave \[0, 1\]"),
        (lambda: Splats(learnt=False), "no primitive is in the graph"),
    ],
)
def test_a_field_that_breaks_the_contract_is_refused(make: Callable[[], Field], words: str, scene: Scene) -> None:
    with pytest.raises(Exception, match=words):
        check_field(make(), scene)


class Changed(Renderer):
    """A volume renderer whose pictures are changed."""

    requires = Volumetric.requires

    def __init__(self, change: Callable[[Rendering], Rendering], *, fixed: bool = False) -> None:
        super().__init__()
        self.inner = Volumetric(StratifiedConfig(64).build(toy_scene(views=2, size=4)))
        self.change, self.fixed = change, fixed

    @override
    def render_image(self, field: Field, camera: Camera, ctx: Context) -> tuple[Rendering, Trace]:
        seen = camera.moved(camera.cam_to_world.detach() + 0 * camera.cam_to_world) if self.fixed else camera
        rendering, trace = self.inner.render_image(field, seen, ctx)
        return self.change(rendering), trace


def _straight(picture: Rendering) -> Rendering:
    return replace(picture, rgb=picture.rgb / picture.alpha[..., None].clamp_min(1e-3))


def _normals(picture: Rendering, change: Callable[[Tensor], Tensor]) -> Rendering:
    return replace(picture, normal=None if picture.normal is None else change(picture.normal))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_straight, "colours are not premultiplied"),
        (lambda p: _normals(p, lambda normal: 0.5 * normal), "a normal is neither of unit length nor 0"),
        (lambda p: _normals(p, lambda normal: -normal), "a normal points away from the camera"),
        (lambda p: _normals(p, lambda normal: normalize(normal + 1e-3, dim=-1)), "there is a normal where alpha is below"),
        (lambda p: replace(p, depth=torch.where(p.alpha < 0.5, 0.0, p.depth)), "depth must be infinite where alpha is below"),
        (lambda p: replace(p, alpha=2 * p.alpha), r"alpha leaves \[0, 1\]"),
    ],
    ids=["straight", "short", "away", "everywhere", "near", "above"],
)
def test_a_renderer_that_breaks_the_contract_is_refused(
    change: Callable[[Rendering], Rendering], words: str, scene: Scene
) -> None:
    ball = Sphere(3.0, 0.6, colour=(0.2, 0.5, 0.8))
    check_renderer(Changed(lambda picture: picture), ball, scene)
    with pytest.raises(AssertionError, match=words):
        check_renderer(Changed(change), ball, scene)


class _Strata(Volumetric):
    def __init__(self) -> None:
        super().__init__(StratifiedConfig(16).build(toy_scene(views=1, size=8)))


class WrongRays(_Strata):
    """Gives each ray the samples of another one."""

    @override
    def render_rays(self, field, rays, ctx):
        return super().render_rays(field, rays[(torch.arange(len(rays)) * 7) % len(rays)], ctx)


class Mirrored(_Strata):
    @override
    def render_whole(self, field, camera, ctx):
        rendering, trace = self.render_rays(field, camera.rays(), ctx)
        size = camera.height, camera.width
        parts = {name: value.unflatten(0, size).flip(1) for name, value in vars(rendering).items() if value is not None}
        return Rendering(**parts), trace


class Shallow(_Strata):
    @override
    def render_rays(self, field, rays, ctx):
        rendering, trace = super().render_rays(field, rays, ctx)
        return replace(rendering, depth=torch.where(rendering.alpha >= 0.5, 1e-4, rendering.depth)), trace


class Uncounted(_Strata):
    @override
    def render_rays(self, field, rays, ctx):
        rendering, trace = super().render_rays(field, rays, ctx)
        return rendering, replace(trace, weights=trace.weights / 2)


@pytest.mark.parametrize(
    ("renderer", "words"),
    [
        (WrongRays, "the picture does not move|the colour of a ray depends on those before it"),
        (Mirrored, "does not move with the camera's principal point"),
        (Shallow, "depth must lie within the bounds"),
        (Uncounted, "alpha is not the sum of the samples' weights"),
    ],
    ids=["rays", "mirrored", "depth", "weights"],
)
def test_a_renderer_of_another_picture_is_refused(renderer: Callable[[], Renderer], words: str, scene: Scene) -> None:
    """Each has the right shapes and ranges, is repeatable, and has gradients."""
    torch.manual_seed(0)
    check_renderer(Volumetric(StratifiedConfig(16).build(scene)), Waves(), scene)
    with pytest.raises(AssertionError, match=words):
        check_renderer(renderer(), Waves(), scene)


class TurnedGradient(Sphere):
    """A signed distance whose gradient has its axes in another order."""

    @override
    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        values = super().query(samples, want)
        return replace(values, gradient=None if values.gradient is None else values.gradient.flip(1))


def test_a_gradient_of_something_else_is_refused(scene: Scene) -> None:
    with pytest.raises(AssertionError, match="the gradient is not that of the signed distance"):
        check_field(TurnedGradient(3.0, 0.6), scene)


def test_a_renderer_without_a_gradient_to_the_pose_is_refused(scene: Scene) -> None:
    with pytest.raises(AssertionError, match="no gradient reaches the pose"):
        check_renderer(Changed(lambda picture: picture, fixed=True), Sphere(3.0, 0.6, colour=(0.2, 0.5, 0.8)), scene)
