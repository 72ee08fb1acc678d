"""Procedural patterns: smooth noise in any dimension, and pictures made of it. Values in [0, 1], colours linear."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from invgraphics.scenes.mitsuba.build.surfaces import Colour, rgb

Image = Float[np.ndarray, "h w 3"]


def value_noise(shape: Sequence[int], cells: int | Sequence[int], rng: np.random.Generator) -> np.ndarray:
    """Random values on a lattice of ``cells`` (per axis), interpolated smoothly."""
    counts = [cells] * len(shape) if isinstance(cells, int) else list(cells)
    values = rng.random([count + 2 for count in counts])
    for axis, (size, count) in enumerate(zip(shape, counts, strict=True)):
        place = (np.arange(size) + 0.5) / size * count
        index = place.astype(int)
        part = place - index
        weight = (part * part * (3 - 2 * part)).reshape([-1 if other == axis else 1 for other in range(len(shape))])
        values = values.take(index, axis) * (1 - weight) + values.take(index + 1, axis) * weight
    return values


def fractal(shape: Sequence[int], cells: int, octaves: int, rng: np.random.Generator) -> np.ndarray:
    """Octaves of `value_noise`, each twice as fine and half as strong; stretched to [0, 1]."""
    total = sum(value_noise(shape, cells * 2**octave, rng) / 2**octave for octave in range(octaves))
    total = np.asarray(total)
    return (total - total.min()) / (total.max() - total.min())


def ramp(values: Float[np.ndarray, "*p"], colours: Sequence[Colour]) -> Float[np.ndarray, "*p 3"]:
    """Colours along a palette, at values in [0, 1]."""
    stops = np.linspace(0, 1, len(colours))
    return np.stack([np.interp(values, stops, [colour[channel] for colour in colours]) for channel in range(3)], axis=-1)


def wood(size: tuple[int, int], boards: int, rng: np.random.Generator, dark: str = "#7a4a26", light: str = "#c48a52") -> Image:
    """Boards that run along the picture's width, each with its own tone and grain."""
    height, width = size
    rows = np.arange(height) * boards / height
    tone = rng.random(boards)[rows.astype(int)][:, None]
    grain = value_noise(size, (max(height // 4, 1), max(width // 64, 1)), rng)
    values = 0.15 + 0.5 * tone + 0.3 * grain
    seam = np.abs(rows - np.round(rows)) < 1.2 * boards / height
    return ramp(np.where(seam[:, None], 0.0, values), [rgb("#3b2210"), rgb(dark), rgb(light), rgb(light)])


def checkers(size: int, squares: int, first: Colour, second: Colour) -> Image:
    """A chessboard."""
    index = np.arange(size) * squares // size
    return np.where(((index[:, None] + index) % 2 == 0)[..., None], np.array(first), np.array(second))


def confetti(size: int, palette: Sequence[Colour], rng: np.random.Generator, shapes: int = 70) -> Image:
    """A picture no part of which occurs twice: noise under discs and bars of many sizes, for feature matching."""
    image = ramp(fractal((size, size), 5, 5, rng), palette[:3])
    y, x = np.mgrid[:size, :size] / size
    for _ in range(shapes):
        cx, cy, turn = rng.random(), rng.random(), rng.random() * np.pi
        a, b = 0.015 + 0.12 * rng.random(2) ** 2
        u, v = (x - cx) * np.cos(turn) + (y - cy) * np.sin(turn), (y - cy) * np.cos(turn) - (x - cx) * np.sin(turn)
        inside = (u / a) ** 2 + (v / b) ** 2 < 1 if rng.random() < 0.5 else (np.abs(u) < a) & (np.abs(v) < b)
        image[inside] = np.array(palette[int(rng.integers(len(palette)))]) * (0.5 + 0.5 * rng.random())
    return image * (0.75 + 0.25 * fractal((size, size), 24, 3, rng))[..., None]
