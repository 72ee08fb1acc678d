"""Pairs as witnesses, on matches made with known cameras."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from dots import ring

from invgraphics.scenes.photos.pairs import Evidence, Pair
from invgraphics.scenes.photos.prepare import Prepared
from invgraphics.scenes.photos.suspicion import MATCHES, examine, explained, sampson

EYES = ring(8, distortion=None)
NAMES = [f"{index}.png" for index in range(len(EYES))]
PHOTOS = [Prepared(name, name, 160, 120, "") for name in NAMES]


@dataclass
class Model:
    """As much of a reconstruction as is looked at."""

    images: dict[int, object] = field(default_factory=dict)


def model_of(eyes) -> Model:
    import pycolmap

    reconstruction = pycolmap.Reconstruction()
    model = Model()
    for index, eye in enumerate(eyes, start=1):
        camera = pycolmap.Camera(
            model="PINHOLE", width=eye.size[0], height=eye.size[1], params=[*eye.focal, *eye.centre], camera_id=index
        )
        reconstruction.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=NAMES[index - 1], camera_id=index, image_id=index)
        pose = pycolmap.Rigid3d(np.column_stack([eye.R, eye.t]))
        reconstruction.add_image_with_trivial_frame(image, pose)
        model.images[index] = reconstruction.images[index]
    model.keep = reconstruction
    return model


def matches(first: int, second: int, count: int = 60, seen_as: int | None = None) -> Pair:
    """Random points in both photographs; the second may show them as another camera would (the scene looks alike there)."""
    points = np.random.default_rng(first * 100 + second).uniform(-1, 1, (count, 3))
    other = EYES[second if seen_as is None else seen_as]
    return Pair(first, second, (EYES[first].pixels(points), other.pixels(points)))


def test_true_matches_are_explained_and_others_are_not() -> None:
    model = model_of(EYES)
    images = list(model.images.values())
    assert explained(images[0], images[1], matches(0, 1)) == 1
    assert explained(images[0], images[4], matches(0, 4, seen_as=1)) < 0.5


def test_a_folded_reconstruction_is_suspicious() -> None:
    """Every fifth pair saw a part that looks like another one."""
    honest = [matches(i, j) for i in range(8) for j in range(i + 1, 8)]
    found = examine(model_of(EYES), PHOTOS, Evidence((100,) * 8, tuple(honest)))
    assert (found["pairs"], found["contradicting"], found["suspicious"]) == (28, 0, False)
    mixed = [
        matches(pair.first, pair.second, seen_as=(pair.second + 3) % 8) if n % 5 == 0 else pair for n, pair in enumerate(honest)
    ]
    found = examine(model_of(EYES), PHOTOS, Evidence((100,) * 8, tuple(mixed)))
    assert found["contradicting"] == 6
    assert found["suspicious"]
    assert "21 %" in found["sentence"]
    assert found["worst"][0]["photos"][0] in NAMES


def test_a_few_mistakes_in_a_scene_that_holds_something_twice_are_not_heard() -> None:
    """They are verified and contradict the poses, but with fewer matches than those that tell the truth."""
    honest = [matches(i, j, 200) for i in range(8) for j in range(i + 1, 8)]
    mixed = [
        matches(pair.first, pair.second, 60, seen_as=(pair.second + 3) % 8) if n % 5 == 0 else pair
        for n, pair in enumerate(honest)
    ]
    found = examine(model_of(EYES), PHOTOS, Evidence((100,) * 8, tuple(mixed)))
    assert (found["pairs"], found["contradicting"], found["suspicious"]) == (22, 0, False)


def test_weak_pairs_and_photographs_without_a_pose_are_no_witnesses() -> None:
    evidence = Evidence((100,) * 8, (matches(0, 4, MATCHES - 1, seen_as=1), matches(0, 7, seen_as=2)))
    found = examine(model_of(EYES[:7]), PHOTOS, evidence)
    assert (found["pairs"], found["suspicious"]) == (0, False)


def test_distance_is_the_smallest_correction() -> None:
    """For a sideways step the epipolar lines are rows, and half of a difference in height is corrected in each picture."""
    first = np.array([[0.1, 0.2], [0.0, -0.3]])
    second = first + np.array([[0.05, 0.0], [0.07, 0.01]])
    distance = sampson(np.eye(3), np.array([2.0, 0, 0]), first, second)
    np.testing.assert_allclose(distance, [0, 0.01 / np.sqrt(2)], atol=1e-12)


def test_a_turn_on_the_spot_contradicts_nothing() -> None:
    assert sampson(np.eye(3), np.zeros(3), np.ones((3, 2)), np.ones((3, 2)) * 1.1) == pytest.approx(np.zeros(3))
