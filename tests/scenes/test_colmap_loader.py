"""COLMAP models, written as text by hand and read back by the loader."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from dots import COLOURS, POINTS, Eye, assert_dots_are_found, ring, save
from PIL import Image
from scipy.spatial.transform import Rotation

from invgraphics.errors import InputError
from invgraphics.scenes.colmap import Colmap
from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.open import find_loader, selection_notes, validate


def radial(k: float):
    """COLMAP's SIMPLE_RADIAL."""

    def distort(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        scale = 1 + k * (x * x + y * y)
        return x * scale, y * scale

    return distort


def write(path: Path, eyes: list[Eye], models: list[str], place: str = "sparse/0") -> Path:
    """One camera per image."""
    folder = path / place
    folder.mkdir(parents=True, exist_ok=True)
    cameras, images = [], []
    for index, (eye, model) in enumerate(zip(eyes, models, strict=True)):
        save(eye.picture(), path / "images" / f"{index:02}.png")
        cameras.append(f"{index + 1} {model}")
        x, y, z, w = Rotation.from_matrix(eye.R).as_quat()
        images.append(f"{index + 1} {w} {x} {y} {z} {' '.join(map(str, eye.t))} {index + 1} {index:02}.png\n")
    (folder / "cameras.txt").write_text("\n".join(cameras) + "\n")
    (folder / "images.txt").write_text("\n".join(images) + "\n")
    points = [
        f"{i + 1} {' '.join(map(str, point))} {' '.join(str(round(255 * c)) for c in colour)} 0.1"
        for i, (point, colour) in enumerate(zip(POINTS, COLOURS, strict=True))
    ]
    (folder / "points3D.txt").write_text("\n".join(points) + "\n")
    return path


def mixed(path: Path, place: str = "sparse/0") -> Path:
    """Every photograph through a lens of its own, of three models."""
    eyes, models = [], []
    for index, eye in enumerate(ring(9)):
        k = (-0.4, 0.0, 0.4)[index % 3] * (1 + index / 10)
        if index % 3 == 1:
            lens, model = eye, "PINHOLE 160 120 150 155 83 58"
        else:
            lens = Eye(eye.R, eye.t, (150.0, 150.0), (83.0, 58.0), distortion=radial(k))
            model = f"SIMPLE_RADIAL 160 120 150 83 58 {k}" if index % 3 == 0 else f"RADIAL 160 120 150 83 58 {k} 0"
        eyes.append(lens)
        models.append(model)
    return write(path, eyes, models, place)


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0"])
def test_dots_are_where_the_cameras_say(tmp_path: Path, place: str) -> None:
    path = mixed(tmp_path, place)
    assert Colmap().matches(path)
    scene = validate(Colmap().load(path, SceneOptions()))
    assert [view.name for view in scene.test] == ["00.png", "08.png"]
    assert_dots_are_found(scene)
    assert "RADIAL, SIMPLE_RADIAL" in scene.notes["undistortion"]


def test_names_with_spaces_are_whole(tmp_path: Path) -> None:
    """COLMAP's own reader of text cuts them off at the first space."""
    mixed(tmp_path)
    text = tmp_path / "sparse/0/images.txt"
    content = text.read_text()
    for name, spaced in (("00.png", "IMG 0 a.png"), ("01.png", "IMG 0 b.png"), ("08.png", "IMG 8.png")):
        content = content.replace(name, spaced)
        (tmp_path / "images" / name).rename(tmp_path / "images" / spaced)
    text.write_text(content)
    scene = validate(Colmap().load(tmp_path, SceneOptions()))
    names = {view.name for view in (*scene.train, *scene.test)}
    assert names == {"IMG 0 a.png", "IMG 0 b.png", "IMG 8.png", *(f"{index:02}.png" for index in range(2, 8))}
    assert_dots_are_found(scene)


def test_a_camera_without_a_focal_length_is_refused(tmp_path: Path) -> None:
    """Asked for its focal length, pycolmap would end the process."""
    write(tmp_path, ring(2), ["EQUIRECTANGULAR 160 120 160 120"] * 2)
    with pytest.raises(InputError, match=r"EQUIRECTANGULAR .* cannot be made a pinhole"):
        Colmap().load(tmp_path, SceneOptions())


def test_two_photographs_are_a_scene(tmp_path: Path) -> None:
    """Opposite cameras on an axis: one of their coordinates differs by rounding only."""
    eye = ring(1)[0]
    turns = [Rotation.from_euler("z", angle).as_matrix() for angle in (0.3, 0.3 - np.pi)]
    eyes = [replace(eye, R=eye.R @ turn, t=eye.t * (1 - 0.2 * index)) for index, turn in enumerate(turns)]
    scene = validate(Colmap().load(write(tmp_path, eyes, ["PINHOLE 160 120 150 155 83 58"] * 2), SceneOptions()))
    assert (len(scene.train), len(scene.test)) == (1, 1)
    assert_dots_are_found(scene)


def test_points_are_kept_in_the_local_frame(tmp_path: Path) -> None:
    scene = Colmap().load(mixed(tmp_path), SceneOptions())
    assert scene.points is not None
    world = scene.points.position @ scene.world_from_local[:3, :3].T + scene.world_from_local[:3, 3]
    order = [int((world - torch.from_numpy(point)).norm(dim=1).argmin()) for point in POINTS]
    np.testing.assert_allclose(world[order].numpy(), POINTS, atol=1e-5)
    np.testing.assert_allclose(scene.points.rgb[order].numpy(), COLOURS, atol=0.01)


def test_missing_photographs_are_reported(tmp_path: Path) -> None:
    mixed(tmp_path)
    (tmp_path / "images" / "03.png").unlink()
    scene = Colmap().load(tmp_path, SceneOptions())
    assert scene.notes["missing"] == "1 of 9 listed files are absent: 03.png"
    assert len(scene.train) + len(scene.test) == 8


def test_bad_models_are_sentences(tmp_path: Path) -> None:
    path = write(tmp_path, ring(2), ["PINHOLE 160 120 150 155 83 58", "PINHOLE 160 120 -150 155 83 58"])
    with pytest.raises(InputError, match=r"camera of image '01\.png' has parameters"):
        Colmap().load(path, SceneOptions())
    (path / "sparse/0/points3D.txt").unlink()
    with pytest.raises(InputError, match=r"COLMAP model .* cannot be read"):
        Colmap().load(path, SceneOptions())
    (path / "sparse/0/cameras.txt").unlink()
    with pytest.raises(InputError, match="has no COLMAP model"):
        Colmap().load(path, SceneOptions())


def test_no_photographs_is_a_sentence(tmp_path: Path) -> None:
    mixed(tmp_path)
    (tmp_path / "images").rename(tmp_path / "pictures")
    with pytest.raises(InputError, match="None of the 9 pictures"):
        Colmap().load(tmp_path, SceneOptions())


def workspace(path: Path) -> Path:
    """COLMAP's usual folders: a distorted model whose photographs are gone, and the undistorted one in ``dense/0``."""
    root = mixed(path / "statue")
    pinholes = ["PINHOLE 160 120 150 155 83 58"] * 9
    write(root / "dense" / "0", ring(9), pinholes, "sparse")
    for photo in (root / "images").iterdir():
        photo.unlink()
    return root


@pytest.mark.parametrize("given", [".", "dense", "dense/0", "dense/0/sparse", "dense/0/images"])
def test_workspace_is_found_from_any_of_its_folders(tmp_path: Path, given: str) -> None:
    path = workspace(tmp_path) / given
    scene = validate(find_loader(path).load(path, SceneOptions()))
    assert scene.name == "statue"
    assert len(scene.train) + len(scene.test) == 9 and "undistortion" not in scene.notes
    assert_dots_are_found(scene)
    said = scene.notes.get("model", "")
    assert selection_notes(scene) == (f"\n  model: {said}" if said else "")
    assert (given == ".") == ("dense/0/sparse (9 photographs)" in said and "sparse/0 (0 of 9" in said)


@pytest.mark.parametrize("number", ["1", "10"])
@pytest.mark.parametrize("given", [".", "sparse", "sparse/0", "images"])
def test_largest_of_several_models_is_taken(tmp_path: Path, given: str, number: str) -> None:
    """COLMAP numbers models in the order in which it began them; the parts do not share a frame."""
    root = mixed(tmp_path / "garden")
    (root / "sparse" / "0").rename(root / "sparse" / number)
    keep = [path.read_bytes() for path in sorted((root / "images").iterdir())]
    write(root, ring(3), ["PINHOLE 160 120 150 155 83 58"] * 3)
    for index, photo in enumerate(sorted((root / "images").iterdir())):
        photo.write_bytes(keep[index])
    scene = find_loader(root / given).load(root / given, SceneOptions())
    assert scene.name == "garden"
    assert len(scene.train) + len(scene.test) == (3 if given == "sparse/0" else 9)
    if given == ".":
        assert scene.notes["model"] == (
            f"sparse/{number} (9 photographs) has the most photographs; not taken: sparse/0 (3 photographs)"
        )


def reduced(root: Path, width: int, height: int) -> None:
    """Copies of the photographs at another size, beside them."""
    (root / "images_4").mkdir()
    for photo in (root / "images").iterdir():
        Image.open(photo).resize((width, height), Image.Resampling.BOX).save(root / "images_4" / photo.name)


@pytest.mark.parametrize("given", [".", "images", "images_4"])
def test_the_folder_of_photographs_that_is_named_is_taken(tmp_path: Path, given: str) -> None:
    root = mixed(tmp_path / "garden")
    reduced(root, 80, 60)
    scene = validate(find_loader(root / given).load(root / given, SceneOptions()))
    assert scene.name == "garden" and len(scene.train) + len(scene.test) == 9
    assert scene.train[0].camera.width == (80 if given == "images_4" else 160)
    assert_dots_are_found(scene)


def test_another_model_is_not_given_the_named_photographs(tmp_path: Path) -> None:
    """An undistorted model has its own; of the models that have the named ones, that with most of them is taken."""
    root = workspace(tmp_path)
    write(root, ring(9)[:4], ["PINHOLE 160 120 150 155 83 58"] * 4)  # fewer than the undistorted model has
    scene = Colmap().load(root / "images", SceneOptions())
    assert len(scene.train) + len(scene.test) == 4
    taken, left = scene.notes["model"].split("; not taken: ")
    assert taken.endswith("sparse/0 (4 photographs) has those that were asked for") and "dense/0/sparse (9" in left
    assert len(Colmap().load(root, SceneOptions()).train) == 7


@pytest.mark.parametrize("place", ["images", "sparse/0/images", "input", "sparse/images", "."])
def test_photographs_lie_beside_the_model_or_below(tmp_path: Path, place: str) -> None:
    root = mixed(tmp_path / "garden")
    (root / "images").rename(root / "photos")
    (root / place).mkdir(exist_ok=True)
    for photo in (root / "photos").iterdir():
        photo.rename(root / place / photo.name)
    scene = Colmap().load(root, SceneOptions())
    assert scene.name == "garden" and len(scene.train) + len(scene.test) == 9
    assert_dots_are_found(scene)


@pytest.mark.parametrize("given", [".", "images"])
def test_a_link_to_another_workspace_s_model_takes_the_photographs_beside_it(tmp_path: Path, given: str) -> None:
    root = mixed(tmp_path / "garden")
    variant = tmp_path / "darker"
    (variant / "images").mkdir(parents=True)
    for photo in (root / "images").iterdir():
        Image.open(photo).point(lambda value: value // 2).save(variant / "images" / photo.name)
    (variant / "sparse").symlink_to(root / "sparse", target_is_directory=True)
    full, half = (Colmap().load(path, SceneOptions()).train[0].image.float() for path in (root, variant / given))
    assert float(half.mean()) == pytest.approx(float(full.mean()) / 2, rel=0.05)


def test_photographs_may_be_a_link(tmp_path: Path) -> None:
    root = mixed(tmp_path / "garden")
    (root / "images").rename(tmp_path / "DCIM")
    (root / "images").symlink_to(tmp_path / "DCIM", target_is_directory=True)
    assert_dots_are_found(Colmap().load(root / "images", SceneOptions()))


def test_the_fullest_folder_of_photographs_is_taken(tmp_path: Path) -> None:
    root = mixed(tmp_path / "garden")
    (root / "images").rename(root / "input")
    (root / "images").mkdir()
    shutil.copy(root / "input" / "04.png", root / "images" / "04.png")
    scene = Colmap().load(root, SceneOptions())
    assert len(scene.train) + len(scene.test) == 9
    assert_dots_are_found(scene)


def test_undistorted_model_never_takes_the_distorted_photographs(tmp_path: Path) -> None:
    root = workspace(tmp_path)
    (root / "dense" / "0" / "images").rename(root / "elsewhere")
    for photo in (root / "elsewhere").iterdir():
        photo.rename(root / "images" / photo.name)
    with pytest.raises(InputError, match=r"None of the 9 pictures.*\n.*dense/0/images"):
        Colmap().load(root / "dense" / "0", SceneOptions())


@pytest.mark.data
@pytest.mark.parametrize("given", [".", "dense/0", "dense/0/sparse"])
def test_statue_opens_from_its_root(data, given: str) -> None:
    path = data("colmap_statue") / given
    scene = validate(find_loader(path).load(path, SceneOptions(size=100, train_views=3, test_views=1)))
    assert scene.name == "colmap_statue"
    assert scene.notes["train_views"] == "3 of 20, evenly spaced"


@pytest.mark.data
def test_beer_points_project_onto_their_observations(data) -> None:
    """SfM's own measurements, straightened by COLMAP's lens, against our local cameras and points; and the colours there."""
    import pycolmap

    path = data("colmap_beer")
    scene = validate(Colmap().load(path, SceneOptions(train_views=4, test_views=2)))
    assert scene.points is not None
    model = pycolmap.Reconstruction(str(path / "sparse/0"))
    local = np.linalg.inv(scene.world_from_local.double().numpy())
    by_name = {image.name: image for image in model.images.values()}
    distances, differences, shuffled = [], [], []
    for view in scene.train + scene.test:
        image = by_name[view.name]
        observed = [point for point in image.points2D if point.has_point3D()]
        world = np.array([model.points3D[point.point3D_id].xyz for point in observed])
        rgb = np.array([model.points3D[point.point3D_id].color for point in observed]) / 255
        projected, _ = view.camera.project(torch.from_numpy(world @ local[:3, :3].T + local[:3, 3]).float())
        plane = image.camera.cam_from_img(np.array([point.xy for point in observed]))
        straight = plane * view.camera.focal.numpy() + view.camera.principal_point.numpy()
        distances.append(np.linalg.norm(projected.numpy() - straight, axis=1))
        x, y = projected.long().T
        inside = (x >= 0) & (y >= 0) & (x < view.camera.width) & (y < view.camera.height)
        assert float(inside.float().mean()) > 0.9
        picture = view.colour()[y[inside], x[inside]].numpy()
        differences.append(np.abs(picture - rgb[inside]).mean(1))
        shuffled.append(np.abs(picture - rgb[inside][::-1]).mean(1))
    assert np.median(np.concatenate(distances)) < 1.5
    assert np.median(np.concatenate(differences)) < 0.5 * np.median(np.concatenate(shuffled))


def test_photographs_of_other_names_in_a_named_folder_are_taken_in_order(tmp_path: Path) -> None:
    """LLFF's scaled copies are called image000.png, those of the model IMG_4026.JPG."""
    root = mixed(tmp_path / "garden")
    reduced(root, 80, 60)
    for index, photo in enumerate(sorted((root / "images_4").iterdir())):
        photo.rename(root / "images_4" / f"image{index:03}.png")
    scene = validate(find_loader(root / "images_4").load(root / "images_4", SceneOptions()))
    assert scene.train[0].camera.width == 80 and len(scene.train) + len(scene.test) == 9
    assert_dots_are_found(scene)
    (root / "images_4" / "image003.png").unlink()
    with pytest.raises(InputError, match=r"images_4 has none of the 9 photographs that .* lists, and 8 of other names"):
        find_loader(root / "images_4").load(root / "images_4", SceneOptions())


def test_a_model_of_any_name_below_sparse_has_the_workspace_s_photographs(tmp_path: Path) -> None:
    root = mixed(tmp_path / "garden")
    (root / "sparse" / "0").rename(root / "sparse" / "aligned")
    for given in (root, root / "sparse" / "aligned"):
        scene = validate(find_loader(given).load(given, SceneOptions()))
        assert scene.name == "garden" and len(scene.train) + len(scene.test) == 9
