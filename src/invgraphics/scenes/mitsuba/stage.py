"""From our descriptions to Mitsuba's objects: models, cameras and pictures. Runs in the rendering process only."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from invgraphics.core import Camera
from invgraphics.core.transforms import opencv_to_mitsuba
from invgraphics.scenes.mitsuba import ply
from invgraphics.scenes.mitsuba.build.model import Fog, Model

NEAR, FAR = 1e-3, 1e4
PASS = 2**22
"""Most samples rendered at once, which bounds the memory that Dr.Jit needs (about 1 GB)."""


def load(model: Model, depth: int, hide_emitters: bool, folder: Path) -> Any:
    """Load a model as a Mitsuba scene.

    Args:
        model: what to load.
        depth: longest light path, in vertices.
        hide_emitters: whether lights are invisible to the camera, so that alpha is the coverage.
        folder: for the temporary mesh files.
    """
    import drjit
    import mitsuba

    integrator = "volpath" if model.fog else "path"
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": integrator, "max_depth": depth, "hide_emitters": hide_emitters},
        **_objects(model.lights),
    }
    for index, part in enumerate(model.parts):
        path = folder / f"part{index}.ply"
        ply.write(path, part.mesh.vertices, part.mesh.faces, part.mesh.normals, part.mesh.uv)
        scene[f"part{index}"] = {"type": "ply", "filename": str(path), "bsdf": _objects(part.material)}
        if part.radiance is not None:
            emitter = {"type": "area", "radiance": {"type": "rgb", "value": list(part.radiance)}}
            scene[f"part{index}"]["emitter"] = emitter
    for index, ball in enumerate(model.balls):
        sphere = {"type": "sphere", "center": list(ball.centre), "radius": ball.radius}
        scene[f"ball{index}"] = {**sphere, "bsdf": _objects(ball.material)}
    if model.fog:
        scene["fog"] = _fog(model.fog)
    # One thread while the ray-tracing hierarchy is built: with more, its rounding differs from run to run.
    threads = drjit.thread_count()
    drjit.set_thread_count(1)
    try:
        return mitsuba.load_dict(scene)
    finally:
        drjit.set_thread_count(threads)


def sensor(camera: Camera) -> dict[str, Any]:
    """Mitsuba's description of a pinhole camera with square pixels, and of the film that records coverage exactly."""
    import mitsuba

    width, height = camera.width, camera.height
    focal = float(camera.focal[0])
    if not math.isclose(focal, float(camera.focal[1]), rel_tol=1e-6):
        raise ValueError("Mitsuba has square pixels only")
    pose = opencv_to_mitsuba(camera.cam_to_world.double()).numpy()
    return {
        "type": "perspective",
        "to_world": mitsuba.ScalarTransform4f(pose),
        "fov": math.degrees(2 * math.atan(width / (2 * focal))),
        "fov_axis": "x",
        # Mitsuba moves the image, not the principal point: hence the sign.
        "principal_point_offset_x": 0.5 - float(camera.principal_point[0]) / width,
        "principal_point_offset_y": 0.5 - float(camera.principal_point[1]) / height,
        "near_clip": NEAR,
        "far_clip": FAR,
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "pixel_format": "rgba",
            "component_format": "float32",
            "rfilter": {"type": "box"},  # wider filters add neighbours in an order that depends on the threads
        },
        "sampler": {"type": "independent"},
    }


def render(scene: Any, camera: Camera, samples: int, seed: tuple[int, ...]) -> Float[np.ndarray, "h w 4"]:
    """Linear, premultiplied rgba in float32.

    Args:
        scene: as `load` returns it.
        camera: which view.
        samples: per pixel.
        seed: names the stream of random numbers; different tuples give independent noise.
    """
    import mitsuba

    film_sensor = mitsuba.load_dict(sensor(camera))
    most = max(1, PASS // (camera.width * camera.height))
    total = np.zeros((camera.height, camera.width, 4))
    for number, start in enumerate(range(0, samples, most)):
        count = min(most, samples - start)
        stream = int(np.random.SeedSequence((*seed, number)).generate_state(1)[0])
        image = mitsuba.render(scene, sensor=film_sensor, spp=count, seed=stream)  # pyright: ignore[reportArgumentType]
        total += count * np.asarray(image, dtype=np.float64)
    return (total / samples).astype(np.float32)


def _objects(value: Any, key: str = "") -> Any:
    """The same tree of dictionaries with Mitsuba's objects in place of arrays."""
    import mitsuba

    if isinstance(value, dict):
        return {name: _objects(item, name) for name, item in value.items()}
    if not isinstance(value, np.ndarray):
        return value
    if key == "to_world":
        return mitsuba.ScalarTransform4f(value)
    image = mitsuba.Bitmap(np.ascontiguousarray(value, dtype=np.float32))
    return image if key == "bitmap" else {"type": "bitmap", "bitmap": image, "raw": True}


def _fog(fog: Fog) -> dict[str, Any]:
    import mitsuba

    lo, size = np.asarray(fog.lo), np.asarray(fog.hi) - np.asarray(fog.lo)
    unit_to_world = np.diag([*size, 1.0])
    unit_to_world[:3, 3] = lo
    cube_to_world = np.diag([*(size / 2), 1.0])
    cube_to_world[:3, 3] = lo + size / 2
    grid = np.ascontiguousarray(fog.extinction.transpose(2, 1, 0)[..., None], dtype=np.float32)
    extinction = {"type": "gridvolume", "grid": mitsuba.VolumeGrid(grid), "to_world": mitsuba.ScalarTransform4f(unit_to_world)}
    return {
        "type": "cube",
        "to_world": mitsuba.ScalarTransform4f(cube_to_world),
        "bsdf": {"type": "null"},
        "interior": {
            "type": "heterogeneous",
            "sigma_t": extinction,
            "albedo": {"type": "constvolume", "value": {"type": "rgb", "value": list(fog.albedo)}},
            "phase": {"type": "hg", "g": fog.anisotropy},
        },
    }
