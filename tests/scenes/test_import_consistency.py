"""Pairs as witnesses, on matches made with known cameras."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from dots import ring

from invgraphics.scenes.photos.consistency import MATCHES, check_consistency, explained_share, parallax, sampson
from invgraphics.scenes.photos.pairs import MatchedPair, VerifiedMatches
from invgraphics.scenes.photos.plausible import implausible_parameters, is_folded
from invgraphics.scenes.photos.prepare import Prepared

EYES = ring(8, distortion=None)
NAMES = [f"{index}.png" for index in range(len(EYES))]
PHOTOS = [Prepared(name, name, 160, 120, "") for name in NAMES]


def model_of(eyes, focal_factor: float = 1.0) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    for index, eye in enumerate(eyes, start=1):
        params = [*(focal_factor * np.array(eye.focal)), *eye.centre]
        camera = pycolmap.Camera(model="PINHOLE", width=eye.size[0], height=eye.size[1], params=params, camera_id=index)
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=f"{index - 1}.png", camera_id=index, image_id=index)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.column_stack([eye.R, eye.t])))
    return model


def matches(first: int, second: int, count: int = 60, seen_as: int | None = None) -> MatchedPair:
    """Random points in both photographs; the second may show them as another camera would (the scene looks alike there)."""
    points = np.random.default_rng(first * 100 + second).uniform(-1, 1, (count, 3))
    other = EYES[second if seen_as is None else seen_as]
    return MatchedPair(first, second, (EYES[first].pixels(points), other.pixels(points)))


def test_true_matches_are_explained_and_others_are_not() -> None:
    model = model_of(EYES)
    images = [model.images[index + 1] for index in range(8)]
    assert explained_share(images[0], images[1], matches(0, 1)) == 1
    assert explained_share(images[0], images[4], matches(0, 4, seen_as=1)) < 0.5


def test_a_folded_reconstruction_is_suspicious() -> None:
    """Every fifth pair saw a part that looks like another one."""
    honest = [matches(i, j) for i in range(8) for j in range(i + 1, 8)]
    found = check_consistency(model_of(EYES), PHOTOS, VerifiedMatches((100,) * 8, tuple(honest)))
    assert (found["contradicting"], found["doubtful"], found["support"], found["suspicious"]) == (0, [], 1.0, False)
    assert found["pairs"] >= 8
    mixed = [
        matches(pair.first, pair.second, seen_as=(pair.second + 3) % 8) if n % 5 == 0 else pair for n, pair in enumerate(honest)
    ]
    found = check_consistency(model_of(EYES), PHOTOS, VerifiedMatches((100,) * 8, tuple(mixed)))
    assert found["suspicious"]
    assert found["contradicting"] >= found["broken"] >= 1
    assert found["support"] == pytest.approx(22 / 28, abs=0.05)
    assert found["worst"][0]["photos"][0] in found["sentence"]
    assert found["worst"][0]["photos"][0] in NAMES


def test_one_broken_link_of_a_walk_is_suspicious() -> None:
    """Thirteen cameras agree with their neighbours, but the second half sits beside its place."""
    walk = ring(13, distortion=None)
    folded = [*walk[:7], *(replace(eye, t=eye.t + eye.R @ [1.5, 0, 0]) for eye in walk[7:])]
    photos = [Prepared(f"{index}.png", f"{index}.png", 160, 120, "") for index in range(13)]
    points = np.random.default_rng(0).uniform(-1, 1, (300, 3))
    pairs = []
    for i, j in [(i, i + step) for step in (1, 2) for i in range(13 - step)]:
        seen = points[: 300 if j - i == 1 else 100]
        pairs.append(MatchedPair(i, j, (walk[i].pixels(seen), walk[j].pixels(seen))))
    evidence = VerifiedMatches((100,) * 13, tuple(pairs))
    assert not check_consistency(model_of(walk), photos, evidence)["suspicious"]
    found = check_consistency(model_of(folded), photos, evidence)
    assert (found["broken"], found["suspicious"]) == (1, True)
    assert found["worst"][0]["photos"] == ["6.png", "7.png"]


def test_a_few_mistakes_in_a_scene_that_holds_something_twice_are_not_heard() -> None:
    """They are verified and contradict the poses, but with fewer matches than those that tell the truth."""
    honest = [matches(i, j, 200) for i in range(8) for j in range(i + 1, 8)]
    mixed = [
        matches(pair.first, pair.second, 60, seen_as=(pair.second + 3) % 8) if n % 5 == 0 else pair
        for n, pair in enumerate(honest)
    ]
    found = check_consistency(model_of(EYES), PHOTOS, VerifiedMatches((100,) * 8, tuple(mixed)))
    assert (found["contradicting"], found["suspicious"]) == (0, False)


def test_a_rich_mistake_between_photographs_from_far_apart_is_not_heard() -> None:
    """Its matches are more than those of most pairs, yet fewer than those of the photographs taken beside each."""
    counts = {1: 500, 2: 300}
    pairs = [matches(i, j, counts.get(j - i, 60)) for i in range(8) for j in range(i + 1, 8)]
    pairs = [
        matches(pair.first, pair.second, 200, seen_as=(pair.second + 3) % 8) if pair.second - pair.first == 4 else pair
        for pair in pairs
    ]
    found = check_consistency(model_of(EYES), PHOTOS, VerifiedMatches((100,) * 8, tuple(pairs)))
    assert found["support"] < 0.95
    assert not found["suspicious"]


def test_an_inverted_reconstruction_is_suspicious() -> None:
    """Centres reflected through the origin under the same rotations: each epipolar line stays, and all points lie behind."""
    inverted = [replace(eye, t=-eye.t) for eye in EYES]
    pairs = tuple(matches(i, j) for i in range(8) for j in range(i + 1, 8))
    for pair in pairs:
        first, second = inverted[pair.first], inverted[pair.second]
        rotation = second.R @ first.R.T
        planes = [(points - eye.centre) / eye.focal for eye, points in zip((first, second), pair.points, strict=True)]
        assert sampson(rotation, second.t - rotation @ first.t, *planes).max() < 1e-9
    found = check_consistency(model_of(inverted), PHOTOS, VerifiedMatches((100,) * 8, pairs))
    assert found["suspicious"]
    assert len(found["doubtful"]) == 8


def test_rays_meet_under_their_angle() -> None:
    """A point straight ahead between two parallel cameras."""
    baseline, depth = 0.5, 2.0
    first, second = np.array([[baseline / 2 / depth, 0]]), np.array([[-baseline / 2 / depth, 0]])
    shift = np.array([-baseline, 0, 0])
    expected = 2 * np.arctan(baseline / 2 / depth)
    assert parallax(np.eye(3), shift, first, second) == pytest.approx([expected])
    assert parallax(np.eye(3), -shift, first, second) == pytest.approx([-expected])


def test_impossible_cameras_are_named() -> None:
    assert implausible_parameters(model_of(EYES)) == []
    assert "focal length is 20" in implausible_parameters(model_of(EYES, 20 * 160 / 152.5))[0]
    radial = {
        strength: pycolmap.Camera(model="SIMPLE_RADIAL", width=100, height=100, params=[100, 50, 50, strength])
        for strength in (-0.3, 0.3, -1)
    }
    # The radius r (1 + k r²) falls from r² = -1 / 3 k on; the corner is at r² = 1/2.
    assert [is_folded(camera) for camera in radial.values()] == [False, False, True]
    model, eye = model_of(EYES), EYES[0]
    track = pycolmap.Track()
    for image in (1, 2):
        model.images[image].points2D = pycolmap.Point2DList([pycolmap.Point2D([80.0, 60.0])])
        track.add_element(image, 0)
    model.add_point3D(eye.cam_to_world[:3, 3] + 1e4 * eye.R[2], track)
    assert "stand within 0.1 %" in implausible_parameters(model)[0]


def test_weak_pairs_and_photographs_without_a_pose_are_no_witnesses() -> None:
    evidence = VerifiedMatches((100,) * 8, (matches(0, 4, MATCHES - 1, seen_as=1), matches(0, 7, seen_as=2)))
    found = check_consistency(model_of(EYES[:7]), PHOTOS, evidence)
    assert (found["pairs"], found["suspicious"]) == (0, False)


def test_distance_is_the_smallest_correction() -> None:
    """For a sideways step the epipolar lines are rows, and half of a difference in height is corrected in each picture."""
    first = np.array([[0.1, 0.2], [0.0, -0.3]])
    second = first + np.array([[0.05, 0.0], [0.07, 0.01]])
    distance = sampson(np.eye(3), np.array([2.0, 0, 0]), first, second)
    np.testing.assert_allclose(distance, [0, 0.01 / np.sqrt(2)], atol=1e-12)


def test_a_turn_on_the_spot_contradicts_nothing() -> None:
    assert sampson(np.eye(3), np.zeros(3), np.ones((3, 2)), np.ones((3, 2)) * 1.1) == pytest.approx(np.zeros(3))
