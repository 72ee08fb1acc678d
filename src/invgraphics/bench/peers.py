"""Third-party implementations on the same machine, in the same run: nerfstudio, Dr.Jit, Mitsuba and torch's grid sampler.

The torch-only tile rasteriser is our own reference, which every run measures anyway.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from invgraphics import kernels
from invgraphics.bench import lattice_cases
from invgraphics.bench.case import Run
from invgraphics.bench.lattice_cases import GATE_POINTS, LAYOUTS, TORCH, torch_sampler
from invgraphics.bench.results import BOTH, FORWARD, PEERS, Measurement, Results, Skipped
from invgraphics.bench.sample_cases import BASE, FINEST, ray_ordered
from invgraphics.bench.sample_cases import GATE as HASH_GATE
from invgraphics.bench.splat_cases import GATE as SPLAT_GATE
from invgraphics.bench.splat_cases import forward_backward, splat_pipeline, without_gradient
from invgraphics.bench.timing import Timing, TimingBudget, alternate
from invgraphics.bench.workload import activated, camera, gaussian_field
from invgraphics.core.ngp import HashGrid

GROWTH = (FINEST / BASE) ** (1 / (HASH_GATE["levels"] - 1))
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Mitsuba's cameras have x to the left and y up, ours x to the right and y down."""
SHELL = 3.0
"""Standard deviations at which Mitsuba truncates a Gaussian."""


class MissingError(Exception):
    """A peer is not available here; the message says why."""


def peers(budget: TimingBudget, results: Results) -> None:
    """Time installed peers in alternation with our kernels; record why others are skipped."""
    ours = kernels.in_use()
    encoders: dict[str, dict[str, Run]] = {ours: _our_hash()}
    for name, make in {"nerfstudio (torch)": _nerfstudio, "Dr.Jit (LLVM)": _drjit}.items():
        _add(encoders, f"{name} hash encoding", name, make, results)
    look_ups = 8.0 * HASH_GATE["levels"] * HASH_GATE["points"]
    for direction, passes in ((FORWARD, 1), (BOTH, 2)):
        timings = alternate({name: runs[direction] for name, runs in encoders.items()}, budget)
        results.measurements += [
            _row(f"{PEERS}: hash encoding", name, direction, HASH_GATE, timing, passes * look_ups, "look-ups")
            for name, timing in timings.items()
        ]
    pictures: dict[str, dict[str, Run]] = {ours: _our_splats()}
    _add(pictures, "Mitsuba's volprim_rf_basic", "Mitsuba (ray traced)", _mitsuba, results)
    timings = alternate({name: runs[FORWARD] for name, runs in pictures.items()}, budget)
    pixels = float(SPLAT_GATE["width"] ** 2)
    results.measurements += [
        _row(f"{PEERS}: picture of Gaussians", name, FORWARD, SPLAT_GATE, timing, pixels, "pixels")
        for name, timing in timings.items()
    ]


def lattice_peers(budget: TimingBudget, results: Results) -> None:
    """Time torch's grid sampler in alternation with `kernels.lattice_encode`, on the layouts that promises are made for."""
    ours = kernels.in_use()
    for name, layout in LAYOUTS.items():
        samplers = {ours: lattice_cases.ours(layout, GATE_POINTS), TORCH: torch_sampler(layout, GATE_POINTS)}
        for direction in (FORWARD, BOTH):
            timings = alternate({who: runs[direction] for who, runs in samplers.items()}, budget)
            results.measurements += [
                _row(f"{PEERS}: {name}", who, direction, layout.sizes(GATE_POINTS), timing, float(GATE_POINTS), "points")
                for who, timing in timings.items()
            ]


def _row(
    operation: str, name: str, direction: str, sizes: dict[str, int], timing: Timing, amount: float, unit: str
) -> Measurement:
    return Measurement(operation, name, direction, sizes, torch.get_num_threads(), timing, amount, unit)


def _add(runs: dict[str, dict[str, Run]], what: str, name: str, make: Callable[[], dict[str, Run]], results: Results) -> None:
    try:
        made = make()
        for run in made.values():
            run()
    except MissingError as missing:
        results.skipped.append(Skipped(what, str(missing)))
    except Exception as error:  # a failing peer must not end the run
        first = (str(error).splitlines() or [""])[0]
        results.skipped.append(Skipped(what, f"it failed: {type(error).__name__}: {first}"))
    else:
        runs[name] = made


def _our_hash() -> dict[str, Run]:
    grid = HashGrid(HASH_GATE["levels"], 2, HASH_GATE["log2_size"], BASE, FINEST)
    table, unit = torch.rand(grid.entries, 2).requires_grad_(), ray_ordered(HASH_GATE["points"])
    encode = lambda: kernels.hash_encode(unit, table, grid)[0]  # noqa: E731
    return {FORWARD: without_gradient(encode), BOTH: forward_backward(encode, [table])}


def _our_splats() -> dict[str, Run]:
    gaussians, viewpoint = activated(gaussian_field(SPLAT_GATE["gaussians"])), camera(SPLAT_GATE["width"])
    return {FORWARD: without_gradient(lambda: splat_pipeline(gaussians, viewpoint))}


def _nerfstudio() -> dict[str, Run]:
    """Hash encoding by nerfstudio's HashEncoding in plain torch (its CUDA one needs a GPU), forward and backward."""
    try:
        from nerfstudio.field_components.encodings import HashEncoding  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise MissingError(
            f"not installed ({error}); `pip install nerfstudio` in an environment of its own: it pins an older viser"
        ) from None
    encoding = HashEncoding(
        num_levels=HASH_GATE["levels"],
        min_res=BASE,
        max_res=FINEST,
        log2_hashmap_size=HASH_GATE["log2_size"],
        features_per_level=2,
        implementation="torch",
    )
    unit = ray_ordered(HASH_GATE["points"])
    encode = lambda: encoding(unit)  # noqa: E731
    return {FORWARD: without_gradient(encode), BOTH: forward_backward(encode, list(encoding.parameters()))}


def _use_llvm() -> None:
    """Point Dr.Jit to an LLVM that works (a wrong one would end the process) and give it as many threads as torch has."""
    from invgraphics.scenes.mitsuba import llvm

    status = llvm.status()
    if status.library is None:
        raise MissingError(f"{status.reason} {status.remedy}".strip())
    os.environ[llvm.VARIABLE] = status.library
    try:
        import drjit
    except ImportError as error:
        raise MissingError(f"not installed ({error})") from None
    drjit.set_thread_count(torch.get_num_threads())


def _drjit() -> dict[str, Run]:
    """Hash encoding by Dr.Jit's HashGridEncoding on its LLVM backend, forward and backward."""
    _use_llvm()
    import drjit
    from drjit.llvm.ad import Array3f, Float

    if not hasattr(drjit.nn, "HashGridEncoding"):
        raise MissingError("this version of Dr.Jit has no hash grid")
    levels, size = HASH_GATE["levels"], 1 << HASH_GATE["log2_size"]
    encoding: Any = drjit.nn.HashGridEncoding(
        Float, 3, n_levels=levels, hashmap_size=size, base_resolution=BASE, per_level_scale=GROWTH
    )
    unit = Array3f(ray_ordered(HASH_GATE["points"]).numpy().T)
    weights = [Float(1.0 + k) for k in range(encoding.n_output_features)]
    drjit.eval(unit, encoding.data)

    def forward() -> None:
        with drjit.suspend_grad():
            drjit.eval(encoding(unit))
        drjit.sync_thread()

    def both() -> None:
        drjit.enable_grad(encoding.data)
        drjit.set_grad(encoding.data, 0)
        weighted: Any = sum(w * f for w, f in zip(weights, encoding(unit), strict=True))
        drjit.backward(drjit.sum(weighted))
        drjit.eval(drjit.grad(encoding.data))
        drjit.sync_thread()

    return {FORWARD: forward, BOTH: both}


def _mitsuba() -> dict[str, Run]:
    """Forward rendering of the same Gaussians by Mitsuba's ray tracer of volumetric primitives, one ray per pixel."""
    _use_llvm()
    try:
        import mitsuba
    except ImportError as error:
        raise MissingError(f"not installed ({error})") from None
    from invgraphics.scenes.mitsuba.llvm import FAST

    mitsuba.set_variant(FAST)
    scene = mitsuba.load_dict(_mitsuba_scene(mitsuba))

    def forward() -> None:
        # The image is evaluated lazily; reading it forces evaluation.
        np.asarray(mitsuba.render(scene, spp=1))

    return {FORWARD: forward}


def _mitsuba_scene(mitsuba: Any) -> dict[str, object]:
    gaussians, viewpoint = activated(gaussian_field(SPLAT_GATE["gaussians"])), camera(SPLAT_GATE["width"])
    numpy = lambda x: np.ascontiguousarray(x.detach().numpy())  # noqa: E731
    tensor = lambda x: mitsuba.TensorXf(numpy(x))  # noqa: E731
    w_last: Tensor = torch.nn.functional.normalize(gaussians.quaternions, dim=1).roll(-1, dims=1)
    field_of_view = float(np.degrees(2 * np.arctan(viewpoint.width / (2 * float(viewpoint.focal[0])))))
    return {
        "type": "scene",
        "integrator": {"type": "volprim_rf_basic", "srgb_primitives": False},
        "sensor": {
            "type": "perspective",
            "fov": field_of_view,
            "fov_axis": "x",
            "to_world": mitsuba.ScalarTransform4f(viewpoint.cam_to_world.double().numpy() @ FLIP),
            "film": {"type": "hdrfilm", "width": viewpoint.width, "height": viewpoint.height, "rfilter": {"type": "box"}},
        },
        "gaussians": {
            "type": "ellipsoids",
            "centers": tensor(gaussians.means),
            "scales": tensor(gaussians.scales),
            "quaternions": tensor(w_last),
            "opacities": tensor(gaussians.opacities[:, None]),
            "sh_coeffs": tensor(gaussians.sh.flatten(1)),
            "extent": SHELL,
        },
    }
