"""Disturbed training data: what changes, by how much, and what never does."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from invgraphics.config import fill
from invgraphics.core import Camera, Scene, View
from invgraphics.core.colour import linear_to_srgb
from invgraphics.errors import InputError
from invgraphics.scenes.degrade import TrainingData, chosen_views, degrade
from invgraphics.testing import toy_cameras
from invgraphics.training.batches import BatchConfig, Batches

EVERYTHING = TrainingData(train_views=5, size=12, pose_noise=2.0, photo_noise=0.1, exposure=0.5, background=(0.2, 0.4, 0.6))


@pytest.fixture
def scene(scene: Scene) -> Scene:
    """Without points, which `test_degraded_points` is about: making them again takes seconds."""
    return replace(scene, points=None)


@pytest.fixture
def many(scene: Scene) -> Scene:
    """A grey scene of very many small views, for statistics."""
    image = torch.full((4, 4, 3), 118, dtype=torch.uint8)
    views = tuple(View(camera, image, f"v{i}") for i, camera in enumerate(toy_cameras(400, 4)))
    return scene.with_views(train=views)


def _same_view(a: View, b: View) -> bool:
    return torch.equal(a.image, b.image) and torch.equal(a.camera.cam_to_world, b.camera.cam_to_world)


def test_nothing_asked_for_changes_nothing(scene: Scene) -> None:
    assert degrade(scene, TrainingData(), 0) is scene
    assert degrade(scene, TrainingData(train_views=len(scene.train)), 0).digest("train") == scene.digest("train")


def test_test_views_are_never_touched(scene: Scene) -> None:
    with_val = scene.with_views(val=scene.test[:1])
    damaged = degrade(with_val, EVERYTHING, 0)
    for split in ("test", "val"):
        assert damaged.digest(split) == with_val.digest(split)
        pairs = zip(getattr(damaged, split), getattr(with_val, split), strict=True)
        assert all(a is b for a, b in pairs)
    assert damaged.digest("train") != scene.digest("train")
    assert "photo_noise = 0.1" in damaged.notes["training_data"]


def test_the_seed_decides(scene: Scene) -> None:
    first, again, other = (degrade(scene, EVERYTHING, seed) for seed in (3, 3, 4))
    assert first.digest("train") == again.digest("train") and first.camera_digest() == again.camera_digest()
    assert first.digest("train") != other.digest("train") and first.camera_digest() != other.camera_digest()


def test_fewer_views_are_nested_and_far_apart(scene: Scene) -> None:
    chosen = [chosen_views(scene, count) for count in range(1, len(scene.train) + 1)]
    assert all(set(few) < set(more) for few, more in itertools.pairwise(chosen))
    assert [len(views) for views in chosen] == list(range(1, len(scene.train) + 1))
    positions = torch.stack([view.camera.position for view in scene.train])

    def closest(indices: list[int]) -> float:
        return float(torch.pdist(positions[indices]).min())

    generator = torch.Generator().manual_seed(0)
    random = [closest(torch.randperm(len(positions), generator=generator)[:4].tolist()) for _ in range(50)]
    assert closest(chosen[3]) > np.quantile(random, 0.9)


def test_leaving_views_out_changes_none_that_stay(scene: Scene) -> None:
    data = TrainingData(pose_noise=1.0, photo_noise=0.05, exposure=0.3)
    every, few = degrade(scene, data, 1), degrade(scene, replace(data, train_views=4), 1)
    by_name = {view.name: view for view in every.train}
    assert len(few.train) == 4
    assert all(_same_view(view, by_name[view.name]) for view in few.train)


def test_pose_noise_has_the_size_it_says(many: Scene) -> None:
    """Angles from SciPy: an independent way from matrices to degrees."""
    from scipy.spatial.transform import Rotation

    noisy = degrade(many, TrainingData(pose_noise=3.0), 0)
    before, after = (torch.stack([v.camera.cam_to_world for v in s.train]).double() for s in (many, noisy))
    turn = Rotation.from_matrix((before[:, :3, :3].mT @ after[:, :3, :3]).numpy())
    degrees = np.degrees(turn.magnitude())
    assert np.sqrt((degrees**2).mean()) == pytest.approx(3.0, rel=0.1)
    per_cent = 100 * (after - before)[:, :3, 3].norm(dim=1) / many.extent
    assert float(per_cent.square().mean().sqrt()) == pytest.approx(3.0, rel=0.1)
    assert torch.allclose(after[:, :3, :3].mT @ after[:, :3, :3], torch.eye(3, dtype=torch.float64), atol=1e-5)
    # The same random numbers at another level: the errors grow in proportion.
    half = torch.stack([v.camera.position for v in degrade(many, TrainingData(pose_noise=1.5), 0).train]).double()
    assert torch.allclose(2 * (half - before[:, :3, 3]), (after - before)[:, :3, 3], atol=1e-5)


def test_photo_noise_and_exposure_have_the_size_they_say(many: Scene) -> None:
    grey = many.train[0].colour()[0, 0, 0]
    noise = torch.stack([v.colour() for v in degrade(many, TrainingData(photo_noise=0.05), 0).train]) - grey
    assert float(noise.std()) == pytest.approx(0.05, rel=0.03)
    assert abs(float(noise.mean())) < 0.002
    lit = np.stack([v.image.numpy()[0, 0, 0] for v in degrade(many, TrainingData(exposure=0.25), 0).train]) / 255.0
    # The sRGB curve as the standard writes it, without the library's own.
    linear, base = ((c + 0.055) / 1.055 for c in (lit, float(grey)))
    stops = np.log2(linear**2.4 / base**2.4)
    assert stops.std() == pytest.approx(0.25, rel=0.1)


def test_smaller_photographs_are_averages(scene: Scene) -> None:
    """Pillow's box filter on premultiplied colour is the same average."""
    small = degrade(scene, TrainingData(size=12), 0)
    for view, before in zip(small.train, scene.train, strict=True):
        assert (view.camera.width, view.camera.height) == (12, 12)
        assert torch.allclose(view.camera.focal, before.camera.focal / 2)
        assert view.depth is None
        channels = [before.over(torch.zeros(3))[..., i].numpy() for i in range(3)]
        expected = np.stack([np.asarray(Image.fromarray(c).resize((12, 12), Image.Resampling.BOX)) for c in channels], -1)
        np.testing.assert_allclose(view.over(torch.zeros(3)).numpy(), expected, atol=2.5 / 255)


def test_masks_and_linear_colours_survive_resizing(scene: Scene) -> None:
    mask = torch.ones(24, 24, dtype=torch.bool)
    mask[0, 0] = False
    view = replace(scene.train[0], image=3 * scene.train[0].colour(), alpha=None, mask=mask)
    linear = replace(scene, colour="linear").with_views(train=(view,))
    small = degrade(linear, TrainingData(size=12), 0).train[0]
    assert small.mask is not None
    assert (~small.mask).nonzero().tolist() == [[0, 0]]
    assert small.image.dtype == torch.float32 and float(small.image.max()) > 1
    brighter = degrade(linear, TrainingData(exposure=1.0), 0).train[0]
    lit = view.image > 0.01
    gains = (brighter.image / view.image)[lit]
    assert float(gains.std()) < 1e-5 and abs(float(gains.mean()) - 1) > 1e-3


def test_a_fixed_background_is_what_a_photograph_would_show(scene: Scene) -> None:
    black = degrade(scene, TrainingData(background="black"), 0)
    assert not black.has_alpha
    assert black.background.tolist() == [0, 0, 0]
    for view, before in zip(black.train, scene.train, strict=True):
        assert torch.allclose(view.colour(), before.over(torch.zeros(3)), atol=0.6 / 255)


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"train_views": 0}, "'train_views' must be at least 1"),
        ({"pose_noise": -1.0}, "'pose_noise' must be 0 or more"),
        ({"photo_noise": float("nan")}, "'data.photo_noise' cannot be nan"),
        ({"background": "pink"}, "not 'pink'"),
        ({"background": [0.0, 2.0, 0.0]}, "channels in"),
        ({"viewz": 3}, "Unknown key 'data.viewz'"),
    ],
)
def test_bad_settings_are_refused(table: dict, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        fill(TrainingData, table, "data")


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (TrainingData(train_views=99), "'toy' has 12 training views"),
        (TrainingData(size=100), "24 pixels long"),
    ],
)
def test_what_a_scene_cannot_give_is_refused(scene: Scene, data: TrainingData, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        degrade(scene, data, 0)
    opaque = scene.with_views(train=tuple(replace(view, alpha=None) for view in scene.train))
    with pytest.raises(InputError, match="opaque everywhere"):
        degrade(opaque, TrainingData(background="white"), 0)


def test_cameras_are_only_moved_by_pose_noise(scene: Scene) -> None:
    def cameras(damaged: Scene) -> list[Camera]:
        return [view.camera for view in damaged.train]

    same = degrade(scene, TrainingData(photo_noise=0.1, exposure=0.1, background="white"), 0)
    assert all(a is b for a, b in zip(cameras(same), cameras(scene), strict=True))


@pytest.mark.parametrize("data", [TrainingData(size=12), TrainingData(scales=(1, 2))])
def test_a_mask_that_leaves_no_smaller_pixel_leaves_out_the_view(scene: Scene, data: TrainingData) -> None:
    """Stripes of one pixel: no pixel of half the size is wholly valid."""
    height, width = scene.train[0].image.shape[:2]
    stripes = (torch.arange(width) % 2 == 0).expand(height, width)
    masked = scene.with_views(train=(replace(scene.train[0], mask=stripes), *scene.train[1:3]))
    damaged = degrade(masked, data, 0)
    whole = len(masked.train) * (len(data.scales) - 1)
    assert len(damaged.train) == whole + 2 and damaged.notes["masked_views"].startswith("1 without a valid pixel")
    Batches(BatchConfig(rays=64), damaged, torch.Generator(), torch.device("cpu")).rays(0.0)
    if data.size is not None:
        with pytest.raises(InputError, match="leave no pixel of any training view"):
            degrade(scene.with_views(train=masked.train[:1]), data, 0)


def test_noisy_display_colours_stay_in_their_range(many: Scene) -> None:
    white = [replace(view, image=torch.ones(4, 4, 3)) for view in many.train]
    for colour, most in (("srgb", 1.0), ("linear", 1.5)):
        damaged = degrade(replace(many, colour=colour, train=tuple(white)), TrainingData(photo_noise=0.2), 0)
        highest = max(float(view.image.max()) for view in damaged.train)
        assert highest == 1.0 if colour == "srgb" else highest > most


def test_a_named_background_is_a_display_colour(scene: Scene) -> None:
    for colour in ("srgb", "linear"):
        found = degrade(replace(scene, colour=colour), TrainingData(background="grey"), 0).background
        shown = linear_to_srgb(found) if colour == "linear" else found
        torch.testing.assert_close(shown, torch.full((3,), 0.5))
