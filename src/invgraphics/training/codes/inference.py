"""Inference of unseen instances of a class from their views: the codes are optimised, everything else is frozen.

It runs in the one fitting loop (`invgraphics.training.fit`), over a model whose only parameters are the codes.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Conditional, Model, Scene, View
from invgraphics.training.batches import BatchConfig
from invgraphics.training.budget import Budget
from invgraphics.training.codes.penalty import CodePenalty
from invgraphics.training.fit import Fit, Plan
from invgraphics.training.losses import PhotometricLoss
from invgraphics.training.optimiser import GroupConfig, OptimiserConfig


@dataclass(frozen=True)
class CodeInference:
    """Settings of the inference of codes.

    Attributes:
        steps: of Adam.
        lr: learning rate at the start.
        final: at the end.
        rays: of a step, for each instance.
        foreground: share of them on pixels with alpha.
        weight: of the codes' Gaussian prior beside the mean squared error.
        seed: of the rays and backgrounds.
    """

    steps: int = 200
    lr: float = 2e-2
    final: float = 2e-3
    rays: int = 256
    foreground: float = 0.5
    weight: float = 1e-3
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.steps, self.rays) < 1:
            raise ValueError("steps and rays must be at least 1.")


def infer_codes(
    model: Model, scene: Scene, views: Sequence[Sequence[View]], config: CodeInference | None = None
) -> Float[Tensor, "k c"]:
    """Codes of k instances from views of each, all at once; they start at the class's mean code.

    Args:
        model: of a class; it is not changed.
        scene: the class, for bounds, background and colour space.
        views: of each of the instances, at least one; every instance gets an equal share of the rays only with equally many.
        config: settings; ``None`` for the defaults.
    """
    config = config or CodeInference()
    frozen = copy.deepcopy(model)
    for part in frozen.parts.values():
        part.requires_grad_(False)
    assert isinstance(frozen.field, Conditional)
    start = frozen.field.mean_code().expand(len(views), -1)
    rows = torch.repeat_interleave(torch.arange(len(views)), torch.tensor([len(own) for own in views]))
    field = frozen.field.with_codes(start, rows.to(model.device))
    observed = tuple(view for own in views for view in own)
    plan = Plan(
        model=replace(frozen, field=field),
        scene=replace(scene, train=observed, val=(), observed=()),
        losses=(PhotometricLoss(),),
        penalties=(CodePenalty(config.weight),),
        hooks=(),
        optimiser=OptimiserConfig({"codes": GroupConfig("field.codes", config.lr, config.final)}),
        batches=BatchConfig(config.rays * len(views), len(observed), foreground=config.foreground),
        budget=Budget.parse(f"{config.steps}steps"),
        seed=config.seed,
        device=model.device,
    )
    Fit(plan).run(lambda loss: False)
    return field.codes.detach()
