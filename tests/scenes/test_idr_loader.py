"""IDR's and NeuS's ``cameras*.npz``."""

from pathlib import Path

import numpy as np
import pytest
from dots import Eye, assert_dots_are_found, ring, save
from PIL import Image

from invgraphics.errors import InputError
from invgraphics.scenes.idr import Idr
from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.open import validate

SPHERE = np.array([[2.5, 0, 0, 0.1], [0, 2.5, 0, -0.2], [0, 0, 2.5, 0.3], [0, 0, 0, 1]])


def matrices(eyes: list[Eye]) -> dict[str, np.ndarray]:
    arrays = {}
    for index, eye in enumerate(eyes):
        # DTU's pixel coordinates: the first pixel's centre is (0, 0). The matrix is known up to its scale, sign included.
        K = np.array([[eye.focal[0], 0, eye.centre[0] - 0.5], [0, eye.focal[1], eye.centre[1] - 0.5], [0, 0, 1]])
        P = np.eye(4)
        P[:3] = K @ np.concatenate([eye.R, eye.t[:, None]], axis=1) * (-3.0 if index % 2 else 0.01)
        arrays |= {f"world_mat_{index}": P, f"scale_mat_{index}": SPHERE}
    return arrays


def write(path: Path, eyes: list[Eye], name: str = "cameras.npz", masks: bool = True) -> Path:
    for index, eye in enumerate(eyes):
        picture = eye.picture(with_alpha=True)
        save(picture[..., :3] if masks else eye.picture(), path / "image" / f"{index:06}.png")
        if masks:
            save(np.repeat(picture[..., 3:], 3, axis=2), path / "mask" / f"{index:03}.png")
    np.savez(path / name, **matrices(eyes))
    return path


@pytest.mark.parametrize("name", ["cameras.npz", "cameras_sphere.npz", "cameras_large.npz"])
def test_dots_are_where_the_cameras_say(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, ring(9), name)
    assert Idr().matches(path)
    scene = validate(Idr().load(path, SceneOptions()))
    assert_dots_are_found(scene)
    assert scene.has_alpha
    assert scene.bounds.space == "box"
    assert scene.bounds.hi.tolist() == [1, 1, 1]
    np.testing.assert_allclose(scene.world_from_local.numpy(), SPHERE, rtol=1e-6)
    camera = scene.train[0].camera
    np.testing.assert_allclose(camera.focal.numpy(), [150, 155], rtol=1e-5)
    np.testing.assert_allclose(camera.principal_point.numpy(), [83, 58], rtol=1e-5)
    world = SPHERE[:3, :3] @ camera.position.numpy() + SPHERE[:3, 3]
    np.testing.assert_allclose(world, ring(9)[1].cam_to_world[:3, 3], atol=1e-4)


def test_without_masks_the_surroundings_belong_to_the_scene(tmp_path: Path) -> None:
    scene = validate(Idr().load(write(tmp_path, ring(9), masks=False), SceneOptions()))
    assert scene.bounds.space == "contracted"
    assert not scene.has_alpha
    assert_dots_are_found(scene)


def test_bad_input_is_a_sentence(tmp_path: Path) -> None:
    path = write(tmp_path, ring(9))
    good = matrices(ring(9))

    def expect(sentence: str, **changes: np.ndarray | None) -> None:
        np.savez(path / "cameras.npz", **{key: value for key, value in (good | changes).items() if value is not None})
        with pytest.raises(InputError, match=sentence):
            Idr().load(path, SceneOptions())

    expect("has no 'world_mat_4'", world_mat_4=None)
    expect("'world_mat_4' of .* is not a finite 4x4", world_mat_4=np.full((4, 4), np.nan))
    expect("world_mat_4 is not a projection matrix", world_mat_4=np.zeros((4, 4)))
    expect("scale_mat_0 is not rigid", **{f"scale_mat_{i}": SPHERE * [[1, 2, 1, 1]] for i in range(9)})
    expect("scale_mat_3 that differs", scale_mat_3=SPHERE * 2)
    skew = np.eye(4)
    skew[0, 1] = 0.05
    expect("has skewed pixels", world_mat_2=skew @ good["world_mat_2"])
    np.savez(path / "cameras.npz", **good)
    (path / "cameras.npz").write_bytes(b"PK\x03\x04 junk")
    with pytest.raises(InputError, match=r"cameras\.npz cannot be read"):
        Idr().load(path, SceneOptions())
    (path / "mask" / "000.png").unlink()
    with pytest.raises(InputError, match=r"8 masks, .* has 9 pictures"):
        Idr().load(path, SceneOptions())


def test_pictures_that_were_resized_without_their_matrices_are_refused(tmp_path: Path) -> None:
    """The matrices hold no size: at half of it the principal point is at the pictures' end."""
    path = write(tmp_path, ring(9))
    for folder in ("image", "mask"):
        for file in (path / folder).iterdir():
            with Image.open(file) as picture:
                picture.resize((80, 60), Image.Resampling.BOX).save(file)
    with pytest.raises(InputError, match=r"lie at 1.04 of the pictures' width and 0.97 of their height: pictures were resized"):
        Idr().load(path, SceneOptions())
