"""Pictures of fields over lattices, for which there is one kernel: like those composed of many."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from invgraphics import kernels
from invgraphics.core import Context, Scene
from invgraphics.core.fused import FusedLattice
from invgraphics.core.lattice import Lattice
from invgraphics.fields.encodings.factors import CpConfig, VmConfig
from invgraphics.fields.encodings.sparse import SparseVoxels, SparseVoxelsConfig
from invgraphics.fields.encodings.triplane import TriplaneConfig
from invgraphics.fields.encodings.voxels import VoxelsConfig
from invgraphics.fields.neural import NeuralField, NeuralFieldConfig
from invgraphics.renderers.occupancy import OccupancyConfig
from invgraphics.renderers.volumetric import MAX_SKIPPED_WEIGHT, Volumetric

SAMPLER = OccupancyConfig(resolution=8, steps_per_diagonal=256, transmittance=1e-4)
NO_NETWORK = {"layers": 0, "skip": -1, "geometry_features": 0, "geometry_head": "none"}
SEEN = {"direction": "frequency", "direction_degree": 2, "colour_layers": 1, "colour_width": 16}
FIELDS = {
    "vm": NeuralFieldConfig(
        VmConfig(9, 4), **NO_NETWORK, **SEEN, density_bias=1.0, density_per="half", density_scale=2.0,
        appearance=VmConfig(7, 17), appearance_basis=6, feature_octaves=2,
    ),
    "cp": NeuralFieldConfig(CpConfig(9, 20), **NO_NETWORK, **SEEN, density_bias=1.0, appearance=CpConfig(7, 9)),
    "triplane": NeuralFieldConfig(
        TriplaneConfig(9, 16), layers=1, width=12, skip=-1, geometry_features=7, direction="none", colour_layers=1,
        colour_width=12, hidden_activation="softplus", colour_padding=0.01,
    ),
    "voxels": NeuralFieldConfig(
        VoxelsConfig(9, 28), **NO_NETWORK, head="sh", direction="none", colour_activation="clamp", density_activation="relu",
        density_bias=2.0,
    ),
    "dvgo": NeuralFieldConfig(
        VoxelsConfig(9, 1), **NO_NETWORK, direction="sh", direction_degree=2, colour_layers=2, colour_width=12,
        appearance=VoxelsConfig(8, 12), density_bias=1.0,
    ),
    "dense": NeuralFieldConfig(
        VoxelsConfig(13, 2, levels=3, coarsest=4), layers=1, width=16, skip=-1, geometry_features=5, direction="sh",
        colour_layers=1, colour_width=16, density_activation="exp",
    ),
    "plenoxels": NeuralFieldConfig(
        SparseVoxelsConfig(9, 1), **NO_NETWORK, head="sh", direction="none", colour_activation="clamp",
        density_activation="relu", density_bias=1.0, appearance=SparseVoxelsConfig(9, 27),
    ),
    "diffuse": NeuralFieldConfig(VoxelsConfig(9, 4), **NO_NETWORK, head="none", direction="none", density_bias=1.0),
}  # fmt: skip


def fitted(config: NeuralFieldConfig, scene: Scene) -> NeuralField:
    """A field with something in it."""
    torch.manual_seed(1)
    field = config.build(scene)
    with torch.no_grad():
        for name, parameter in field.named_parameters():
            parameter.copy_(torch.randn(parameter.shape) * (1.0 if "encoding" in name else 0.5))
    if isinstance(field.encoding, SparseVoxels):
        field.encoding.keep(torch.rand(9, 9, 9) < 0.7)
    return field


@pytest.fixture
def scene(make_scene: Callable[..., Scene]) -> Scene:
    return make_scene()


@pytest.fixture
def renderer(scene: Scene) -> Volumetric:
    made = Volumetric(SAMPLER.build(scene))
    made.sampler.occupied.copy_(torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(0)) < 0.4)  # type: ignore[union-attr]
    return made


@pytest.mark.parametrize(("name", "cropped"), [*((name, False) for name in FIELDS), ("dvgo", True), ("vm", True)])
def test_a_picture_is_the_composed_one(scene, renderer, monkeypatch, name: str, cropped: bool) -> None:
    field, ctx, made = fitted(FIELDS[name], scene), Context(scene.bounds), []
    if cropped:
        field.crop(*(scene.bounds.from_unit(torch.tensor(corner)) for corner in ((0.2, 0.1, 0.3), (0.9, 0.7, 1.0))), 9)
    original = kernels.lattice_render
    monkeypatch.setattr(kernels, "lattice_render", lambda *args: (made.append(None), original(*args))[1])
    with torch.no_grad():
        ours, _ = renderer.render_image(field, scene.train[0].camera, ctx)
        monkeypatch.setattr(kernels, "compiled", lambda *args: False)
        theirs, _ = renderer.render_image(field, scene.train[0].camera, ctx)
    assert len(made) == 1
    assert 0.05 < float(theirs.alpha.mean()) < 0.98
    assert float(theirs.rgb.std()) > 0.02
    torch.testing.assert_close(ours.alpha, theirs.alpha, rtol=0, atol=2e-4)
    # Both leave out colours, not the same ones; colours without an upper bound have a factor to go with them.
    torch.testing.assert_close(
        ours.rgb, theirs.rgb, rtol=0, atol=(MAX_SKIPPED_WEIGHT + 2e-4) * max(1.0, float(theirs.rgb.max()))
    )


@pytest.mark.parametrize(("name", "cropped"), [("vm", False), ("voxels", False), ("dvgo", True), ("plenoxels", False)])
def test_training_marches_in_one_pass_and_sees_the_same(scene, renderer, monkeypatch, name: str, cropped: bool) -> None:
    field, rays, made = fitted(FIELDS[name], scene), scene.train[0].camera.rays(), []
    if cropped:
        field.crop(*(scene.bounds.from_unit(torch.tensor(corner)) for corner in ((0.2, 0.1, 0.3), (0.9, 0.7, 1.0))), 9)
    original = kernels.lattice_march
    monkeypatch.setattr(kernels, "lattice_march", lambda *args: (made.append(None), original(*args))[1])

    def gradient() -> torch.Tensor:
        ctx = Context(scene.bounds, training=True, generator=torch.Generator().manual_seed(5))
        field.zero_grad()
        renderer.render_rays(field, rays, ctx)[0].rgb.square().sum().backward()
        found = next(field.encoding.parameters()).grad
        assert found is not None
        return found.clone()

    ours = gradient()
    assert len(made) == 1
    monkeypatch.setattr(kernels, "compiled", lambda *args: False)
    theirs = gradient()
    assert len(made) == 1
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-3 * float(theirs.abs().max()))


def test_what_the_kernel_does_not_know_is_composed(scene) -> None:
    signed = replace(FIELDS["triplane"], geometry="sdf", direction="sh")
    before = replace(FIELDS["diffuse"], density_interpolation="pre")
    skipping = replace(FIELDS["dense"], layers=2, skip=0)
    for config in (signed, before, skipping):
        assert config.build(scene).fused(scene.bounds) is None


def test_a_linked_grid_has_the_picture_of_a_dense_one_with_zeros(scene, renderer) -> None:
    field = fitted(FIELDS["voxels"], scene)
    parts = field.fused(scene.bounds)
    assert isinstance(parts, FusedLattice)
    (grid,) = parts.geometry.lattices
    kept = torch.rand(grid.resolution, generator=torch.Generator().manual_seed(2)) < 0.7
    links = torch.full(grid.resolution, -1, dtype=torch.int32)
    links[kept] = torch.arange(int(kept.sum()), dtype=torch.int32)
    camera, steps = scene.train[0].camera, renderer.sampler.steps(Context(scene.bounds))
    found = []
    dense = Lattice(grid.features.detach() * kept[..., None])
    for lattice in (Lattice(grid.features.detach()[kept], "xyz", links), dense):
        changed = replace(parts, geometry=replace(parts.geometry, lattices=(lattice,)))
        call = scene.bounds.clip(camera.rays()), renderer.sampler.occupied, scene.bounds, steps, changed
        found.append(kernels.lattice_render(*call)[0])
    torch.testing.assert_close(*found, rtol=0, atol=1e-5)
