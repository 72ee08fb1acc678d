"""What a believable scene and believable Gaussians are: numbers that float32 can compute with, each in relation to the others.

Loaders call `check_scene` and `check_gaussians` after the cast to float32. The limits are far beyond any real data set; what
exceeds them is a damaged file or a unit mistaken, and would end as zero-length rays, infinite extents or empty pictures.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.camera import Camera
from invgraphics.core.field import Gaussians
from invgraphics.core.scene import Scene, View
from invgraphics.errors import InputError

LONGEST_SIDE = 1 << 17
"""Pixels of a picture's longer side."""
LONGEST_FOCAL = 1 << 20
"""Focal length in pixels, beyond which neighbouring rays are equal in float32."""
WIDEST_TAN = math.tan(math.radians(89))
"""Tangent of the largest angle between a pixel and the optical axis."""
MOST_STRETCH = 10.0
"""Ratio of the focal lengths of a pixel's sides."""
FARTHEST_CAMERA = 1e4
"""Distance of a camera over the median one's, from the middle of all; and, in a box, over the box's radius."""
ONE_PLACE = 1e-6
"""Distance of places that float32 does not tell apart, with room; over that from the origin, or the radius of the bounds."""
FARTHEST = 1e9
"""Largest coordinate and length, local units, whose square float32 holds with room."""
THINNEST = 1e-5
"""Shortest edge of the bounds over their largest coordinate."""
SCALE = (1e-12, 1e12)
"""World length of a local unit."""
FARTHEST_ORIGIN = 1e9
"""Distance of the local origin from the world's, in local units."""
UNIT = 1e-2
"""How far a normal or a rotation's axis may be from length 1."""
QUATERNION = (1e-6, 1e6)
"""Norm of a quaternion before normalisation; exactly zero stands for none."""
BRIGHTEST = 1e4
"""Largest coefficient of spherical harmonics; 1 is already white."""


def check_scene(scene: Scene) -> None:
    """Check cameras, poses, bounds, points and geometry of a scene as it is fitted: in its local frame, in float32.

    Raises:
        InputError: something is not finite or not believable beside the rest; the sentence names the view and the quantity.
    """
    world = scene.world_from_local
    _expect(_finite(world), f"The frame of '{scene.name}' is not finite: its cameras are too far apart.")
    _within(scene.scale, SCALE, f"One local unit of '{scene.name}'", "units of the data set's world")
    offset = float(world[:3, 3].double().norm()) / scene.scale
    _expect(offset <= FARTHEST_ORIGIN, f"The subject of '{scene.name}' is {offset:.2g} times its size from the world's origin.")
    _check_bounds(scene)
    for split in ("train", "val", "test", "observed"):
        for view in getattr(scene, split):
            what = f"{split} view '{view.name}' of '{scene.name}'"
            check_camera(view.camera, f"the {what}")
            _check_geometry(view, what)
    _check_positions(scene)
    if scene.points is not None:
        _check_points(scene.points.position, f"points of '{scene.name}'")


def check_camera(camera: Camera, what: str) -> None:
    """Check a camera's size, lens and pose; ``what`` names it in messages.

    Raises:
        InputError: as in `check_scene`.
    """
    width, height = camera.width, camera.height
    _expect(min(width, height) >= 1 and max(width, height) <= LONGEST_SIDE, f"{what} has {width}x{height} pixels.")
    _expect(_finite(camera.cam_to_world), f"The pose of {what} is not finite.")
    fx, fy, cx, cy = torch.cat([camera.focal, camera.principal_point]).double().tolist()
    lens = f"{what} has focal length {fx:.4g}, {fy:.4g} and principal point {cx:.4g}, {cy:.4g} for {width}x{height} pixels"
    _expect(all(map(math.isfinite, (fx, fy, cx, cy))) and min(fx, fy) > 0, f"{lens}.")
    _expect(max(fx, fy) <= LONGEST_FOCAL, f"{lens}: its field of view is zero.")
    _expect(max(fx, fy) <= MOST_STRETCH * min(fx, fy), f"{lens}: its pixels are {max(fx, fy) / min(fx, fy):.2g} times as long.")
    tan = math.hypot(max(cx, width - cx) / fx, max(cy, height - cy) / fy)
    _expect(tan <= WIDEST_TAN, f"{lens}: its pixels would look backwards, or nearly so.")


def check_pose(camera: Camera, what: str) -> None:
    """Check that a camera has a size and a rigid pose, which kernels take for granted; ``what`` names it in messages.

    Raises:
        InputError: it has not.
    """
    size = camera.width, camera.height
    if not all(isinstance(edge, int) and edge > 0 for edge in size):
        raise InputError(f"The size of {what} is {size[0]}x{size[1]} pixels.", "Expected: positive whole numbers.")
    if camera.cam_to_world.shape != (4, 4) or camera.focal.shape != (2,) or camera.principal_point.shape != (2,):
        raise InputError(f"The shapes of {what} are not (4, 4) of its pose, (2,) of its focal lengths and principal point.")
    rotation = camera.cam_to_world[:3, :3].detach().double()
    error = float((rotation.T @ rotation - torch.eye(3).to(rotation)).abs().max())
    if not error <= UNIT or not _finite(camera.cam_to_world):
        raise InputError(f"The pose of {what} is not rigid, or not finite.", "Expected: a rotation and a position.")


def principal_point_far_outside(camera: Camera) -> bool:
    """Whether the principal point lies more than half a picture outside the picture, as of a crop or a forgotten resize."""
    relative = camera.principal_point.double().cpu() / torch.tensor([camera.width, camera.height])
    return bool(((relative < -0.5) | (relative > 1.5)).any())


def check_gaussians(gaussians: Gaussians, what: str) -> None:
    """Check activated Gaussians; ``what`` names them in messages.

    Raises:
        InputError: some are not finite, or no Gaussians of any fit.
    """
    norm, total = gaussians.quaternions.double().norm(dim=1), len(gaussians)
    spread = float((gaussians.means.double() - gaussians.means.double().median(dim=0).values).abs().max())
    widest = FARTHEST * min(1.0, max(spread, float(gaussians.scales.median())))
    for name, values, good in (
        ("centres", gaussians.means, gaussians.means.abs() <= FARTHEST),
        ("rotations", gaussians.quaternions, ((norm >= QUATERNION[0]) & (norm <= QUATERNION[1]) | (norm == 0))[:, None]),
        ("scales", gaussians.scales, (gaussians.scales >= 0) & (gaussians.scales <= widest)),
        ("opacities", gaussians.opacities, (gaussians.opacities >= 0) & (gaussians.opacities <= 1)),
        ("colours", gaussians.sh, gaussians.sh.abs() <= BRIGHTEST),
    ):
        for rows, how in ((values.isfinite(), "finite numbers"), (good, "those of any fit")):
            bad = int((~rows.reshape(total, -1)).any(dim=1).sum())
            if bad:
                raise InputError(
                    f"{what}: the {name} of {bad} of {total} Gaussians are not {how}.",
                    "The fit that made them diverged, or the file is damaged; remove these Gaussians.",
                )


def _check_bounds(scene: Scene) -> None:
    bounds = scene.bounds
    edges, corners = (bounds.hi - bounds.lo).double(), torch.stack([bounds.lo, bounds.hi]).double()
    where = f"The bounds of '{scene.name}', from {bounds.lo.tolist()} to {bounds.hi.tolist()},"
    _expect(_finite(corners) and float(corners.abs().max()) <= FARTHEST, f"{where} are not finite.")
    _expect(float(edges.min()) > THINNEST * float(corners.abs().max()), f"{where} hold next to nothing.")
    _expect(
        math.isfinite(bounds.near) and 0 <= bounds.near <= FARTHEST, f"The near plane of '{scene.name}' is {bounds.near:g}."
    )


def _check_positions(scene: Scene) -> None:
    """Cameras in relation to each other and to the bounds; none may be so far that the others become one point."""
    views = [*scene.train, *scene.val, *scene.test, *scene.observed]
    position = torch.stack([view.camera.position for view in views]).double()
    # Of an even number the mean of the two in the middle: of two cameras none is the middle from which the other is far.
    middle = position.quantile(0.5, dim=0)
    distance = (position - middle).norm(dim=1)
    farthest, typical, radius = float(distance.max()), float(distance.quantile(0.5)), scene.bounds.radius
    # Of most cameras in one place, as on a tripod, the median distance is rounding noise, and no measure of the others'.
    apart = typical > ONE_PLACE * max(radius, float(position.norm(dim=1).quantile(0.5)))
    times = farthest / (typical if apart else radius)
    if times > FARTHEST_CAMERA:
        name, what = views[int(distance.argmax())].name, "times as far away as" if apart else "radii of the bounds away from"
        raise InputError(
            f"The view '{name}' of '{scene.name}' is {times:.2g} {what} most others.",
            "Remove the view or estimate its pose again.",
        )
    if scene.bounds.space == "box":
        distance = (position - scene.bounds.centre.double()).norm(dim=1) / scene.bounds.radius
        name = views[int(distance.argmax())].name
        far = float(distance.max())
        _expect(far <= FARTHEST_CAMERA, f"The view '{name}' of '{scene.name}' is {far:.2g} radii of the bounds away from them.")


def _check_points(position: Float[Tensor, "n 3"], what: str) -> None:
    bad = int((~(position.abs() <= FARTHEST)).any(dim=1).sum())  # not of NaN either
    _expect(bad == 0, f"{bad} of {len(position)} {what} are not finite, or beyond {FARTHEST:g} local units.")


def _check_geometry(view: View, what: str) -> None:
    if view.depth is not None:
        _expect(bool((view.depth >= 0).all()), f"The depth of {what} has values that are negative or no numbers.")
    if view.normal is not None:
        length = view.normal.square().sum(dim=-1).sqrt()
        good = ((length - 1).abs() <= UNIT) | (length == 0)
        _expect(bool(good.all()), f"The normals of {what} have other lengths than 1, or 0 where nothing is hit.")


def _finite(values: Tensor) -> bool:
    return bool(values.isfinite().all())


def _within(value: float, limits: tuple[float, float], what: str, unit: str) -> None:
    _expect(limits[0] <= value <= limits[1], f"{what} is {value:.2g} {unit}.")


def _expect(good: bool, sentence: str) -> None:
    if not good:
        raise InputError(sentence[0].upper() + sentence[1:], "The file is damaged, or a unit is mistaken.")
