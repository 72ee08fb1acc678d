"""The shared scene and camera layer, and the contracts between fields, renderers and training (see CONVENTIONS.md)."""

from invgraphics.core.bounds import Bounds as Bounds
from invgraphics.core.camera import Camera as Camera
from invgraphics.core.field import Conditional as Conditional
from invgraphics.core.field import Encoding as Encoding
from invgraphics.core.field import Field as Field
from invgraphics.core.field import Gaussians as Gaussians
from invgraphics.core.field import Quantity as Quantity
from invgraphics.core.field import RayRenderer as RayRenderer
from invgraphics.core.field import Renderer as Renderer
from invgraphics.core.field import Sampler as Sampler
from invgraphics.core.field import check as check
from invgraphics.core.field import no_grad_density as no_grad_density
from invgraphics.core.model import Model as Model
from invgraphics.core.rays import Rays as Rays
from invgraphics.core.rendering import Context as Context
from invgraphics.core.rendering import Rendering as Rendering
from invgraphics.core.rendering import Screen as Screen
from invgraphics.core.rendering import Trace as Trace
from invgraphics.core.samples import FieldValues as FieldValues
from invgraphics.core.samples import Samples as Samples
from invgraphics.core.scene import Batch as Batch
from invgraphics.core.scene import Mesh as Mesh
from invgraphics.core.scene import Points as Points
from invgraphics.core.scene import Scene as Scene
from invgraphics.core.scene import View as View
