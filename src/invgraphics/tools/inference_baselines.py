"""What an inferred instance of a class is compared with: no prior, the class mean, the nearest training instance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Conditional, Model, Scene, View
from invgraphics.experiments.build import build_plan
from invgraphics.recipes.recipe import Method
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit
from invgraphics.training.localise import photometric_error

SEARCH_SCALE = 0.5
"""Of the pictures in which the nearest instance is searched."""

RAYS = 512
"""Of a step of a fit without a prior, which sees few pixels."""


def without_prior(method: Method, scene: Scene, views: Sequence[View], budget: Budget, device: torch.device) -> Model:
    """Fit the same field and renderer to an instance's views alone: a class of one, from scratch, its code without penalty."""
    batches = replace(method.recipe.batches, rays=min(method.recipe.batches.rays, RAYS))
    few = replace(method, recipe=replace(method.recipe, batches=batches, penalties=()))
    alone = replace(scene, train=tuple(views), val=(), observed=())
    fit = Fit(build_plan(few, alone, budget, 0, device))
    fit.run(lambda loss: False)
    return fit.model


def class_mean(model: Model) -> Model:
    """The instance of the mean code, whatever is observed."""
    assert isinstance(model.field, Conditional)
    return replace(model, field=model.field.at(model.field.mean_code()))


class NearestInstance:
    """Search for the training instance whose pictures, by the model, are closest to views: retrieval instead of inference.

    Args:
        model: of the class.
        scene: the class, for background and colour space.
    """

    def __init__(self, model: Model, scene: Scene) -> None:
        assert isinstance(model.field, Conditional)
        self._scene = scene
        self._trained = [replace(model, field=model.field.at(code)) for code in model.field.codes.detach()]
        self._errors: dict[str, Float[Tensor, " s"]] = {}

    def find(self, views: Sequence[View]) -> Model:
        """The training instance of the smallest mean squared error over the views, whose errors are computed once each."""
        total = torch.stack([self._of(view) for view in views]).sum(dim=0)
        return self._trained[int(total.argmin())]

    def _of(self, view: View) -> Float[Tensor, " s"]:
        if view.name not in self._errors:
            errors = [photometric_error(one, view, self._scene, SEARCH_SCALE) for one in self._trained]
            self._errors[view.name] = torch.tensor(errors, dtype=torch.float64)
        return self._errors[view.name]
