"""Training and testing at several scales."""

from dataclasses import replace

import pytest
import torch

from invgraphics.core import Bounds, Model, Scene
from invgraphics.errors import InputError
from invgraphics.experiments.scaled import scaled_scores
from invgraphics.fields.analytic import Sphere
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volumetric import Volumetric
from invgraphics.scenes import scales
from invgraphics.scenes.degrade import TrainingData, degrade
from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.open import SceneSource
from invgraphics.scenes.scales import resized_view, scene_at
from invgraphics.testing import toy_scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return toy_scene(views=3, size=24)


def test_every_training_view_is_shown_once_at_each_scale(scene: Scene) -> None:
    shown = degrade(scene, TrainingData(train_views=2, scales=(1, 2), pose_noise=1.0), seed=4)
    assert [(view.camera.width, view.camera.height) for view in shown.train] == [(24, 24)] * 2 + [(12, 12)] * 2
    for large, small in zip(shown.train[:2], shown.train[2:], strict=True):
        assert small.name == f"{large.name} at 1/2"
        # One photograph, with the error of one pose.
        assert torch.equal(small.camera.cam_to_world, large.camera.cam_to_world)
        torch.testing.assert_close(small.camera.focal, large.camera.focal / 2)
        premultiplied = (large.colour() * large.opacity()[..., None]).view(12, 2, 12, 2, 3).mean(dim=(1, 3))
        assert float((small.colour() * small.opacity()[..., None] - premultiplied).abs().max()) < 3 / 255
    assert shown.test is scene.test


def test_a_scene_that_was_opened_is_opened_at_the_smaller_size(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def open_scene(spec: str, options: SceneOptions) -> Scene:
        asked.append((spec, options))
        smaller = toy_scene(views=3, size=12)
        return replace(smaller, bounds=Bounds(-2 * torch.ones(3), torch.ones(3)), world_from_local=2 * torch.eye(4))

    monkeypatch.setattr(scales, "source_of", lambda scene: SceneSource("bricks", SceneOptions(size=24, test_views=5)))
    monkeypatch.setattr(scales, "open_scene", open_scene)
    assert scene_at(scene, 1) is scene
    smaller = scene_at(scene, 2)
    assert smaller.train[0].camera.width == 12
    # One field is fitted to both: what a loader makes of smaller pictures must not move its bounds or its frame.
    assert smaller.bounds is scene.bounds
    assert smaller.world_from_local is scene.world_from_local
    assert asked == [("bricks", SceneOptions(size=12, test_views=5))]


def test_pictures_of_several_sizes_are_each_scaled(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Opened again, all would have at most the largest one's new size: the small ones would stay as they are."""
    monkeypatch.setattr(scales, "source_of", lambda scene: SceneSource("bricks", SceneOptions()))
    monkeypatch.setattr(scales, "open_scene", lambda spec, options: pytest.fail("opened again"))
    large = toy_scene(views=3, size=48)
    mixed = scene.with_views(train=(scene.train[0], large.train[1]), test=(large.test[0],), val=(large.test[1],))
    smaller = scene_at(mixed, 2)
    assert [view.camera.width for view in (*smaller.train, *smaller.val, *smaller.test)] == [12, 24, 24, 24]


@pytest.mark.parametrize("opaque", [False, True])
@pytest.mark.parametrize(("width", "height"), [(12, 8), (9, 8), (12, 7)])
def test_colours_are_averaged_with_their_coverage(scene: Scene, opaque: bool, width: int, height: int) -> None:
    """Sums over a picture are kept, whether new pixels are blocks of old ones or cut them; one masked pixel masks its own."""
    generator = torch.Generator().manual_seed(0)
    mask = torch.ones(24, 36, dtype=torch.bool)
    mask[23, 35] = False
    alpha = None if opaque else torch.rand(24, 36, generator=generator)
    camera = replace(scene.train[0].camera, width=36, height=24)
    colour = torch.rand(24, 36, 3, generator=generator)
    view = replace(scene.train[0], camera=camera, image=colour, alpha=alpha, mask=mask, depth=None, normal=None)
    small = resized_view(view, width, height)
    area = 36 * 24 / (width * height)
    before, after = view.colour() * view.opacity()[..., None], small.colour() * small.opacity()[..., None]
    assert torch.allclose(after.sum((0, 1)) * area, before.sum((0, 1)), rtol=1e-5)
    assert float(small.opacity().sum()) * area == pytest.approx(float(view.opacity().sum()), rel=1e-5)
    assert small.mask is not None and int((~small.mask).sum()) == 1 and not small.mask[-1, -1]
    if (width, height) == (12, 8):
        expected = before.view(8, 3, 12, 3, 3).mean(dim=(1, 3))
        assert torch.allclose(after, expected, atol=1e-6)


def test_scores_at_a_scale_are_those_of_smaller_pictures(scene: Scene) -> None:
    ball = Sphere(9.0, 0.6, colour=(0.2, 0.5, 0.7))
    model = Model(ball, Volumetric(StratifiedConfig(16).build(scene)), scene.bounds)
    quality, skipped = scaled_scores(model, scene, "float", {"test_scales": [2]})
    assert set(quality) == {"psnr_at_1_2", "ssim_at_1_2"}
    assert not skipped
    errors = []
    for view in scene.test:
        picture = model.render(view.camera.resized(12, 12)).over(scene.background)
        truth = view.over(scene.background).view(12, 2, 12, 2, 3).mean(dim=(1, 3))
        errors.append(-10 * torch.log10((picture - truth).square().mean()))
    assert quality["psnr_at_1_2"].mean == pytest.approx(float(torch.stack(errors).mean()), abs=0.1)
    assert scaled_scores(model, scene, "float", {}) == ({}, {})
    assert set(scaled_scores(model, scene, "float", {"test_scales": [2]}, refined=True)[1]) == {"psnr_at_1_2", "ssim_at_1_2"}
    of_a_class = replace(scene, train=tuple(replace(view, subject=0) for view in scene.train))
    quality, skipped = scaled_scores(model, of_a_class, "float", {"test_scales": [2]})
    assert of_a_class.is_class and not quality and all("inferred" in why for why in skipped.values()) and len(skipped) == 2


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"scales": ()}, "divisors"),
        ({"scales": (1, 0)}, "divisors"),
        ({"test_scales": (2, 2)}, "divisors"),
        ({"scales": (1, 2), "size": 8}, "both resize"),
    ],
)
def test_refusals(settings: dict[str, tuple[int, ...]], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        replace(TrainingData(), **settings)  # pyright: ignore[reportArgumentType]


def test_pictures_do_not_get_too_small(scene: Scene) -> None:
    with pytest.raises(InputError, match="side of 6 pixels"):
        degrade(scene, TrainingData(scales=(1, 4)), seed=0)
