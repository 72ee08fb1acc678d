"""A triangle mesh of fixed shape whose vertex colours, with spherical harmonics, are fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn
from typing_extensions import override

from invgraphics.core import harmonics
from invgraphics.core.bounds import Bounds
from invgraphics.core.field import Field, Quantity, resize_to_stored
from invgraphics.core.mesh import Mesh
from invgraphics.core.rendering import Context, Rendering
from invgraphics.core.samples import FieldValues, Samples
from invgraphics.core.scene import Scene
from invgraphics.errors import InputError, NotComposableError
from invgraphics.fields.depth_fusion import fuse_depth
from invgraphics.fields.isosurface import extract_mesh
from invgraphics.fields.visual_hull import visual_hull, with_photograph_colours

GEOMETRY = ("vertices", "faces")
COLOURS = ("sh_dc", "sh_rest")
"""Names of a `MeshField`'s parameters."""


@dataclass(frozen=True)
class MeshFieldConfig:
    """Settings of a mesh, and where its shape comes from.

    Attributes:
        sh_degree: degree of the vertex colours' spherical harmonics, 0 to 3.
        init: without ``source``: ``hull`` carves the visual hull of the training views' alpha; ``depth`` fuses their true
            depth.
        source: a run of a density or signed distance on the same scene, whose surface is extracted; or a mesh file in the data
            set's world (PLY, OBJ, GLB).
        resolution: voxels along the longest edge of the box for any extraction.
        level: density, or signed distance, of the extracted surface; ``None`` for the usual one.
    """

    title: ClassVar[str] = "triangle mesh"

    sh_degree: int = 2
    init: Literal["hull", "depth"] = "hull"
    source: str = ""
    resolution: int = 128
    level: float | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.sh_degree <= harmonics.MAX_DEGREE:
            raise ValueError(f"sh_degree must be from 0 to {harmonics.MAX_DEGREE}, not {self.sh_degree}.")
        if not 8 <= self.resolution <= 512:
            raise ValueError(f"resolution must be from 8 to 512 voxels, not {self.resolution}.")

    def build(self, scene: Scene) -> MeshField:
        """The mesh that ``init`` names, in its mean colours in the photographs; with ``source``, a box until `converted`.

        Raises:
            InputError: the photographs are opaque, or have no depth.
        """
        if self.source:
            return MeshField(_box(scene.bounds), self.sh_degree)
        extracted = visual_hull(scene, self.resolution) if self.init == "hull" else self._from_depth(scene)
        return self.from_mesh(extracted.mesh, scene)

    def converted(self, source: Field, scene: Scene) -> MeshField:
        """Extract the mesh of another field, or take over its own.

        Raises:
            InputError: it has neither mesh nor density nor signed distance, or nowhere the level.
        """
        if Quantity.MESH in source.provides:
            mesh: Mesh = source.primitives(Quantity.MESH, Context(scene.bounds))
        elif (Quantity.SDF | Quantity.DENSITY) & source.provides:
            remedy = "Use --set field.level=LEVEL, or fit the run that the mesh is made of for longer."
            device = next((tensor.device for tensor in (*source.parameters(), *source.buffers())), torch.device("cpu"))
            bounds = scene.bounds.to(device)
            mesh = extract_mesh(source, bounds, self.resolution, self.level, remedy).mesh
        else:
            remedy = "Export it with `invgraphics export RUN --to mesh` first, and give that file as field.source."
            raise InputError(f"field.source: {type(source).__name__} has no density whose surface could be extracted.", remedy)
        return self.from_mesh(mesh.to("cpu"), scene)

    def from_mesh(self, mesh: Mesh, scene: Scene) -> MeshField:
        """A field of this mesh, in its mean colours in the training photographs."""
        return MeshField(with_photograph_colours(mesh, scene), self.sh_degree)

    def _from_depth(self, scene: Scene) -> Any:
        """Fuse the training views' true depth.

        Raises:
            InputError: there is none.
        """
        views = [view for view in scene.train if view.depth is not None]
        if not views:
            remedy = "Set field.init = 'hull', or give field.source."
            raise InputError(f"The training views of scene '{scene.name}' have no depth maps to fuse to a mesh.", remedy)

        def truth(index: int) -> Rendering:
            view = views[index]
            assert view.depth is not None
            depth = torch.where(view.depth > 0, view.depth, torch.inf)
            depth = depth if view.mask is None else torch.where(view.mask, depth, torch.inf)
            alpha = depth.isfinite().float()
            return Rendering(view.colour() * alpha[..., None], alpha, depth, view.normal)

        return fuse_depth([view.camera for view in views], truth, scene.bounds, self.resolution)


class MeshField(Field):
    """A mesh whose shape is constant and whose vertex colours are parameters.

    Args:
        mesh: shape and colours at the start; grey where it has none.
        sh_degree: of the colours; missing bands start at zero.
    """

    provides = Quantity.MESH
    vertices: Tensor
    faces: Tensor

    def __init__(self, mesh: Mesh, sh_degree: int) -> None:
        super().__init__()
        count, coefficients = len(mesh.vertices), harmonics.count(sh_degree)
        sh = mesh.vertices.new_zeros(count, coefficients, 3)
        if mesh.sh is not None:
            known = min(coefficients, mesh.sh.shape[1])
            sh[:, :known] = mesh.sh[:, :known]
        self.register_buffer("vertices", mesh.vertices.detach().clone())
        self.register_buffer("faces", mesh.faces.detach().clone())
        self.sh_dc = nn.Parameter(sh[:, :1].clone())
        self.sh_rest = nn.Parameter(sh[:, 1:].clone())
        self._normals = mesh.normals

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """Refuse pointwise queries: this field has a surface only."""
        raise NotComposableError(f"MeshField has no {want.words()} at points.", "It provides mesh.")

    @override
    def primitives(self, want: Quantity, ctx: Context) -> Mesh:
        """The mesh, with normals and colours."""
        if want != Quantity.MESH:
            return super().primitives(want, ctx)
        if self._normals is None or self._normals.device != self.vertices.device:
            self._normals = Mesh(self.vertices, self.faces).outwards()
        return Mesh(self.vertices, self.faces, self._normals, torch.cat([self.sh_dc, self.sh_rest], dim=1))

    @override
    def primitive_count(self) -> int:
        """Number of triangles."""
        return len(self.faces)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Take over the checkpoint's mesh, whatever its size."""
        for name in (*GEOMETRY, *COLOURS):
            stored, own = state_dict.get(prefix + name), getattr(self, name)
            if isinstance(stored, Tensor) and stored.shape[1:] == own.shape[1:] and len(stored) != len(own):
                resize_to_stored(own, stored)
        self._normals = None
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


class ExtractedMesh(Field):
    """A field that also provides the mesh of its surface, extracted when it is first requested.

    Args:
        source: provides a signed distance or a density, and radiance: the mesh's colours are its radiance at the vertices.
        resolution: voxels along the longest edge.
        level: of the surface, see `extract_mesh`.
    """

    def __init__(self, source: Field, resolution: int, level: float | None = None) -> None:
        super().__init__()
        self.source, self._resolution, self._level = source, resolution, level
        self.provides = source.provides | Quantity.MESH
        self._mesh: Mesh | None = None

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """The source's values."""
        return self.source.query(samples, want)

    @override
    def primitives(self, want: Quantity, ctx: Context) -> Any:
        """The extracted mesh, without colours of its own; or the source's other primitives."""
        if want != Quantity.MESH:
            return self.source.primitives(want, ctx)
        if self._mesh is None:
            self._mesh = replace(extract_mesh(self.source, ctx.bounds, self._resolution, self._level).mesh, sh=None)
        return self._mesh

    @override
    def state_dict(self, *args: Any, **kwargs: Any) -> Any:
        """The source's."""
        return self.source.state_dict(*args, **kwargs)

    @override
    def load_state_dict(self, *args: Any, **kwargs: Any) -> Any:
        """Load the source's; the mesh is extracted anew."""
        self._mesh = None
        return self.source.load_state_dict(*args, **kwargs)


def _box(bounds: Bounds) -> Mesh:
    """The bounds' box as twelve triangles."""
    corner = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = torch.tensor([[a, b, c] for a, b, c, _ in quads] + [[a, c, d] for a, _, c, d in quads])
    return Mesh(bounds.lo + corner * (bounds.hi - bounds.lo), faces)
