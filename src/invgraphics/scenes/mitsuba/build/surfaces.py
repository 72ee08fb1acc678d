"""Materials and studio lights, as Mitsuba dictionaries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

Colour = tuple[float, float, float]

ENVIRONMENT_SIZE = (64, 128)


def rgb(code: str) -> Colour:
    """Linear colour of a display colour ``"#rrggbb"``."""
    values = [int(code[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    r, g, b = ((value + 0.055) ** 2.4 / 1.055**2.4 if value > 0.04045 else value / 12.92 for value in values)
    return r, g, b


def to_linear(srgb: Float[np.ndarray, "*p"]) -> Float[np.ndarray, "*p"]:
    """Display sRGB in [0, 1] to linear values."""
    return np.where(srgb > 0.04045, ((srgb + 0.055) / 1.055) ** 2.4, srgb / 12.92)


def matte(colour: Colour | np.ndarray) -> dict[str, Any]:
    """A diffuse surface; an array (h, w, 3) is a texture of linear values."""
    return {"type": "diffuse", "reflectance": _spectrum(colour)}


def plastic(colour: Colour | np.ndarray, roughness: float = 0.15) -> dict[str, Any]:
    """Coloured plastic under a clear coat."""
    return {"type": "roughplastic", "diffuse_reflectance": _spectrum(colour), "alpha": roughness, "nonlinear": True}


def metal(name: str, roughness: float) -> dict[str, Any]:
    """A rough conductor with the measured index of refraction of ``Au``, ``Cu``, ``Al`` …"""
    return {"type": "roughconductor", "material": name, "alpha": roughness, "distribution": "ggx"}


def glass(index: float = 1.5) -> dict[str, Any]:
    """Clear glass."""
    return {"type": "dielectric", "int_ior": index, "ext_ior": 1.0}


def two_sided(material: dict[str, Any]) -> dict[str, Any]:
    """The same material on both sides of a thin sheet."""
    return {"type": "twosided", "bsdf": material}


def _spectrum(colour: Colour | np.ndarray) -> dict[str, Any] | np.ndarray:
    return colour if isinstance(colour, np.ndarray) else {"type": "rgb", "value": list(colour)}


@dataclass(frozen=True)
class Softbox:
    """A round light at infinity with a soft rim.

    Attributes:
        azimuth: direction from +x towards +y, degrees.
        elevation: above the horizon, degrees.
        width: angular radius, degrees.
        radiance: linear rgb.
    """

    azimuth: float
    elevation: float
    width: float
    radiance: Colour


THREE_POINT = (
    Softbox(-60, 50, 28, (4.5, 4.3, 4.0)),
    Softbox(70, 35, 30, (1.3, 1.4, 1.6)),
    Softbox(175, 40, 22, (2.2, 2.3, 2.5)),
)
"""Key, fill and rim."""


def studio(
    boxes: tuple[Softbox, ...] = THREE_POINT,
    sky: Colour = (0.5, 0.52, 0.55),
    floor: Colour = (0.36, 0.35, 0.34),
    exposure: float = 1.0,
) -> dict[str, Any]:
    """Lights of a photo studio, painted into an environment: seen in reflections, hidden from the camera.

    Args:
        boxes: the lamps.
        sky: radiance from straight above.
        floor: radiance from straight below.
        exposure: factor on all of it.
    """
    rows, columns = ENVIRONMENT_SIZE
    theta = (np.arange(rows) + 0.5)[:, None] / rows * np.pi
    phi = (np.arange(columns) + 0.5)[None] / columns * 2 * np.pi
    # Mitsuba's environment in its own frame (+y up), turned about x so that +z is up.
    direction = np.stack(np.broadcast_arrays(np.sin(phi) * np.sin(theta), np.cos(phi) * np.sin(theta), np.cos(theta)), axis=-1)
    upness = 0.5 + 0.5 * direction[..., 2:]
    image = upness * np.array(sky) + (1 - upness) * np.array(floor)
    for lamp in boxes:
        a, e = np.radians(lamp.azimuth), np.radians(lamp.elevation)
        towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        angle = np.degrees(np.arccos(np.clip(direction @ towards, -1, 1)))
        rim = np.clip((1.15 * lamp.width - angle) / (0.3 * lamp.width), 0, 1)
        image = image + (rim * rim * (3 - 2 * rim))[..., None] * np.array(lamp.radiance)
    turn = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    return {"type": "envmap", "bitmap": (exposure * image).astype(np.float32), "to_world": turn}
