"""Suggestions for names that are misspelt or cut short."""

import pytest

from invgraphics.errors import did_you_mean

NAMES = ["volumetric/plenoxels", "volumetric/voxels", "splatting/gaussians", "splatting/gaussians-mip"]


@pytest.mark.parametrize(
    ("word", "suggestion"),
    [
        ("vox", "volumetric/voxels"),  # the beginning of one name, closer by its letters to none
        ("voxel", "volumetric/voxels"),
        ("plenoxel", "volumetric/plenoxels"),
        ("gausians", "splatting/gaussians"),
        ("splatting/gaussian", "splatting/gaussians"),
    ],
)
def test_the_name_that_was_meant(word: str, suggestion: str) -> None:
    assert did_you_mean(word, NAMES) == f" Did you mean '{suggestion}'?"


@pytest.mark.parametrize("word", ["", "vo", "mesh"])
def test_no_name_is_close(word: str) -> None:
    assert did_you_mean(word, NAMES) == ""
