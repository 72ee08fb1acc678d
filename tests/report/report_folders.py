"""Small, honest folders: ray-traced truth, three degradations of it as methods, scores computed from both."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from made_up_runs import provenance_table
from PIL import Image

WIDTH, HEIGHT, VIEWS = 96, 64, 6
METHODS = ("volumetric/nerf", "volumetric/hash", "splatting/gaussians")
SEEDS = (0, 1)
BUDGET_SECONDS = 60.0


@dataclass(frozen=True)
class Frame:
    """What a camera sees: straight colour in [0, 1], alpha, depth and normals."""

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    normal: np.ndarray

    def over_white(self) -> np.ndarray:
        return np.round((self.rgb * self.alpha[..., None] + 1 - self.alpha[..., None]).clip(0, 1) * 255).astype(np.uint8)


def truth_frame(view: int) -> Frame:
    """Three striped balls on white, seen from a circle about them."""
    angle = 2 * math.pi * view / VIEWS
    eye = np.array([4 * math.cos(angle), 4 * math.sin(angle), 1.5])
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0, 0, 1]) / np.linalg.norm(np.cross(forward, [0, 0, 1]))
    down = np.cross(forward, right)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    plane = np.stack([(x - WIDTH / 2) / 80, (y - HEIGHT / 2) / 80, np.ones_like(x)], axis=-1)
    ray = plane @ np.stack([right, down, forward])
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    depth, normal, rgb = np.full(x.shape, np.inf), np.zeros((*x.shape, 3)), np.zeros((*x.shape, 3))
    for centre, radius, colour in (
        ((0.7, 0, 0), 0.6, (0.85, 0.3, 0.2)),
        ((-0.5, 0.6, 0.1), 0.7, (0.2, 0.5, 0.8)),
        ((-0.3, -0.8, -0.2), 0.5, (0.95, 0.75, 0.2)),
    ):
        to_centre = np.array(centre) - eye
        along = ray @ to_centre
        gap = along**2 - to_centre @ to_centre + radius**2
        t = along - np.sqrt(gap.clip(0))
        hit = (gap > 0) & (t < depth)
        point = eye + t[..., None] * ray
        n = (point - np.array(centre)) / radius
        shade = 0.35 + 0.65 * (n @ np.array([0.4, -0.3, 0.87])).clip(0)
        stripes = 0.75 + 0.25 * np.sign(np.sin(14 * point[..., 2]) * np.sin(9 * point[..., 0]))
        depth = np.where(hit, t, depth)
        normal = np.where(hit[..., None], n, normal)
        rgb = np.where(hit[..., None], np.array(colour) * (shade * stripes)[..., None], rgb)
    return Frame(rgb, np.isfinite(depth).astype(float), depth, normal)


def degraded(truth: Frame, method: str, seed: int, view: int, worse: float = 1.0) -> Frame:
    """What a method might predict: blurred (nerf), noisy (hash), or blotchy in depth (gaussians); ``worse`` scales it."""
    from scipy.ndimage import gaussian_filter

    noise = np.random.default_rng(1000 * seed + view + 10 * len(method))
    blur, grain, warp = {METHODS[0]: (1.1, 0.01, 0.02), METHODS[1]: (0.5, 0.02, 0.05), METHODS[2]: (0.7, 0.005, 0.1)}[method]
    blur, grain = blur * (1 + 0.1 * seed) * worse, grain * worse
    alpha = gaussian_filter(truth.alpha, blur)
    premultiplied = gaussian_filter(truth.rgb * truth.alpha[..., None], (blur, blur, 0))
    rgb = premultiplied / np.maximum(alpha, 1e-3)[..., None] + grain * noise.standard_normal(truth.rgb.shape)
    bumps = warp * gaussian_filter(noise.standard_normal(truth.depth.shape), 3) * 8
    depth = np.where(alpha >= 0.5, np.where(np.isfinite(truth.depth), truth.depth, 4.0) * (1 + bumps), np.inf)
    normal = gaussian_filter(truth.normal, (blur, blur, 0)) + warp * noise.standard_normal(truth.normal.shape)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6) * (alpha >= 0.5)[..., None]
    return Frame(rgb.clip(0, 1), alpha, depth, normal)


def psnr(truth: np.ndarray, image: np.ndarray) -> float:
    return -10 * math.log10(((truth / 255.0 - image / 255.0) ** 2).mean())


def view_scores(truth: Frame, prediction: Frame) -> dict[str, float]:
    from flip_evaluator import evaluate
    from skimage.metrics import structural_similarity

    a, b = truth.over_white(), prediction.over_white()
    both = (truth.alpha >= 0.5) & (prediction.alpha >= 0.5)
    cosine = (truth.normal * prediction.normal).sum(-1)[both].clip(-1, 1)
    options: dict[str, Any] = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    flip = evaluate(a.astype(np.float32) / 255, b.astype(np.float32) / 255, "LDR", applyMagma=False)[1]
    solid_a, solid_b = truth.alpha >= 0.5, prediction.alpha >= 0.5
    return {
        "psnr": psnr(a, b),
        "ssim": float(structural_similarity(a, b, channel_axis=-1, data_range=255, **options)),
        "flip": float(flip),
        "depth_abs_rel": float(np.abs(1 - prediction.depth[both] / truth.depth[both]).mean()),
        "normal_deg": float(np.degrees(np.arccos(cosine)).mean()),
        "alpha_iou": float((solid_a & solid_b).sum() / (solid_a | solid_b).sum()),
    }


DIRECTIONS = {
    "psnr": ("dB", True),
    "ssim": ("", True),
    "flip": ("", False),
    "depth_abs_rel": ("", False),
    "normal_deg": ("°", False),
    "alpha_iou": ("", True),
}


def quality(per_view: list[dict[str, float]]) -> dict[str, Any]:
    table = {}
    for key in per_view[0]:
        values = [scores[key] for scores in per_view]
        unit, higher = DIRECTIONS[key]
        table[key] = {"mean": sum(values) / len(values), "unit": unit, "higher_is_better": higher, "per_view": values}
    return table


def root_of(run: Path) -> Path:
    """The folder that holds ``runs/``."""
    return next(parent.parent for parent in run.parents if parent.name == "runs")


def write_run(
    folder: Path, truth: list[Frame], digest: str, method: str, seed: int, worse: float = 1.0, scene: str = "balls"
) -> None:
    (folder / "test").mkdir(parents=True)
    predictions = [degraded(frame, method, seed, view, worse) for view, frame in enumerate(truth)]
    for view, frame in enumerate(predictions):
        Image.fromarray(frame.over_white()).save(folder / "test" / f"{view:04d}.png")
        arrays: dict[str, Any] = {"rgb": (frame.rgb * frame.alpha[..., None]).astype(np.float16), "alpha": frame.alpha}
        np.savez_compressed(
            folder / "test" / f"{view:04d}.npz", depth=frame.depth.astype(np.float32), normal=frame.normal, **arrays
        )
    position = METHODS.index(method)
    per_view = [view_scores(a, b) for a, b in zip(truth, predictions, strict=True)]
    cost = {
        "fit_seconds": BUDGET_SECONDS + 0.01 * (position + seed),
        "steps": (900, 2600, 700)[position] + seed,
        "render_seconds_per_view": (0.9, 0.16, 0.031)[position],
        "render_fps": 1 / (0.9, 0.16, 0.031)[position],
        "peak_memory_bytes": (310e6, 240e6, 520e6)[position] + 1e6 * seed,
        "model_bytes": (1_190_000, 12_600_000, 4_700_000)[position],
        "parameters": (297_000, 3_150_000, 1_180_000)[position],
        "primitives": (None, None, 20_000)[position],
    }
    scores = {
        "schema": 1,
        "method": method,
        "preset": "laptop",
        "scene": scene,
        "seed": seed,
        "protocol": "default",
        "views": [f"{view:04d}" for view in range(len(truth))],
        "quality": quality(per_view),
        "cost": cost,
        "skipped": {"ms_ssim": "needs 161 pixels along the shorter side", "lpips": "the lpips extra is not installed"},
    }
    (folder / "scores.json").write_text(json.dumps(scores))
    provenance = provenance_table(
        method=method,
        seed=seed,
        truth_sha256=digest,
        truth=os.path.relpath(root_of(folder) / "truth" / digest[:16], folder),
        cameras_sha256="c0ffee" * 10,
        scene=scene,
        recipe_sha256=hashlib.sha256(method.encode()).hexdigest(),
        command=f"invgraphics fit {method} balls --budget 60s --seed {seed} --out runs/x",
    )
    (folder / "provenance.json").write_text(json.dumps(provenance))
    environment = {"cpu": "A test machine", "threads": 2, "torch": "2.13", "python": "3.11"}
    (folder / "environment.json").write_text(json.dumps(environment))
    (folder / "recipe.toml").write_text(f'method = "{method}"\n')
    lines = []
    first, last = truth[0].over_white().astype(float), predictions[0].over_white().astype(float)
    for seconds in (0.5, 1, 2, 4, 8, 15, 25, 40, 60):
        share = 1 - math.exp(-seconds * (0.05, 0.25, 0.12)[position])
        value = psnr(first, first.mean((0, 1)) * (1 - share) + last * share) + 0.2 * seed
        lines.append(
            json.dumps({"step": int(seconds * 10), "seconds": seconds, "progress": seconds / 60, "loss": 0.1, "psnr": value})
        )
        lines.append(
            json.dumps({"step": int(seconds * 10) + 1, "seconds": seconds + 0.1, "progress": seconds / 60, "loss": 0.1})
        )
    (folder / "history.jsonl").write_text("\n".join(lines) + "\n")


def baseline_quality(truth: list[Frame], guess: Callable[[int], np.ndarray]) -> dict[str, Any]:
    values = [psnr(frame.over_white(), guess(view)) for view, frame in enumerate(truth)]
    return {"psnr": {"mean": sum(values) / len(values), "unit": "dB", "higher_is_better": True, "per_view": values}}


def write_truth(root: Path, truth: list[Frame]) -> str:
    """Store the truth's pictures and maps below ``root``; returns their hash."""
    pictures = [frame.over_white() for frame in truth]
    digest = hashlib.sha256(b"".join(picture.tobytes() for picture in pictures)).hexdigest()
    place = root / "truth" / digest[:16]
    place.mkdir(parents=True)
    for view, frame in enumerate(truth):
        Image.fromarray(pictures[view]).save(place / f"{view:04d}.png")
        np.savez_compressed(place / f"{view:04d}.npz", depth=frame.depth, normal=frame.normal, alpha=frame.alpha)
    return digest


def write_comparison(root: Path) -> Path:
    truth = [truth_frame(view) for view in range(VIEWS)]
    pictures = [frame.over_white() for frame in truth]
    digest = write_truth(root, truth)
    runs = []
    for method in METHODS:
        for seed in SEEDS:
            runs.append(f"runs/{method.replace('/', '-')}/seed-{seed}")
            write_run(root / runs[-1], truth, digest, method, seed)
    mean = np.stack(pictures).mean(0)
    table = {
        "schema": 1,
        "scene": "balls",
        "question": "Given 60 s each, how well do three methods show new views of three balls, at what cost?",
        "methods": list(METHODS),
        "seeds": list(SEEDS),
        "budget": "60s",
        "size": [WIDTH, HEIGHT],
        "preset": "laptop",
        "summaries": {METHODS[0]: "An MLP with frequency encoding, rendered by quadrature."},
        "command": f"invgraphics compare balls --methods {','.join(METHODS)} --budget 60s --seeds 0,1 --out report",
        "runs": runs,
        "failures": [],
        "noise_ceiling": 41.7,
        "wall_seconds": 412.0,
        "baselines": {
            "mean image": baseline_quality(truth, lambda _: mean),
            "nearest view": baseline_quality(truth, lambda view: pictures[(view + 1) % VIEWS]),
        },
        "protocol": {
            "name": "default",
            "summary": "8-bit pictures over the scene's background, no crop, mean over views",
            "background": "scene",
            "prediction": "nearest",
            "truth": "nearest",
            "masks": "excluded",
        },
        "scene_info": {
            "train": 40,
            "test": VIEWS,
            "notes": {"summary": "Three striped balls.", "stresses": "Silhouettes.", "resize": "area"},
        },
        "environment": {
            "cpu": "A test machine",
            "threads": 2,
            "torch": "2.13",
            "python": "3.11",
            "invgraphics": "0.1.0",
            "date": "2025-11-21",
        },
    }
    (root / "compare.json").write_text(json.dumps(table))
    return root


STUDY_VIEWS = {"balls": (0, 1, 2), "moons": (3, 4)}
STUDY_SCENES = tuple(STUDY_VIEWS)
STUDY_SEEDS = (0, 1, 2)
STUDY_FACTORS: dict[str, list[Any]] = {"data.train_views": [40, 20], "field.encoding.levels": [8, 12, 16]}
LOST = {5: "failed", 17: "missing"}
PREDICTED = {
    "text": "Half the views cost at least 0.1 dB on moons.",
    "source": "a paper",
    "before": {"data.train_views": 40},
    "after": {"data.train_views": 20},
    "where": {"field.encoding.levels": 8},
    "scenes": ["moons"],
    "high": -0.1,
}


def study_table(cells: Sequence[dict[str, Any]], factors: Mapping[str, list[Any]], **other: Any) -> dict[str, Any]:
    """A ``study.json`` about ``cells``."""
    table = {
        "schema": 1,
        "name": "views-and-levels",
        "question": "What do training views and hash levels do?",
        "design": "factorial",
        "factors": dict(factors),
        "base": {path: levels[0] for path, levels in factors.items()},
        "scenes": list(dict.fromkeys(cell["scene"] for cell in cells)),
        "methods": list(dict.fromkeys(cell["method"] for cell in cells)),
        "seeds": list(dict.fromkeys(cell["seed"] for cell in cells)),
        "budget": "60s",
        "preset": "laptop",
        "size": 96,
        "protocol": {"name": "default", "summary": "8-bit pictures over the scene's background"},
        "command": "invgraphics ablate study.toml --out out",
        "environment": {"cpu": "A test machine", "date": "2025-11-21"},
        "cells": list(cells),
    }
    return table | other


def study_cells(
    scenes: Iterable[str], methods: Iterable[str], seeds: Iterable[int], factors: Mapping[str, list[Any]]
) -> list[dict[str, Any]]:
    """Every cell of a full factorial, done."""
    combinations = itertools.product(scenes, methods, itertools.product(*factors.values()), seeds)
    cells = []
    for index, (scene, method, levels, seed) in enumerate(combinations):
        name = hashlib.sha256(f"{index}".encode()).hexdigest()[:12]
        cell = {"id": name, "scene": scene, "method": method, "seed": seed, "levels": dict(zip(factors, levels, strict=True))}
        cells.append(cell | {"run": f"runs/{name}", "status": "done", "error": None, "seconds": 61.5})
    return cells


def write_study(
    root: Path,
    scenes: Mapping[str, Sequence[int]] = STUDY_VIEWS,
    factors: Mapping[str, list[Any]] = STUDY_FACTORS,
    seeds: Sequence[int] = STUDY_SEEDS,
    lost: Mapping[int, str] = LOST,
) -> Path:
    """One method with pictures; of the cells, ``lost`` says which failed or have not run."""
    truths = {}
    for scene, views in scenes.items():
        truth = [truth_frame(view) for view in views]
        truths[scene] = (truth, write_truth(root, truth))
    cells = study_cells(scenes, METHODS[1:2], seeds, factors)
    for index, cell in enumerate(cells):
        if index in lost:
            error = "The loss is not finite at step 7." if lost[index] == "failed" else None
            cell |= {"status": lost[index], "error": error, "seconds": None}
        else:
            levels = cell["levels"]
            worse = (40 / levels["data.train_views"]) ** 0.5 * (16 / levels.get("field.encoding.levels", 16)) ** 0.1
            write_run(root / cell["run"], *truths[cell["scene"]], cell["method"], cell["seed"], worse, cell["scene"])
    predictions = [PREDICTED] if factors is STUDY_FACTORS else []
    (root / "study.json").write_text(json.dumps(study_table(cells, factors, predictions=predictions)))
    return root


def write_scores(root: Path, cells: Sequence[dict[str, Any]], psnr_of: Callable[[dict[str, Any]], Sequence[float]]) -> None:
    """Run folders that hold scores only: enough for statistics, nothing to draw."""
    for cell in cells:
        if cell["status"] != "done":
            continue
        values = [float(value) for value in psnr_of(cell)]
        run = root / cell["run"]
        run.mkdir(parents=True)
        psnr_score = {"mean": sum(values) / len(values), "unit": "dB", "higher_is_better": True, "per_view": values}
        scores = {"schema": 1, "method": cell["method"], "preset": "laptop", "scene": cell["scene"], "seed": cell["seed"]}
        scores |= {"protocol": "default", "views": [f"{view:04d}" for view in range(len(values))]}
        scores |= {"quality": {"psnr": psnr_score}, "cost": {"fit_seconds": 60.0}, "skipped": {}}
        (run / "scores.json").write_text(json.dumps(scores))
        provenance = provenance_table(truth_sha256=hashlib.sha256(cell["scene"].encode()).hexdigest())
        (run / "provenance.json").write_text(json.dumps(provenance))
        (run / "environment.json").write_text("{}")
        (run / "history.jsonl").write_text("")
