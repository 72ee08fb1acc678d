"""Resolved run requests: the one place where a request's text is parsed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from invgraphics.config import fill
from invgraphics.core import Scene
from invgraphics.experiments.build import device_of
from invgraphics.experiments.posed import refined_poses
from invgraphics.experiments.request import DATA, FitRequest
from invgraphics.experiments.variants import RendererVariant, variant_named
from invgraphics.metrics.protocols import Protocol, protocol_named
from invgraphics.recipes.recipe import Method, assign, load_method
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.provenance import Region
from invgraphics.scenes.degrade import TrainingData, degrade
from invgraphics.scenes.open import SceneOptions, longest_edge
from invgraphics.scenes.silhouettes import tightened
from invgraphics.training.budget import Budget, Cadence


@dataclass(frozen=True)
class Job:
    """A `FitRequest` resolved and checked: method, budget, cadence, data and device as typed values.

    Attributes:
        request: as made; values that need no parsing (seed, scene, folders) are read from it.
        method: its recipe, under the request's preset (or its budget's) and overrides.
        budget: of the fit.
        cadence: of its checkpoints.
        data: what is done to the training data.
        device: where it computes.
        options: with which the scene is opened.
        protocol: that scores it.
        variants: renderers that show the fitted field besides its own.
    """

    request: FitRequest
    method: Method
    budget: Budget
    cadence: Cadence
    data: TrainingData
    device: torch.device
    options: SceneOptions
    protocol: Protocol
    variants: tuple[RendererVariant, ...] = ()

    @staticmethod
    def of(request: FitRequest, method: Method | None = None) -> Job:
        """Resolve a request.

        Args:
            request: of the fit.
            method: its method, where it has been resolved before.

        Raises:
            InputError: a method, preset, key, value, budget, interval, protocol or device is unknown or cannot be read.
        """
        protocol = protocol_named(request.protocol)
        budget, cadence = Budget.parse(request.budget), Cadence.parse(request.checkpoint_every)
        method = method or load_method(request.method, request.preset, request.recipe_overrides, budget)
        return Job(
            request=request,
            method=method,
            budget=budget,
            cadence=cadence,
            data=_training_data(request),
            device=device_of(request.device),
            options=SceneOptions(size=request.size, test_views=request.test_views, spp=request.spp),
            protocol=protocol,
            variants=tuple(variant_named(name, method.preset) for name in request.render_with),
        )

    @property
    def recipe_digests(self) -> tuple[str, ...]:
        """SHA-256 of every recipe that makes the same fit, this one's first (see `Method.equivalent_digests`)."""
        return self.method.equivalent_digests(longest_edge(self.request.scene, self.options.size))

    @property
    def folder(self) -> RunFolder:
        """The run's folder."""
        return RunFolder(Path(self.request.out))

    @property
    def protocols(self) -> tuple[str, ...]:
        """Names of the protocols that score the run; the default one is last, and its scores mark the run as finished."""
        return tuple(dict.fromkeys([self.protocol.name, "default"]))

    def unscored(self) -> list[str]:
        """Protocols of which the folder holds no scores."""
        return [protocol for protocol in self.protocols if not self.folder.scores_path(protocol).is_file()]


def make_training_scene(job: Job, scene: Scene) -> Scene:
    """Make the scene that a job's fit sees: degraded as requested, in the box of its silhouettes unless poses are in doubt.

    Args:
        job: of the fit.
        scene: as loaded.

    Raises:
        InputError: the scene cannot be changed like this.
    """
    shown = degrade(scene, job.data, job.request.seed)
    in_doubt = job.data.pose_noise or refined_poses(job.method) is not None
    return shown if in_doubt or job.data.box == "scene" else tightened(shown)


def region_of(scene: Scene) -> Region | None:
    """Corners of a scene's box as plain numbers; ``None`` in endless space."""
    if scene.bounds.space != "box":
        return None
    (a, b, c), (d, e, f) = scene.bounds.lo.tolist(), scene.bounds.hi.tolist()
    return (a, b, c), (d, e, f)


def in_region(scene: Scene, region: Region | None) -> Scene:
    """Return a scene in the box in which a run was fitted, with the data set's as `data_bounds`; as it is without a region."""
    if region is None or region == region_of(scene):
        return scene
    lo, hi = (torch.tensor(corner) for corner in region)
    return replace(scene, bounds=replace(scene.bounds, lo=lo, hi=hi), data_bounds=scene.data_bounds or scene.bounds)


def _training_data(request: FitRequest) -> TrainingData:
    table: dict[str, Any] = {}
    assign(table, request.data_overrides)
    return fill(TrainingData, table.get(DATA.rstrip("."), {}), DATA.rstrip("."))
