"""Points to start from: SfM on known poses against a plane known exactly; a degraded scene holds nothing of what it lacks."""

from __future__ import annotations

import dataclasses
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from invgraphics.core import Bounds, Camera, Points, Scene, View
from invgraphics.errors import InputError
from invgraphics.scenes.degrade import ENOUGH_POINTS, TrainingData, degrade
from invgraphics.scenes.photos import triangulate as sfm

SIZE, CAMERAS = 128, 6


def textured_plane() -> np.ndarray:
    """A blotchy texture, equally rough at several scales."""
    from scipy.ndimage import zoom

    rng = np.random.default_rng(0)
    layers = [zoom(rng.random((n, n, 3)), (256 / n, 256 / n, 1), order=1) for n in (12, 24, 48)]
    texture = sum(layers) / len(layers)
    return (texture - texture.min()) / (texture.max() - texture.min())


def plane_view(index: int, texture: np.ndarray) -> View:
    """The plane z = 0, [-1, 1]², seen from above by a camera that looks at its middle: each pixel's ray meets it once."""
    angle = 2 * np.pi * index / CAMERAS
    eye = np.array([0.5 * np.cos(angle), 0.5 * np.sin(angle), 2.5])
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    camera = Camera(
        cam_to_world=torch.from_numpy(pose),
        focal=torch.tensor([180.0, 180.0], dtype=torch.float64),
        principal_point=torch.tensor([SIZE / 2, SIZE / 2], dtype=torch.float64),
        width=SIZE,
        height=SIZE,
    )
    y, x = np.mgrid[0:SIZE, 0:SIZE] + 0.5
    ray = np.stack([(x - SIZE / 2) / 180, (y - SIZE / 2) / 180, np.ones_like(x)], axis=-1) @ pose[:3, :3].T
    hit = eye - ray * (eye[2] / ray[..., 2:])
    place = ((hit[..., :2] + 1) * 128).clip(0, 255).astype(int)
    image = (255 * texture[place[..., 1], place[..., 0]]).round().astype(np.uint8)
    return View(camera, torch.from_numpy(image), f"v{index}")


@pytest.fixture(scope="module")
def plane() -> Scene:
    texture = textured_plane()
    views = tuple(plane_view(index, texture) for index in range(CAMERAS))
    return Scene(
        name="plane",
        train=views,
        test=(replace(views[0], camera=views[0].camera.moved(views[0].camera.cam_to_world.clone() + 0)),),
        background=torch.zeros(3),
        bounds=Bounds(torch.full((3,), -1.2), torch.full((3,), 1.2)),
        points=Points(torch.rand(500, 3), torch.rand(500, 3)),
    )


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("INVGRAPHICS_CACHE", str(tmp_path))


def test_sfm_points_lie_on_the_plane(plane: Scene, capfd: pytest.CaptureFixture[str]) -> None:
    points = sfm.triangulate(plane).points
    assert capfd.readouterr() == ("", "")  # COLMAP accounts for every photograph and pair
    assert len(points) > 50
    assert float(points.position[:, 2].abs().median()) < 0.02 and float(points.position[:, 2].abs().max()) < 0.2
    place = ((points.position[:, :2].numpy() + 1) * 128).clip(0, 255).astype(int)
    expected = textured_plane()[place[:, 1], place[:, 0]]
    assert float(np.abs(points.rgb.numpy() - expected).mean()) < 0.1


@pytest.mark.parametrize("blank", [0, 3])
def test_tracks_name_the_photographs_that_show_a_point(plane: Scene, blank: int) -> None:
    """A blank photograph shows none; all others some, within their pictures; two or more show each point."""
    train = tuple(replace(v, image=torch.full_like(v.image, 99)) if i == blank else v for i, v in enumerate(plane.train))
    found = sfm.triangulate(plane.with_views(train=train))
    assert [len(rows) > 50 for rows in found.observed] == [index != blank for index in range(CAMERAS)]
    for view, rows in zip(train, found.observed, strict=True):
        place, depth = view.camera.project(found.points.position[rows].double())
        assert bool(((place >= 0) & (place < SIZE)).all()) and bool((depth > 0).all())
        assert torch.equal(rows, rows.unique())
    counts = torch.cat(found.observed).bincount(minlength=len(found.points))
    assert int(counts.min()) >= 2
    made = degrade(plane.with_views(train=train), TrainingData(init="sfm"), 0)
    for view, rows in zip(made.train, found.observed, strict=True):
        assert view.landmarks is not None and torch.equal(view.landmarks, found.points.position[rows])


def test_nothing_is_found_where_masks_are_false(plane: Scene) -> None:
    """The left half of each picture: no point has a track there; the others are the plane's."""
    mask = torch.arange(SIZE).expand(SIZE, SIZE) >= SIZE // 2
    train = tuple(replace(view, mask=mask) for view in plane.train)
    found = sfm.triangulated(plane.with_views(train=train))
    assert 20 < len(found.points) < len(sfm.triangulated(plane).points), "masks are part of what points are cached by"
    for view, rows in zip(train, found.observed, strict=True):
        place, _ = view.camera.project(found.points.position[rows].double())
        assert bool((place[:, 0] > SIZE // 2 - 2).all())


def tensors(value: object, path: str = "") -> dict[str, torch.Tensor]:
    """Every tensor in a scene, by its path."""
    if isinstance(value, torch.Tensor):
        return {path: value}
    if isinstance(value, tuple | list):
        return {key: found for i, one in enumerate(value) for key, found in tensors(one, f"{path}[{i}]").items()}
    if dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value)]
        return {key: one for name in names for key, one in tensors(getattr(value, name), f"{path}.{name}").items()}
    return {}


def with_landmarks(scene: Scene) -> Scene:
    """The scene, with some of its points as landmarks of every view."""
    assert scene.points is not None
    landmarks = scene.points.position[:40]
    return scene.with_views(train=tuple(replace(view, landmarks=landmarks) for view in scene.train))


@pytest.mark.parametrize("init", ["scene", "sfm", "random"])
def test_nothing_in_a_degraded_scene_depends_on_withheld_photographs(plane: Scene, init: str) -> None:
    """Two scenes that differ in the photographs that are left out, and in the points made from all of them."""
    data = TrainingData(train_views=4, photo_noise=0.02, init=init)  # pyright: ignore[reportArgumentType]
    kept = {view.name for view in degrade(plane, replace(data, init="random"), 0).train}
    hidden = tuple(
        view if view.name in kept else replace(view, image=255 - view.image, depth=torch.ones(SIZE, SIZE))
        for view in plane.train
    )
    other = replace(plane, train=hidden, points=Points(torch.rand(300, 3), torch.rand(300, 3)))
    first, second = (tensors(degrade(with_landmarks(scene), data, 0)) for scene in (plane, other))
    assert first.keys() == second.keys()
    assert [path for path in first if not torch.equal(first[path], second[path])] == []
    assert (".points.position" in first) == (init != "random")


def test_the_start_is_declared(plane: Scene) -> None:
    assert degrade(plane, TrainingData(), 0) is plane
    assert degrade(plane, TrainingData(init="random"), 0).points is None
    made = degrade(plane, TrainingData(init="sfm"), 0)
    found = sfm.triangulated(plane).points
    assert made.points is not None and torch.equal(made.points.position[: len(found)], found.position)
    rest = made.points.position[len(found) :]
    assert len(rest) == ENOUGH_POINTS and bool(((rest >= plane.bounds.lo) & (rest <= plane.bounds.hi)).all())
    words = f"{len(found)} from SfM on the training photographs as they are here, and 5,000 random ones"
    assert made.notes["points"] == words
    grey = tuple(replace(view, image=torch.full_like(view.image, 99)) for view in plane.train)
    empty = degrade(replace(plane, train=grey), TrainingData(init="sfm"), 0)
    assert empty.points is None and "too few: a random start" in empty.notes["points"]


def test_photographs_in_which_nothing_matches_start_inside_their_silhouettes(plane: Scene) -> None:
    alpha = torch.zeros(SIZE, SIZE)
    alpha[SIZE // 4 : -SIZE // 4, SIZE // 4 : -SIZE // 4] = 1
    grey = tuple(replace(view, image=torch.full_like(view.image, 99), alpha=alpha) for view in plane.train)
    made = degrade(replace(plane, train=grey), TrainingData(init="sfm"), 0)
    assert made.points is not None and 0 < len(made.points) <= ENOUGH_POINTS
    assert "too few: " in made.notes["points"] and "inside the photographs' silhouettes" in made.notes["points"]
    for view in grey:
        place, z = view.camera.project(made.points.position)
        shown = (z > 0) & (place >= 0).all(dim=1) & (place < SIZE).all(dim=1)
        inside = (place - SIZE / 2).abs().amax(dim=1) <= SIZE / 4 + 1
        assert bool((inside | ~shown).all())
    nothing = tuple(replace(view, alpha=torch.zeros(SIZE, SIZE)) for view in grey)
    seen = Bounds(torch.full((3,), -0.05), torch.full((3,), 0.05))
    lost = degrade(replace(plane, train=nothing, bounds=seen), TrainingData(init="sfm"), 0)
    assert lost.points is None and "too few: a random start" in lost.notes["points"]


def test_points_are_cached_by_what_they_are_made_of(plane: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    first = sfm.triangulated(plane)
    monkeypatch.setattr(sfm, "triangulate", lambda scene: pytest.fail("computed again"))
    again = sfm.triangulated(replace(plane, points=None))
    assert torch.equal(first.points.position, again.points.position) and torch.equal(first.points.rgb, again.points.rgb)
    assert len(first.observed) == len(again.observed) == CAMERAS
    assert all(torch.equal(*rows) for rows in zip(first.observed, again.observed, strict=True))


def test_a_triangulation_of_many_photographs_is_announced_once(
    plane: Scene, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    found = sfm.Triangulated.of(Points(torch.rand(9, 3), torch.rand(9, 3)), torch.zeros(2, 0, dtype=torch.int64), CAMERAS)
    monkeypatch.setattr(sfm, "triangulate", lambda scene: found)
    sfm.triangulated(plane)
    assert capsys.readouterr().err == ""
    next(tmp_path.rglob("points/*.npz")).unlink()
    monkeypatch.setattr(sfm, "MANY", CAMERAS)
    for expected in (
        f"plane: finding points in {CAMERAS} training photographs (structure from motion); cached afterwards.\n",
        "",
    ):
        sfm.triangulated(plane)
        assert capsys.readouterr().err == expected


def test_points_are_made_where_the_cache_cannot_be_written(
    plane: Scene, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """They were lost where only their file could not be written, and nothing was announced where its folder could not."""
    found = sfm.Triangulated.of(Points(torch.rand(9, 3), torch.rand(9, 3)), torch.zeros(2, 0, dtype=torch.int64), CAMERAS)
    monkeypatch.setattr(sfm, "triangulate", lambda scene: found)
    monkeypatch.setattr(sfm, "MANY", CAMERAS)

    def full(*_: object) -> None:
        raise InputError("'points.npz' cannot be written: the disk is full.")

    with monkeypatch.context() as patch:
        patch.setattr(sfm, "write_arrays", full)
        assert sfm.triangulated(plane) is found
    assert capsys.readouterr().err.endswith("The points are not cached: 'points.npz' cannot be written: the disk is full.\n")
    for name, owner in (("root", sfm.cache), ("locked", sfm.locks)):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, lambda *_, **__: (_ for _ in ()).throw(PermissionError("permission denied")))
            assert sfm.triangulated(plane) is found
        assert "; not cached, as the cache cannot be written." in capsys.readouterr().err


def test_damaged_points_in_the_cache_are_made_again(plane: Scene, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = sfm.Triangulated.of(Points(torch.rand(9, 3), torch.rand(9, 3)), torch.zeros(2, 0, dtype=torch.int64), CAMERAS)
    monkeypatch.setattr(sfm, "triangulate", lambda scene: found)
    sfm.triangulated(plane)
    file = next(tmp_path.rglob("points/*.npz"))
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    assert sfm.triangulated(plane) is found
    monkeypatch.setattr(sfm, "triangulate", lambda scene: pytest.fail("computed again"))
    assert torch.equal(sfm.triangulated(plane).points.position, found.points.position)


def test_one_of_two_processes_makes_the_points(plane: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both did, and the second to finish could find its temporary file gone."""
    found = sfm.Triangulated.of(Points(torch.rand(9, 3), torch.rand(9, 3)), torch.zeros(2, 0, dtype=torch.int64), CAMERAS)
    calls: list[int] = []

    def slowly(scene: Scene) -> sfm.Triangulated:
        calls.append(threading.get_ident())
        time.sleep(0.3)
        return found

    monkeypatch.setattr(sfm, "triangulate", slowly)
    with ThreadPoolExecutor(2) as pool:  # locks are of threads, too
        results = list(pool.map(sfm.triangulated, [plane, plane]))
    assert len(calls) == 1
    assert all(torch.equal(result.points.position, found.points.position) for result in results)
