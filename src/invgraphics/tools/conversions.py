"""Conversions of a fitted model to another parameterisation, through one of two hubs.

The hubs are surface points with normals (`surface_points`), for explicit primitives, and density with colour at places (a
field's own `query`), for lattices and planes: a field that has both reaches every target, without a converter for each pair.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from invgraphics.core import Field, Model, Points, Quantity, Samples, Scene, harmonics
from invgraphics.errors import InputError
from invgraphics.fields.convert import require_density, visible_points
from invgraphics.fields.encodings.sparse import SparseVoxels
from invgraphics.fields.gaussian import GaussianField, GaussianFieldConfig
from invgraphics.fields.mesh import MeshFieldConfig
from invgraphics.fields.neural import NeuralField
from invgraphics.fields.planes import PlanesConfig
from invgraphics.fields.points.field import PointField, PointFieldConfig
from invgraphics.fields.slicing import slice_density
from invgraphics.recipes.recipe import Method
from invgraphics.tools import CONVERSION_SIZES

CHUNK = 1 << 16
FLATNESS = 0.3
"""Extent of a surface Gaussian along its normal, over that along the surface."""
SPREADS, OPACITIES = (0.35, 0.5, 0.7, 1.0), (0.2, 0.4, 0.6, 0.85)
"""Extents along the surface, over the mean distance to the nearest neighbours, and opacities, of which the best are taken."""
CALIBRATION_VIEWS = 3
WIDEST = 1.5
"""Largest extent of a surface Gaussian, over the median: a lone point of thin fog would else cover what is behind it."""
EDGE = 0.05
"""Relative step of the depth between neighbouring pixels from which on neither is taken for a surface point."""
DIRECTIONS = 12
"""Training cameras from which a vertex's radiance is evaluated, to fit its spherical harmonics."""
RIDGE = 0.1
"""Weight of the squared coefficients of view-dependent bands in that fit, per direction."""
QUICK_RATES = tuple(
    f"optimiser.groups.{group}.lr={rate}"
    for group, rate in {
        "scales": 2e-2,
        "rotations": 4e-3,
        "opacities": 1e-1,
        "colour": 1e-2,
        "view_dependence": 5e-4,
    }.items()
)
"""Rates of converted Gaussians, which start in the right places: twice those of ``splatting/gaussians``, laptop.
With 10,000 instead of 20,000 of them, 10 s of refit end 0.5 dB higher on bricks, 0.2 dB on textured (128 px, one seed)."""
NO_GROWTH = 'hooks=[{{type = "sh_degree", start = 0.2, interval = 0.2}}, {{type = "limits"}}]'
"""Of converted Gaussians, which are where surfaces are. With growth 10 s end 0.3 to 0.5 dB lower on bricks (of a hash grid, of
points), 0.15 on room, 0.1 higher on textured and mic, the same on materials. Braces are doubled, as in all overrides."""
VISIBLE = 1e-3
"""Opacity of a voxel below which its colour does not matter."""


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Hub of explicit primitives: points on what the training views see, local frame.

    Attributes:
        points: positions and colours in the scene's colour space.
        normals: unit normals, zero where unknown.
    """

    points: Points
    normals: Float[Tensor, "n 3"]


@torch.no_grad()
def surface_points(model: Model, scene: Scene, count: int) -> SurfacePoints:
    """Sample points of a model's visible surfaces, with normals, by torch's global generator.

    Of a density, each lies on a random ray of a training view at a depth drawn from the rendering weights. Of anything else, it
    is a random pixel of a rendered training view, unprojected by its depth; pixels at edges, whose depth is between two
    surfaces, and those with alpha below 1/2 are left out.

    Raises:
        InputError: the model shows nothing.
    """
    field = model.field
    explicit = Quantity.GAUSSIANS in field.provides
    if Quantity.DENSITY | Quantity.RADIANCE in field.provides and not explicit:
        points = visible_points(field, scene, count)
        return SurfacePoints(points, _normals_at(field, points.position.to(model.device)).cpu())
    parts = [_seen_points(model, index, scene, -(-count // len(scene.train))) for index in range(len(scene.train))]
    position, rgb, normals = (torch.cat(column) for column in zip(*parts, strict=True))
    if not len(position):
        raise InputError(f"The model shows no surface to the training views of scene '{scene.name}'.", "Fit it for longer.")
    return SurfacePoints(Points(position, rgb), normals)


def _normals_at(field: Field, position: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    if Quantity.NORMAL not in field.provides:
        return torch.zeros_like(position)
    parts = []
    for part in position.split(CHUNK):
        normal = field.query_no_grad(Samples.at(part), Quantity.NORMAL).normal
        assert normal is not None
        parts.append(normal)
    return torch.cat(parts)


def _seen_points(model: Model, index: int, scene: Scene, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Positions, colours and normals at random pixels of one rendered training view."""
    camera = scene.train[index].camera
    picture = model.render(camera)
    depth = picture.depth
    step = torch.zeros_like(depth)
    for axis in (0, 1):
        jump = depth.diff(dim=axis).abs().nan_to_num(torch.inf)
        last = depth.shape[axis] - 1
        step.narrow(axis, 0, last).copy_(torch.maximum(step.narrow(axis, 0, last), jump))
        step.narrow(axis, 1, last).copy_(torch.maximum(step.narrow(axis, 1, last), jump))
    usable = (depth.isfinite() & (picture.alpha >= 0.5) & (step <= EDGE * depth)).reshape(-1).nonzero()[:, 0]
    flat = usable[torch.randperm(len(usable))[:count]]
    rays = camera.rays(camera.pixel_centres_of(flat))
    rgb = (picture.rgb / picture.alpha[..., None].clamp_min(1e-3)).reshape(-1, 3)[flat]
    normals = torch.zeros_like(rgb) if picture.normal is None else picture.normal.reshape(-1, 3)[flat]
    return rays.origins + depth.reshape(-1)[flat, None] * rays.directions, rgb, normals


def to_gaussians(model: Model, scene: Scene, method: Method, size: int) -> GaussianField:
    """Flat Gaussians on surface points: wide by their neighbours' distance, thin along the normal where it is known.

    One factor of all widths, of `SPREADS`, and one opacity for all, of `OPACITIES`, are those with the least squared error to
    the model's own pictures from `CALIBRATION_VIEWS` training views: splats widen on the screen, so that no choice suits all.
    """
    config = method.recipe.field
    assert isinstance(config, GaussianFieldConfig)
    if Quantity.GAUSSIANS in model.field.provides:
        raise InputError("The run is made of Gaussians already.", "export and import carry them to another run.")
    found = surface_points(model, scene, size)
    field = config.from_points(found.points, scene)
    known = found.normals.norm(dim=1, keepdim=True) > 0.5
    with torch.no_grad():
        field.quaternions.copy_(torch.where(known, quaternions_to(found.normals), field.quaternions))
        field.log_scales.clamp_(max=float(field.log_scales.median()) + math.log(WIDEST))
        field.log_scales[:, 2:] += torch.where(known, torch.tensor(FLATNESS).log(), 0.0)
    _calibrate(field.to(model.device), model, scene, method)
    return field


@torch.no_grad()
def _calibrate(field: GaussianField, model: Model, scene: Scene, method: Method) -> None:
    """Choose widths and opacity of all Gaussians by pictures; changes the field in place."""
    count = min(CALIBRATION_VIEWS, len(scene.train))
    cameras = [scene.train[i * len(scene.train) // count].camera for i in range(count)]
    background = scene.background
    truth = [model.render(camera, normals=False).over(background) for camera in cameras]
    shown, widths = Model(field, method.recipe.renderer.build(scene), scene.bounds.to(model.device)), field.log_scales.clone()

    def error(spread: float, opacity: float) -> float:
        field.log_scales.copy_(widths + math.log(spread))
        field.opacity_logits.fill_(math.log(opacity / (1 - opacity)))
        pictures = (shown.render(camera, normals=False).over(background) for camera in cameras)
        return sum(float((ours - theirs).square().mean()) for ours, theirs in zip(pictures, truth, strict=True))

    error(*min(itertools.product(SPREADS, OPACITIES), key=lambda pair: error(*pair)))  # the last call leaves the best in place


def quaternions_to(normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Shortest rotations (w, x, y, z) from +z to unit vectors."""
    x, y, z = normals.unbind(dim=1)
    shortest = normalize(torch.stack([1 + z, -y, x, torch.zeros_like(z)], dim=1), dim=1)
    half_turn = normals.new_tensor([0.0, 1.0, 0.0, 0.0])  # from +z to -z, about any axis across
    return torch.where((1 + z < 1e-6)[:, None], half_turn, shortest)


def to_points(model: Model, scene: Scene, method: Method, size: int) -> PointField:
    """Neural points on surface points, in their colours; the networks that make density of them are learnt in the refit.

    Raises:
        InputError: the model shows nothing, or the method has no point cloud.
    """
    config = method.recipe.field
    if not isinstance(config, PointFieldConfig):
        raise InputError(f"{method.name} has no point cloud.", "Use --method volumetric/point-nerf.")
    return config.from_points(surface_points(model, scene, size).points, scene)


def to_planes(model: Model, scene: Scene, method: Method, size: int) -> Field:
    """Density in slabs around planes before the mean training camera."""
    config = method.recipe.field
    assert isinstance(config, PlanesConfig)
    require_density(model.field)
    camera, depths = config.placed(scene)
    return config.from_planes(slice_density(model.field, camera, depths, model.bounds))


def to_mesh(model: Model, scene: Scene, method: Method, size: int) -> Field:
    """The isosurface of a density or signed distance, in the photographs' mean colours; its shape is not refitted.

    Raises:
        InputError: the model has neither, or the method fits no mesh.
    """
    config = method.recipe.field
    if not isinstance(config, MeshFieldConfig):
        raise InputError(f"{method.name} fits no mesh.", "Use --method surface/mesh.")
    return config.converted(model.field, scene)


@torch.no_grad()
def to_lattice(model: Model, scene: Scene, method: Method, size: int) -> Field:
    """Density at the vertices of a voxel grid, and spherical harmonics fitted to the radiance towards training cameras.

    Interpolation between vertices and the bands left out are what is lost. The coefficients of a vertex minimise the squared
    error over `DIRECTIONS` cameras plus `RIDGE` times the squares of those above band 0; without it, directions that no camera
    looks along would be free.
    """
    require_density(model.field)
    field = method.recipe.field.build(scene).to(model.device)
    grid, colours = getattr(field, "encoding", None), getattr(field, "appearance", None)
    if not (isinstance(field, NeuralField) and isinstance(grid, SparseVoxels) and isinstance(colours, SparseVoxels)):
        raise InputError(f"{method.name} has no voxel grid of densities.", "Use --method volumetric/plenoxels.")
    vertices = model.bounds.vertices(grid.resolution)
    activation = field.density_activation
    if activation.kind != "relu" or activation.bias != 0 or activation.interpolation == "pre":
        raise InputError("Densities go into a voxel grid only through a ReLU without a bias.", "Leave the recipe as it is.")
    # Features of 1 have the density of a unit, whatever unit of length the field has.
    grid.rows.fill_(1.0)
    unit, density = (torch.cat([_density(one, part) for part in vertices.split(CHUNK)]) for one in (field, model.field))
    grid.rows.copy_((density / unit.clamp_min(1e-12))[:, None])
    edge = 2 * float(model.bounds.half.mean()) / max(grid.resolution)
    visible = (1 - torch.exp(-density * edge) > VISIBLE).nonzero()[:, 0]
    for part in visible.split(CHUNK // DIRECTIONS):
        colours.rows[part] = _fitted_harmonics(model.field, vertices[part], scene, harmonics.degree_of(colours.width // 3))
    return field


def _density(field: Field, position: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
    density = field.query(Samples.at(position), Quantity.DENSITY).density
    assert density is not None
    return density


def _fitted_harmonics(field: Field, position: Float[Tensor, "m 3"], scene: Scene, degree: int) -> Float[Tensor, "m c"]:
    """Coefficients of red, green and blue minus 1/2, by ridge regression over training cameras."""
    count = min(DIRECTIONS, len(scene.train))
    eyes = torch.stack([scene.train[i * len(scene.train) // count].camera.position for i in range(count)]).to(position)
    directions = normalize(position[:, None] - eyes, dim=2)
    where = position[:, None].expand_as(directions).reshape(-1, 3)
    radiance = field.query(Samples.at(where, directions.reshape(-1, 3)), Quantity.RADIANCE).radiance
    assert radiance is not None
    basis = harmonics.basis(directions.reshape(-1, 3), degree).view(len(position), count, -1)
    penalty = RIDGE * count * torch.eye(basis.shape[2]).to(basis)
    penalty[0, 0] = 1e-6
    target = radiance.view(len(position), count, 3) - 0.5
    coefficients = torch.linalg.solve(basis.mT @ basis + penalty, basis.mT @ target)
    return coefficients.mT.reshape(len(position), -1)


@dataclass(frozen=True)
class Target:
    """What a run is converted to.

    Attributes:
        method: whose field is made and refitted, unless another is requested.
        hub: what the conversion goes through, in words.
        size: number of primitives, or of vertices or voxels along an edge; 0 where the method alone decides.
        convert: makes the field of a model, on a scene, for a method, of a size.
        overrides: of the method's recipe, with ``{size}`` in place of that number and ``{run}`` of the run's folder.
    """

    method: str
    hub: str
    size: int
    convert: Callable[[Model, Scene, Method, int], Field]
    overrides: tuple[str, ...] = ()


_SIZES = {name: sizes[0] for name, sizes in CONVERSION_SIZES.items()}
GAUSSIANS = (*QUICK_RATES, NO_GROWTH)
TARGETS = {
    "gaussians": Target("splatting/gaussians", "surface points with normals", _SIZES["gaussians"], to_gaussians, GAUSSIANS),
    "lattice": Target(
        "volumetric/plenoxels",
        "density and colour",
        _SIZES["lattice"],
        to_lattice,
        ("field.encoding.resolution={size}", "field.appearance.resolution={size}", "hooks=[]"),
    ),
    "mesh": Target(
        "surface/mesh", "density or distance", _SIZES["mesh"], to_mesh, ("field.source='{run}'", "field.resolution={size}")
    ),
    "mpi": Target("planes/mpi", "density and colour", 0, to_planes, ("field.init='uniform'",)),
    "points": Target("volumetric/point-nerf", "surface points with normals", _SIZES["points"], to_points),
}
"""Targets by the name that ``convert --to`` takes."""
