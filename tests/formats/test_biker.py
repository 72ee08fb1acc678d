"""One trained scene in three formats looks alike from every side, once the frames are brought together."""

from collections.abc import Callable
from itertools import combinations
from pathlib import Path

from gaussian_files import camera_at, picture_of, psnr

from invgraphics.core import Gaussians
from invgraphics.core.transforms import axes_to_opencv
from invgraphics.fields.similarity import transform_gaussians
from invgraphics.formats.base import read_gaussians

FILES = ("biker.compressed.ply", "biker.spz", "biker_derived_standard.ply")
EYES = ([0.0, -0.5, -3.0], [2.5, -1.0, 1.0])


def _opencv(path: Path) -> Gaussians:
    """The file in axes right, down, forward; those of PLY files, which do not say, are so."""
    splats = read_gaussians(path)[1]
    return transform_gaussians(splats.gaussians, axes_to_opencv(splats.axes or "opencv").float())


def test_the_three_files_agree(data: Callable[[str], Path]) -> None:
    bikers = {name: _opencv(data("splats") / name) for name in FILES}
    assert {len(biker) for biker in bikers.values()} == {152_746}
    for eye in EYES:
        pictures = {name: picture_of(biker, camera_at(eye, [0.0, -1.0, 0.0], size=128)) for name, biker in bikers.items()}
        for one, other in combinations(FILES, 2):
            assert psnr(pictures[one], pictures[other]) > 55, (one, other, eye)  # 62.6 measured at worst


def test_the_biker_stands_on_the_ground(data: Callable[[str], Path]) -> None:
    """In all three files the soles are at height 0, and down is +y."""
    for name in FILES:
        height = -_opencv(data("splats") / name).means[:, 1]
        assert -1e-3 < height.min() < 0.01 and 3.1 < height.max() < 3.2, name
