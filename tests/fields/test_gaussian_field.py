"""Gaussian fields: where they start, resizing, checkpoints of another size, and motion."""

import math
from dataclasses import replace

import pytest
import torch

from invgraphics.core import Camera, Context, Points, Quantity, Samples, View, harmonics
from invgraphics.core.colour import srgb_to_linear
from invgraphics.errors import InputError, NotComposableError
from invgraphics.fields.gaussian import PARAMETERS, GaussianField, GaussianFieldConfig


def _points(n: int = 30) -> Points:
    return Points(torch.rand(n, 3), torch.rand(n, 3))


def _gaussians(field: GaussianField, scene):
    return field.primitives(Quantity.GAUSSIANS, Context(scene.bounds))


def _scrambled(scene, degree: int = 3, dtype: torch.dtype = torch.float64) -> GaussianField:
    field = GaussianFieldConfig(sh_degree=degree).build(scene).to(dtype)
    with torch.no_grad():
        for name in PARAMETERS:
            getattr(field, name).copy_(torch.randn_like(getattr(field, name)))
    return field


def test_starts_from_the_points(make_scene):
    points = _points()
    scene = make_scene(points=points)
    field = GaussianFieldConfig(opacity=0.2, scale_factor=0.5).build(scene)
    gaussians = _gaussians(field, scene)
    torch.testing.assert_close(gaussians.means, points.position)
    torch.testing.assert_close(gaussians.opacities, torch.full((30,), 0.2))
    torch.testing.assert_close(harmonics.evaluate(gaussians.sh, torch.eye(3)[:1].expand(30, 3)) + 0.5, points.rgb)
    distances = torch.cdist(points.position.double(), points.position.double())
    nearest = distances.sort(dim=1).values[:, 1:4].mean(dim=1).float()
    torch.testing.assert_close(gaussians.scales, 0.5 * nearest[:, None].expand(30, 3))
    assert field.primitive_count() == len(gaussians) == 30
    assert {name: tuple(p.shape) for name, p in field.named_parameters()} == {
        "means": (30, 3),
        "quaternions": (30, 4),
        "log_scales": (30, 3),
        "opacity_logits": (30,),
        "sh_dc": (30, 1, 3),
        "sh_rest": (30, 15, 3),
    }


def test_linear_scenes_get_linear_colours(make_scene):
    points = _points()
    field = GaussianFieldConfig(sh_degree=0).build(make_scene(points=points, colour="linear"))
    torch.testing.assert_close(field.sh_dc[:, 0] * harmonics.BAND_0 + 0.5, srgb_to_linear(points.rgb))


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_few_or_coincident_points_still_have_a_size(make_scene, n):
    scene = make_scene(points=Points(torch.zeros(n, 3), torch.zeros(n, 3)))
    scales = _gaussians(GaussianFieldConfig().build(scene), scene).scales
    assert torch.isfinite(scales).all()
    assert (scales > 0).all()


def test_an_outlier_does_not_cover_the_scene(make_scene):
    points = Points(torch.cat([torch.rand(50, 3), torch.tensor([[100.0, 0, 0]])]), torch.rand(51, 3))
    scene = make_scene(points=points)
    assert float(_gaussians(GaussianFieldConfig().build(scene), scene).scales[-1].detach().max()) <= 51


def test_random_start_fills_the_box(make_scene):
    scene = make_scene(points=_points())
    field = GaussianFieldConfig(init="random", count=2000).build(scene)
    unit = scene.bounds.to_unit(field.means.detach())
    assert field.primitive_count() == 2000
    assert ((unit >= 0) & (unit <= 1)).all()
    torch.testing.assert_close(unit.mean(0), torch.full((3,), 0.5), atol=0.03, rtol=0)
    torch.testing.assert_close(unit.std(0), torch.full((3,), 12**-0.5), atol=0.02, rtol=0)


def test_random_start_in_contracted_space_reaches_far(make_scene):
    scene = make_scene("contracted")
    distance = ((GaussianFieldConfig(count=2000).build(scene).means.detach() - scene.bounds.centre) / scene.bounds.half).norm(
        dim=1
    )
    # 400 points go outwards; of the others only the box's corners lie beyond distance 1, and none beyond sqrt(3).
    beyond = 400 * (1 - math.log(3**0.5) / math.log(30))
    assert int((distance > 3**0.5).sum()) == pytest.approx(beyond, rel=0.1)
    assert float(distance.max()) <= 30.001


def _photographs(scene, alpha: bool = False):
    """Two views from either side of the scene's middle: the left half of each is red, the right half blue."""
    centre, distance = scene.bounds.centre, 2.0
    views = []
    for facing in (1.0, -1.0):
        pose = torch.diag(torch.tensor([facing, 1.0, facing, 1.0]))
        pose[:3, 3] = centre - distance * pose[:3, 2]
        camera = Camera(pose, torch.tensor([60.0, 60.0]), torch.tensor([20.0, 10.0]), 40, 20)
        image = torch.zeros(20, 40, 3)
        image[:, :20, 0] = image[:, 20:, 2] = 1.0
        views.append(View(camera, image, f"facing {facing}", alpha=torch.ones(20, 40) if alpha else None))
    return scene.with_views(train=tuple(views))


def test_a_backdrop_lies_behind_the_subject_in_the_colours_of_the_photographs(make_scene):
    scene = _photographs(make_scene("contracted", points=_points(30), half=0.3))
    field = GaussianFieldConfig(backdrop=101).build(scene)
    means, colour = field.means.detach()[30:], field.sh_dc.detach()[30:, 0] * harmonics.BAND_0 + 0.5
    assert field.primitive_count() == 131
    torch.testing.assert_close(field.means.detach()[:30], scene.points.position)
    for index, (view, facing) in enumerate(zip(scene.train, (1.0, -1.0), strict=True)):
        own = slice(0, 51) if index == 0 else slice(51, 101)  # evenly over the views
        offset = means[own] - view.camera.position
        x, y, z = offset[:, 0] * facing, offset[:, 1], offset[:, 2] * facing
        assert (z > 0).all()
        assert ((60 * x / z).abs() <= 20).all() and ((60 * y / z).abs() <= 10).all(), "outside the picture"
        reach = offset.norm(dim=1) / 2.0
        assert (reach >= 1.5).all() and (reach <= 10.0001).all(), "not behind the subject"
        left = x < 0
        torch.testing.assert_close(colour[own][left], torch.tensor([1.0, 0.0, 0.0]).expand(int(left.sum()), 3))
        torch.testing.assert_close(colour[own][~left], torch.tensor([0.0, 0.0, 1.0]).expand(int((~left).sum()), 3))


@pytest.mark.parametrize(("space", "alpha"), [("box", False), ("contracted", True)])
def test_no_backdrop_where_there_is_nothing_behind(make_scene, space, alpha):
    scene = _photographs(make_scene(space, points=_points(30)), alpha)
    torch.manual_seed(3)
    assert GaussianFieldConfig(backdrop=100).build(scene).primitive_count() == 30
    after = torch.rand(1)
    torch.manual_seed(3)
    GaussianFieldConfig().build(scene)
    assert torch.equal(after, torch.rand(1)), "the fit that follows would see other random numbers than before"


def test_a_backdrop_leaves_out_masked_pixels_and_stays_at_a_distance_around_cameras(make_scene):
    scene = _photographs(make_scene("contracted", points=_points(30), half=0.3))
    here = torch.eye(4)
    here[:3, 3] = scene.bounds.centre  # a camera in the middle looks outwards
    mask = torch.zeros(20, 40, dtype=torch.bool)
    mask[:, 30:] = True
    view = scene.train[0]
    view = replace(view, camera=view.camera.moved(here), mask=mask)
    field = GaussianFieldConfig(backdrop=50).build(scene.with_views(train=(view,)))
    offset = field.means.detach()[30:] - scene.bounds.centre
    assert len(offset) == 50
    assert (60 * offset[:, 0] / offset[:, 2] >= 10).all(), "a pixel that does not count"
    assert (offset.norm(dim=1) >= 1.49 * scene.bounds.radius).all()


def test_the_backdrop_gives_way_to_a_limit_on_primitives():
    config = GaussianFieldConfig(count=500, max_init=400, backdrop=300)
    assert config.capped(10_000) == config
    assert (config.capped(600).count, config.capped(600).backdrop) == (500, 100)
    assert (config.capped(300).count, config.capped(300).max_init, config.capped(300).backdrop) == (300, 300, 0)


def test_too_many_points_are_thinned_by_the_seed(make_scene):
    scene = make_scene(points=_points(100))
    starts = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        starts.append(GaussianFieldConfig(max_init=20).build(scene).means)
    assert len(starts[0]) == 20
    assert torch.equal(starts[0], starts[1])
    assert not torch.equal(starts[0], starts[2])


@pytest.mark.parametrize(("points", "says"), [(Points(torch.zeros(0, 3), torch.zeros(0, 3)), "empty"), (None, "not finite")])
def test_bad_point_clouds_are_refused_in_a_sentence(make_scene, points, says):
    if points is None:
        points = _points()
        points.position[3, 1] = math.nan
    with pytest.raises(InputError, match=says):
        GaussianFieldConfig().build(make_scene(points=points))
    assert GaussianFieldConfig(init="random", count=5).build(make_scene(points=points)).primitive_count() == 5


@pytest.mark.parametrize("bad", [{"sh_degree": 4}, {"opacity": 1.0}, {"count": 0}, {"backdrop": -1}, {"scale_factor": 0.0}])
def test_nonsense_is_refused(bad):
    with pytest.raises(ValueError, match=f"{next(iter(bad))} .*must"):
        GaussianFieldConfig(**bad)


def test_only_active_bands_are_given_and_remembered(make_scene):
    scene = make_scene(points=_points())
    field = _scrambled(scene)
    field.active_degree = 1
    assert _gaussians(field, scene).sh.shape == (30, 4, 3)
    other = GaussianFieldConfig().build(scene)
    other.load_state_dict(field.state_dict())
    assert other.active_degree == 1
    with pytest.raises(ValueError, match="0 to 3"):
        field.active_degree = 4


def test_isotropic_gaussians_stay_round_and_keep_gradients(make_scene):
    scene = make_scene(points=_points())
    field = GaussianFieldConfig(isotropic=True).build(scene)
    with torch.no_grad():
        field.log_scales += torch.randn_like(field.log_scales)
    scales = _gaussians(field, scene).scales
    assert (scales == scales[:, :1]).all()
    (gradient,) = torch.autograd.grad(scales[:, 0].sum(), field.log_scales)
    assert (gradient != 0).all()


def test_replace_changes_the_number(make_scene):
    field = GaussianFieldConfig().build(make_scene(points=_points()))
    halved = {name: getattr(field, name)[::2] for name in PARAMETERS}
    field.replace(halved)
    assert field.primitive_count() == 15
    assert len(list(field.parameters())) == 6
    assert all(parameter.is_leaf and parameter.requires_grad for parameter in field.parameters())
    for bad in ({"means": field.means}, halved | {"means": torch.zeros(4, 3)}, halved | {"sh_rest": torch.zeros(15, 3, 3)}):
        with pytest.raises(ValueError, match=r"replace needs|rows of"):
            field.replace(bad)


def test_a_checkpoint_of_another_size_loads(make_scene):
    scene = make_scene(points=_points())
    big, small = _scrambled(scene, dtype=torch.float32), GaussianFieldConfig(init="random", count=7).build(scene)
    held = small.means
    torch.nn.ModuleDict({"field": small}).load_state_dict(torch.nn.ModuleDict({"field": big}).state_dict())
    assert small.means is held
    for name in PARAMETERS:
        assert torch.equal(getattr(small, name), getattr(big, name))
    _gaussians(small, scene).means.sum().backward()
    assert small.means.grad is not None
    assert small.means.grad.shape == (30, 3)
    with pytest.raises(RuntimeError, match="sh_rest"):
        GaussianFieldConfig(sh_degree=1).build(scene).load_state_dict(big.state_dict())


def test_what_gaussians_do_not_have_is_refused(make_scene):
    field = GaussianFieldConfig().build(make_scene(points=_points()))
    with pytest.raises(NotComposableError, match="sdf"):
        field.query(Samples.at(torch.zeros(1, 3)), Quantity.DENSITY | Quantity.SDF)
    with pytest.raises(NotComposableError, match="planes"):
        field.primitives(Quantity.PLANES, Context(make_scene().bounds))


def test_dropout_makes_a_growing_share_transparent_in_training_only(make_scene):
    scene = make_scene(points=_points(20_000))
    config = GaussianFieldConfig(opacity=0.3, dropout=0.4)
    field = config.build(scene)

    def opacities(progress: float, training: bool = True) -> torch.Tensor:
        ctx = Context(scene.bounds, training=training, progress=progress, generator=torch.Generator().manual_seed(0))
        return field.primitives(Quantity.GAUSSIANS, ctx).opacities

    whole = torch.full((20_000,), 0.3)
    torch.testing.assert_close(opacities(1.0, training=False), whole)
    torch.testing.assert_close(opacities(0.0), whole)
    for progress, share in ((0.5, 0.2), (1.0, 0.4)):
        shown = opacities(progress)
        assert float((shown == 0).float().mean()) == pytest.approx(share, abs=0.02)
        # As much is absorbed on average.
        assert shown.mean().item() == pytest.approx(0.3, abs=0.01)
        torch.testing.assert_close(shown[shown > 0], whole[shown > 0] / (1 - share))
    assert torch.equal(opacities(1.0), opacities(1.0))
    opacities(1.0).sum().backward()
    assert torch.equal(field.opacity_logits.grad == 0, opacities(1.0) == 0)


def test_dropout_is_for_few_photographs(make_scene):
    scene = make_scene(points=_points())
    scene = replace(scene, train=scene.train * 3)
    few = len(scene.train)
    given = {views: replace(GaussianFieldConfig(dropout=0.2), dropout_views=views) for views in (0, few - 1, few)}
    assert {views: config.build(scene).dropout for views, config in given.items()} == {0: 0.2, few - 1: 0.0, few: 0.2}
    for wrong in ({"dropout": 1.0}, {"dropout": -0.1}, {"dropout_views": -1}):
        with pytest.raises(ValueError, match="dropout"):
            GaussianFieldConfig(**wrong)
