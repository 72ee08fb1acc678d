"""The shared scene and camera layer, and the contracts between fields, renderers and training (see CONVENTIONS.md)."""

from typing import TYPE_CHECKING

from invgraphics.core.bounds import Bounds as Bounds
from invgraphics.core.camera import Camera as Camera
from invgraphics.core.contributions import Contributions as Contributions
from invgraphics.core.contributions import Pass as Pass
from invgraphics.core.contributions import Profile as Profile
from invgraphics.core.field import Conditional as Conditional
from invgraphics.core.field import Encoding as Encoding
from invgraphics.core.field import Field as Field
from invgraphics.core.field import Gaussians as Gaussians
from invgraphics.core.field import Quantity as Quantity
from invgraphics.core.mesh import Mesh as Mesh
from invgraphics.core.model import Model as Model
from invgraphics.core.ngp import FusedNGP as FusedNGP
from invgraphics.core.ngp import FusedSDF as FusedSDF
from invgraphics.core.ngp import HashGrid as HashGrid
from invgraphics.core.planes import Planes as Planes
from invgraphics.core.rays import Rays as Rays
from invgraphics.core.renderer import RayRenderer as RayRenderer
from invgraphics.core.renderer import Renderer as Renderer
from invgraphics.core.renderer import Sampler as Sampler
from invgraphics.core.renderer import check as check
from invgraphics.core.rendering import Context as Context
from invgraphics.core.rendering import Rendering as Rendering
from invgraphics.core.rendering import Screen as Screen
from invgraphics.core.rendering import SurfaceTrace as SurfaceTrace
from invgraphics.core.rendering import Trace as Trace
from invgraphics.core.samples import FieldValues as FieldValues
from invgraphics.core.samples import Samples as Samples
from invgraphics.core.scene import Batch as Batch
from invgraphics.core.scene import Points as Points
from invgraphics.core.scene import Scene as Scene
from invgraphics.core.scene import View as View
from invgraphics.lazy import submodules

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
