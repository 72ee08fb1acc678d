"""What an inferred instance of a class is compared with: no prior, the class mean, the nearest training instance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

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

Observed = Mapping[int, Sequence[View]]
"""Instance -> the views that are known of it."""


def without_prior(method: Method, scene: Scene, observed: Observed, budget: Budget, seed: int = 0) -> dict[int, Model]:
    """Fit the same field and renderer to each instance's views alone: a class of one, from scratch."""
    models = {}
    batches = replace(method.recipe.batches, rays=min(method.recipe.batches.rays, RAYS))
    few = replace(method, recipe=replace(method.recipe, batches=batches))
    for subject, views in observed.items():
        alone = replace(scene, train=tuple(views), val=(), observed=())
        fit = Fit(build_plan(few, alone, budget, seed, torch.device("cpu")))
        fit.run(lambda loss: False)
        models[subject] = fit.model
    return models


def class_mean(model: Model, observed: Observed) -> dict[int, Model]:
    """The instance of the mean code, whatever is observed."""
    assert isinstance(model.field, Conditional)
    mean = replace(model, field=model.field.at(model.field.mean_code()))
    return dict.fromkeys(observed, mean)


def nearest_instance(model: Model, scene: Scene, observed: Observed) -> dict[int, Model]:
    """The training instance whose pictures, by the model, are closest to the observed views: retrieval instead of inference."""
    assert isinstance(model.field, Conditional)
    trained = [replace(model, field=model.field.at(code)) for code in model.field.codes.detach()]
    found = {}
    for subject, views in observed.items():
        errors = [sum(photometric_error(one, view, scene, SEARCH_SCALE) for view in views) for one in trained]
        found[subject] = trained[min(range(len(trained)), key=errors.__getitem__)]
    return found
