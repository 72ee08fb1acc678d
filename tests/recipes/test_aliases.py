"""What the field calls a method leads to ours, and a faulty recipe is named."""

from pathlib import Path

import pytest

from invgraphics.errors import InputError
from invgraphics.recipes.aliases import ALIASES, suggested_method
from invgraphics.recipes.recipe import load_method, methods, source


@pytest.mark.parametrize(
    ("word", "method"),
    [
        ("instant-ngp", "volumetric/hash"),
        ("Instant_NGP", "volumetric/hash"),
        ("volumetric/ngp", "volumetric/hash"),
        ("instant-npg", "volumetric/hash"),
        ("3dgs", "splatting/gaussians"),
        ("gaussian-splatting", "splatting/gaussians"),
        ("splatfacto", "splatting/gaussians"),
        ("nerfacto", "volumetric/hash-proposal"),
        ("mipnerf360", "volumetric/mip-nerf-360"),
        ("mip-nerf360", "volumetric/mip-nerf-360"),
        ("tensorf", "volumetric/tensorf-vm"),
        ("plenoxel", "volumetric/plenoxels"),
        ("hash", "volumetric/hash"),
        ("gaussians", "splatting/gaussians"),
        ("volumetric/gaussian", "volumetric/gaussians"),
        ("NeRF", "volumetric/nerf"),
        ("neus", "hybrid/neus"),
    ],
)
def test_a_name_of_the_field_leads_to_a_method(word: str, method: str) -> None:
    with pytest.raises(InputError) as refused:
        source(word)
    assert refused.value.sentence == f"There is no method '{word}'. Did you mean '{method}'?"


def test_aliases_name_methods_and_hide_none() -> None:
    assert set(ALIASES.values()) <= set(methods())
    assert not set(ALIASES) & set(methods())
    assert suggested_method("banana", methods()) == ""


def test_a_recipe_without_a_needed_key_is_named(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    whole = (Path(__file__).parents[2] / "renderers" / "volumetric" / "hash.toml").read_text()
    file.write_text(whole.split("[presets")[0].replace("[optimiser", "[optimizer"))
    for overrides in ([], ["batches.rays=9"]):
        with pytest.raises(InputError, match=r"mine\.toml: Unknown key 'optimizer'\. Did you mean 'optimiser'"):
            load_method(str(file), overrides=overrides)
    file.write_text('summary = "nothing"')
    with pytest.raises(InputError, match=r"mine\.toml: The key 'field' is missing"):
        load_method(f"{file}:batches.rays=9")
    file.write_text(whole)
    with pytest.raises(InputError, match=r"^Unknown key 'batches\.rayz'"):  # not the file's fault
        load_method(f"{file}:batches.rayz=9")
