"""Masks of photographs: which pixels count, in the files that nerfstudio and COLMAP write."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from dots import ring, save
from PIL import Image
from test_nerfstudio_loader import DISTORTED, edit, write

from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.nerfstudio import Nerfstudio
from invgraphics.scenes.open import validate
from invgraphics.scenes.pictures.images import Photo
from invgraphics.scenes.pictures.masks import read_mask, with_masks_beside


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Of photographs whose left quarter does not count."""
    write(tmp_path, ring(9), {})
    mask = np.full((120, 160), 255, np.uint8)
    mask[:, :40] = 0
    save(mask, tmp_path / "masks" / "left.png")

    def add(table: dict) -> None:
        for frame in table["frames"]:
            frame["mask_path"] = "masks/left.png"

    edit(tmp_path, add)
    return tmp_path


def load(folder: Path, **options: int) -> Scene:
    return validate(Nerfstudio().load(folder, SceneOptions(**options)))


def test_dark_pixels_do_not_count(folder: Path) -> None:
    scene = load(folder)
    for view in (*scene.train, *scene.test):
        assert view.mask is not None
        assert not view.mask[:, :40].any()
        assert view.mask[:, 40:].all()
    assert scene.notes["masks"] == "9 of 9 photographs have one: dark pixels do not count"


def test_a_resized_pixel_counts_if_all_of_it_does(folder: Path) -> None:
    """160 to 100 pixels: column 24 is that of 38.4 to 40, column 25 that of 40 to 41.6."""
    mask = load(folder, size=100).train[0].mask
    assert mask is not None
    assert torch.equal(mask.all(dim=0), torch.arange(100) >= 25)


def test_a_view_whose_mask_leaves_no_pixel_of_the_size_is_left_out(folder: Path) -> None:
    """A sliver of one column, which counts at full size: no pixel of a picture of a quarter of it lies inside."""
    sliver = np.zeros((120, 160), np.uint8)
    sliver[:, 77] = 255
    save(sliver, folder / "masks" / "sliver.png")
    edit(folder, lambda table: [frame.update(mask_path="masks/sliver.png") for frame in table["frames"][:2]])
    assert len(load(folder).train) == 7
    small = load(folder, size=40)
    assert [view.name for view in small.train] == [f"images/{index:04}.png" for index in range(1, 7)]
    assert small.notes["masked_views"] == "2 without a valid pixel are left out: images/0007.png, images/0008.png"
    edit(folder, lambda table: [frame.update(mask_path="masks/sliver.png") for frame in table["frames"]])
    with pytest.raises(InputError, match="leave no pixel of any training view"):
        load(folder, size=40)


def test_masks_are_undistorted_with_their_photographs(folder: Path) -> None:
    straight = load(folder).train[0].mask
    edit(folder, lambda table: table.update(DISTORTED))
    bent = load(folder).train[0].mask
    assert straight is not None
    assert bent is not None
    assert not torch.equal(straight, bent)
    edge = bent.float().argmax(dim=1)
    assert edge[60] != edge[2], "the edge is a curve"


def test_masks_of_other_sizes_and_values_are_read(folder: Path) -> None:
    small = np.ones((60, 80), np.uint8)
    small[:, :20] = 0
    save(small, folder / "masks" / "left.png")
    mask = load(folder).train[0].mask
    assert mask is not None
    assert torch.equal(mask.all(dim=0), torch.arange(160) >= 40)


def test_a_larger_mask_masks_all_that_it_touches(tmp_path: Path) -> None:
    """Masks at full size beside photographs at a quarter of it; a smaller mask gives its nearest pixel."""
    fine = np.full((16, 16), 255, np.uint8)
    fine[:, 1:4] = 0
    fine[:, 8] = 0
    save(fine, tmp_path / "fine.png")
    assert (read_mask(tmp_path / "fine.png", 4, 4)[0, :, 0] == 255).tolist() == [False, True, False, True]
    coarse = np.full((2, 3), 255, np.uint8)
    coarse[:, 1] = 0
    save(coarse, tmp_path / "coarse.png")
    assert (read_mask(tmp_path / "coarse.png", 5, 3)[0, :, 0] == 255).tolist() == [True, True, False, True, True]


def test_colmap_s_names_of_masks(tmp_path: Path) -> None:
    names = ["a.jpg", "sub/b.jpg", "c.jpg"]
    for path in ("masks/a.jpg.png", "masks/sub/b.png"):
        save(np.zeros((2, 2), np.uint8), tmp_path / path)
    photos = [Photo(tmp_path / "images" / name, None, name) for name in names]  # pyright: ignore[reportArgumentType]
    found = [photo.mask for photo in with_masks_beside(photos, tmp_path / "images")]
    assert found == [tmp_path / "masks/a.jpg.png", tmp_path / "masks/sub/b.png", None]


def test_masks_beside_photographs_that_lie_in_the_workspace_itself(tmp_path: Path) -> None:
    """Names that begin with their folder, and masks that do so too or not; a neighbour's masks are not taken."""
    names = ["images/a.jpg", "images/b.jpg", "c.jpg"]
    for path in ("set/masks/images/a.jpg.png", "set/masks/b.png", "set/masks/c.png", "masks/c.png"):
        save(np.zeros((2, 2), np.uint8), tmp_path / path)
    photos = [Photo(tmp_path / "set" / name, None, name) for name in names]  # pyright: ignore[reportArgumentType]
    found = [photo.mask for photo in with_masks_beside(photos, tmp_path / "set")]
    assert found == [tmp_path / "set/masks" / name for name in ("images/a.jpg.png", "b.png", "c.png")]


@pytest.mark.parametrize(
    ("mask", "sentence"),
    [
        (np.zeros((120, 160), np.uint8), "is black: no pixel of its photograph counts"),
        (np.ones((160, 120), np.uint8), "has 120x160 pixels, its photograph has 160x120"),
        (None, "does not exist"),
    ],
)
def test_bad_masks_are_sentences(folder: Path, mask: np.ndarray | None, sentence: str) -> None:
    (folder / "masks" / "left.png").unlink()
    if mask is not None:
        save(mask, folder / "masks" / "left.png")
    with pytest.raises(InputError, match=sentence):
        load(folder)


def test_a_mask_path_that_is_no_text_is_a_sentence(folder: Path) -> None:
    table = json.loads((folder / "transforms.json").read_text())
    table["frames"][0]["mask_path"] = 7
    (folder / "transforms.json").write_text(json.dumps(table))
    with pytest.raises(InputError, match="'mask_path'"):
        load(folder)


@pytest.mark.parametrize(("kind", "suffix"), [(np.uint8, ".png"), (np.uint16, ".png"), (np.uint8, ".jpg")])
def test_every_label_above_zero_counts_where_nothing_is_lost(tmp_path: Path, kind: type, suffix: str) -> None:
    """As for COLMAP and nerfstudio; black in a JPEG is not exactly 0, so that half of the maximum decides there."""
    labels = np.zeros((16, 64), kind)
    for label in (1, 2, 3):
        labels[:, 16 * label :] = label if suffix == ".png" else (9, 140, 250)[label - 1]
    Image.fromarray(labels).save(tmp_path / f"labels{suffix}")
    valid = read_mask(tmp_path / f"labels{suffix}", 64, 16)[8, :, 0] == 255
    assert torch.equal(torch.from_numpy(valid)[8::16], torch.tensor([False, suffix == ".png", True, True]))
