"""Performance gates: the speed that the project promises, as ratios within one run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from invgraphics.bench import iterations, sample_cases, splat_cases
from invgraphics.bench.lattice_cases import (
    GATE_POINTS,
    LAYOUTS,
    SPARSE_STEP,
    SPEED_UPS,
    STEP,
    STEP_POINTS,
    STEP_SPEED_UP,
    TORCH,
    WHOLE_STEP,
)
from invgraphics.bench.results import BOTH, PEERS, Results


@dataclass(frozen=True)
class Gate:
    """A performance target and its measurement.

    Attributes:
        name: what is promised.
        bound: ``at least`` or ``at most``.
        target: the promised ratio.
        measured: the measured ratio; ``None`` where it was not measured.
    """

    name: str
    bound: Literal["at least", "at most"]
    target: float
    measured: float | None

    @property
    def verdict(self) -> str:
        """PASS, MISS, or a dash without a measurement."""
        if self.measured is None:
            return "-"
        kept = self.measured >= self.target if self.bound == "at least" else self.measured <= self.target
        return "PASS" if kept else "MISS"


def gates(results: Results) -> list[Gate]:
    """All performance gates with the ratios of a run."""
    splat, encode = splat_cases.GATE, sample_cases.GATE
    fast, plain = (results.find("splats", name, BOTH, **splat) for name in ("numba", "reference"))
    raster = results.find("splat_rasterise", "numba", BOTH, **splat)
    hashed = results.find("hash_encode", "numba", BOTH, **encode)
    step = results.find(iterations.SPLAT_STEP, "numba", BOTH, **splat)
    drawing = results.find(iterations.SPLAT_SHARE, "numba", BOTH, **splat)
    whole = results.find(iterations.NERF_STEP, "numba", BOTH, **iterations.NERF_GATE)
    networks = results.find(iterations.NERF_SHARE, "torch", BOTH, **iterations.NERF_GATE)
    at = STEP.sizes(STEP_POINTS)
    whole_grid, rows = (results.find(name, "numba", BOTH, **at) for name in (WHOLE_STEP, SPARSE_STEP))
    size = f"{splat['gaussians'] // 1000}k Gaussians at {splat['width']} x {splat['width']}"
    return [
        Gate(
            f"Splats forward and backward, {size}: times the reference's speed",
            "at least", 25, plain.timing.median / fast.timing.median if fast and plain else None,
        ),
        Gate(f"Splats forward and backward, {size}: share of the exp2 limit", "at least", 0.06, fast.share if fast else None),
        Gate(
            "The same, rasterising alone: share of the exp2 limit",
            "at least", 0.06, raster.share if raster else None,
        ),
        Gate(
            f"Whole splat step, {size}: times the rasteriser's part",
            "at most", 1.7, step.timing.median / drawing.timing.median if step and drawing else None,
        ),
        Gate(
            "Hash encoding forward and backward, 2^15 entries: share of the gather limit",
            "at least", 0.40, hashed.share if hashed else None,
        ),
        Gate(
            "Whole hash-grid step: share of its networks' sample rate",
            "at least", 0.40, whole.rate / networks.rate if whole and networks else None,
        ),
        *(
            Gate(f"{name} forward and backward: times the speed of torch's grid_sample", "at least", promised, ratio)
            for name, promised in SPEED_UPS.items()
            for ratio in [_lattice_ratio(results, name)]
        ),
        Gate(
            f"Step over {STEP.vertices}^3 vertices, sparse gradients: times the speed with whole ones",
            "at least", STEP_SPEED_UP, whole_grid.timing.median / rows.timing.median if whole_grid and rows else None,
        ),
    ]  # fmt: skip


def _lattice_ratio(results: Results, name: str) -> float | None:
    """Time of torch's grid sampler over ours for a layout."""
    at = LAYOUTS[name].sizes(GATE_POINTS)
    ours, theirs = (results.find(f"{PEERS}: {name}", who, BOTH, **at) for who in ("numba", TORCH))
    return theirs.timing.median / ours.timing.median if ours and theirs else None
