"""Conformance suite of fields: shapes, ranges, gradients, and state that comes back from a checkpoint."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from invgraphics.core import Context, Field, Gaussians, Mesh, Points, Quantity, Samples, Scene
from invgraphics.core.planes import Planes

POINTWISE = {
    Quantity.DENSITY: "density",
    Quantity.SDF: "sdf",
    Quantity.GRADIENT: "gradient",
    Quantity.RADIANCE: "radiance",
    Quantity.NORMAL: "normal",
    Quantity.FEATURES: "features",
}
ANY = -1
"""Stands for a length that a contract leaves open."""
EXPLICIT: dict[Quantity, tuple[type, dict[str, tuple[int, ...]]]] = {
    Quantity.GAUSSIANS: (
        Gaussians,
        {"means": (3,), "quaternions": (4,), "scales": (3,), "opacities": (), "sh": (ANY, 3)},
    ),
    Quantity.POINTS: (Points, {"position": (3,), "rgb": (3,), "normal": (3,), "features": (ANY,), "confidence": ()}),
    Quantity.MESH: (Mesh, {"vertices": (3,), "normals": (3,), "sh": (ANY, 3)}),
    Quantity.PLANES: (Planes, {"depths": (), "rgb": (3, ANY, ANY), "alpha": (ANY, ANY)}),
}
"""Primitives -> their class, and the shape of one row of each tensor that has a row per primitive."""
SHARES = ("opacities", "alpha", "confidence")
"""Tensors of primitives that lie in [0, 1]."""


def perturb(field: Field, amount: float = 0.01) -> None:
    """Add normal noise to a field's parameters: a new lattice is constant, where no normal is defined.

    Args:
        field: it is changed in place, by torch's global generator.
        amount: standard deviation.
    """
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.add_(amount * torch.randn_like(parameter))


def check_field(field: Field, scene: Scene) -> None:
    """Assert the contract of a field.

    Values have the right shapes and ranges and are finite, nothing comes that was not requested, and primitives of each kind
    that it provides are whole; gradients reach the parameters and the positions; its state is complete, and comes back
    with it.

    Its parameters are perturbed before (see `perturb`) and put back afterwards.
    """
    assert field.provides, "a field must provide something"
    new = {name: value.clone() for name, value in field.state_dict().items()}
    unfit = [name for name, value in new.items() if not bool(value.isfinite().all())]
    assert not unfit, f"not finite in a new field, which stops every fit: {unfit}"
    field.load_state_dict(new)
    _check_registered(field)
    perturb(field)
    samples = _samples(scene)
    ctx = Context(scene.bounds)
    for quantity in POINTWISE:
        if quantity in field.provides:
            _check_values(field, samples, quantity)
    if Quantity.GRADIENT in field.provides:
        _check_gradient(field, samples)
    for quantity in EXPLICIT:
        if quantity in field.provides:
            _check_primitives(field, quantity, ctx)
    if Quantity.DEPTH_MAPS in field.provides:
        maps = field.primitives(Quantity.DEPTH_MAPS, ctx)
        assert all(maps.view(i).depth is not None for i in range(len(maps.cameras))), "a depth map is missing"
    _check_differentiable(field, samples, ctx)
    _check_reload(field, samples, ctx)
    field.load_state_dict(new)


def _samples(scene: Scene) -> Samples:
    """37 positions that are in the graph: in the box, in all of space, and on known surfaces, where splats are."""
    lo, hi = scene.bounds.lo, scene.bounds.hi
    places = [torch.lerp(lo, hi, torch.rand(37, 3))[:13], scene.bounds.from_unit(torch.rand(37, 3))]
    if scene.points is not None and len(scene.points):
        places.insert(0, scene.points.position[torch.randint(len(scene.points), (12,))])
    position = torch.cat(places)[:37].clone().requires_grad_(True)
    return Samples.at(position, torch.nn.functional.normalize(torch.randn(37, 3), dim=1))


def _check_registered(field: Field) -> None:
    """Assert that tensors which a loaded state leaves there are parameters or buffers: others are in no checkpoint."""
    loose = [
        f"{path}.{name}".lstrip(".")
        for path, module in field.named_modules()
        for name, value in vars(module).items()
        if isinstance(value, Tensor)
    ]
    assert not loose, f"neither parameters nor buffers, so that no checkpoint holds them: {loose}"


def _check_values(field: Field, samples: Samples, quantity: Quantity) -> None:
    """Assert shape, range and finiteness of a quantity at samples, and that it comes alone."""
    count, words = len(samples), quantity.words()
    values = field.query(samples, quantity)
    value = getattr(values, POINTWISE[quantity])
    assert value is not None, f"asked for {words}, got nothing"
    shape = (count,) if quantity in (Quantity.DENSITY, Quantity.SDF) else (count, value.shape[-1])
    assert tuple(value.shape) == shape, f"the shape of {words} of {count} samples is {tuple(value.shape)}"
    assert bool(value.isfinite().all()), f"{words} is not finite"
    more = [name for name, other in vars(values).items() if other is not None and name != POINTWISE[quantity]]
    assert not more, f"asked for {words} alone, got {', '.join(more)} too"
    if quantity in (Quantity.RADIANCE, Quantity.NORMAL, Quantity.GRADIENT):
        assert value.shape[1] == 3, f"{words} has {value.shape[1]} components"
    if quantity is Quantity.DENSITY:
        assert bool((value >= 0).all()), "a density is negative"
    if quantity is Quantity.FEATURES:
        assert value.shape[1] == field.feature_width, "feature_width is not the number of features"
    if quantity is Quantity.NORMAL:
        empty = torch.zeros(count, dtype=torch.bool)
        if Quantity.DENSITY in field.provides:
            density = field.query(samples, Quantity.DENSITY).density
            empty = torch.zeros_like(empty) if density is None else density == 0
        length = value.norm(dim=1)
        assert bool((((length - 1).abs() < 1e-3) | empty).all()), "a normal is not of unit length"
    none = field.query(samples[:0], quantity)
    assert len(getattr(none, POINTWISE[quantity])) == 0, "no samples must give no values"


def _check_gradient(field: Field, samples: Samples) -> None:
    """Assert that a raw gradient can be had outside the graph, is in it when training, and is what normals are made of."""
    assert Quantity.SDF in field.provides, "a gradient is that of a signed distance, which the field does not provide"
    gradient = field.query(samples, Quantity.SDF | Quantity.GRADIENT).gradient
    outside = field.query_no_grad(samples, Quantity.GRADIENT | (field.provides & Quantity.NORMAL))
    assert gradient is not None and outside.gradient is not None, "asked for a gradient, got nothing"
    assert torch.allclose(gradient, outside.gradient, atol=1e-4), "the gradient is another one inside no_grad"
    assert not outside.gradient.requires_grad, "a gradient inside no_grad is in the graph"
    assert gradient.requires_grad, "the gradient at positions that are in the graph is not in it"
    at = samples.position.detach().requires_grad_(True)
    distance = field.query(replace(samples, position=at), Quantity.SDF).sdf
    assert distance is not None, "asked for a signed distance, got nothing"
    (slope,) = torch.autograd.grad(distance.sum(), at)
    agreement = torch.cosine_similarity(slope, outside.gradient, dim=1).mean()
    ratio = (outside.gradient.norm(dim=1) / slope.norm(dim=1).clamp_min(1e-9)).median()
    assert agreement > 0.8 and 0.6 < ratio < 1.6, (
        f"the gradient is not that of the signed distance: {agreement:.2f} of its direction, {ratio:.2f} times its length"
    )
    if outside.normal is not None:
        assert torch.allclose(outside.normal, torch.nn.functional.normalize(outside.gradient, dim=1), atol=1e-4), (
            "a normal is not the normalised gradient"
        )


def _check_primitives(field: Field, quantity: Quantity, ctx: Context) -> None:
    """Assert that primitives of a kind are there, whole and finite."""
    kind, rows = EXPLICIT[quantity]
    found = field.primitives(quantity, ctx)
    assert isinstance(found, kind), f"asked for {quantity.words()}, got a {type(found).__name__}"
    given = {name: value for name, value in vars(found).items() if isinstance(value, Tensor)}
    count = len(given[next(iter(rows))])
    assert count and field.primitive_count(), f"there are no {quantity.words()}, or primitive_count does not count them"
    for name, value in given.items():
        assert bool(value.isfinite().all()), f"{name} of {quantity.words()} is not finite"
        if name in rows:
            row = tuple(size if wanted != ANY else ANY for size, wanted in zip(value.shape[1:], rows[name], strict=False))
            assert (len(value), value.ndim, row) == (count, 1 + len(rows[name]), rows[name]), (
                f"the shape of {name} of {count} {quantity.words()} is {tuple(value.shape)}"
            )
        if name in SHARES:
            assert bool(((value >= 0) & (value <= 1 + 1e-5)).all()), f"{name} of {quantity.words()} leave [0, 1]"
    if isinstance(found, Gaussians):
        assert bool((found.scales > 0).all()), "a Gaussian's scale is not above 0"
        assert bool((found.quaternions.norm(dim=1) > 0).all()), "a Gaussian's quaternion is 0"
        assert found.sh.shape[1] in (1, 4, 9, 16), f"there are {found.sh.shape[1]} spherical harmonics"
    if isinstance(found, Mesh):
        assert bool(((found.faces >= 0) & (found.faces < count)).all()), "a face names a vertex that is not there"
    if isinstance(found, Planes):
        assert bool((found.depths.diff() > 0).all()), "planes are not sorted by depth, nearest first"


def _outputs(field: Field, samples: Samples, ctx: Context) -> dict[str, Tensor]:
    """All numbers that a field gives: its quantities at samples, and the tensors of its primitives."""
    found: dict[str, Tensor] = {}
    for quantity, name in POINTWISE.items():
        if quantity in field.provides:
            found[quantity.words()] = getattr(field.query(samples, quantity), name)
    for quantity in EXPLICIT:
        if quantity in field.provides:
            tensors: dict[str, Any] = vars(field.primitives(quantity, ctx))
            found |= {f"{quantity.words()}.{name}": value for name, value in tensors.items() if isinstance(value, Tensor)}
    return {name: value for name, value in found.items() if value.is_floating_point()}


def _check_differentiable(field: Field, samples: Samples, ctx: Context) -> None:
    """Assert that gradients of what a field gives reach its parameters, and those of its quantities the positions.

    Normals may be outside the graph: pictures show them, and no loss is of them.
    """
    learnt = [parameter for parameter in field.parameters() if parameter.requires_grad]
    outputs = _outputs(field, samples, ctx)
    at_points = [quantity.words() for quantity in POINTWISE if quantity in field.provides & ~Quantity.NORMAL]
    if not learnt or not outputs:
        return
    cut = [name for name in at_points if not outputs[name].requires_grad]
    assert not cut, f"outside the graph, so that nothing can be learnt from it: {', '.join(cut)}"
    inside = [value for value in outputs.values() if value.requires_grad]
    assert inside, "no primitive is in the graph, so that nothing can be learnt from them"
    total = torch.stack([(value * torch.randn_like(value)).sum() for value in inside]).sum()
    *gradients, at = torch.autograd.grad(total, [*learnt, samples.position], allow_unused=True)
    known = [gradient for gradient in gradients if gradient is not None]
    assert all(bool(gradient.isfinite().all()) for gradient in known), "a gradient of a parameter is not finite"
    assert any(bool((gradient != 0).any()) for gradient in known), "no gradient reaches the parameters"
    if at_points:
        assert at is not None and bool((at != 0).any()), "no gradient reaches the positions, so that poses cannot be fitted"
        assert bool(at.isfinite().all()), "a gradient of a position is not finite"


@torch.no_grad()
def _check_reload(field: Field, samples: Samples, ctx: Context) -> None:
    """Assert that what a field gives changes with its parameters, and comes back with its state."""
    state = {name: value.clone() for name, value in field.state_dict().items()}
    before = {name: value.clone() for name, value in _outputs(field, samples, ctx).items()}
    perturb(field, 0.1)
    changed = _outputs(field, samples, ctx)
    same = all(value.shape == before[name].shape and torch.equal(value, before[name]) for name, value in changed.items())
    assert not same or not before or not list(field.parameters()), "nothing that the field gives depends on its parameters"
    field.load_state_dict(state)
    for name, value in _outputs(field, samples, ctx).items():
        assert torch.allclose(value, before[name], rtol=1e-4, atol=1e-6), f"{name} differs once the state is loaded again"
