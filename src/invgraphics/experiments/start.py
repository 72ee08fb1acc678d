"""What a fit of explicit primitives starts from, and what it may grow to."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import torch

from invgraphics.core import Field
from invgraphics.errors import InputError
from invgraphics.experiments.fitted import load_fitted
from invgraphics.experiments.folder import RunFolder
from invgraphics.experiments.recipe import Method
from invgraphics.training.fit import Plan

COPIES = 6
"""Of each primitive's values during a step: parameter, gradient, Adam's two moments; activated, and the gradient of that."""
SCREEN_BYTES = 300
"""Of a primitive on the screen: footprint, its gradients, packed row and sums; rounded up from two threads."""


def started(plan: Plan, method: Method, scene_spec: str) -> Plan:
    """The plan, beginning with the converted field of the run that the recipe's ``field.source`` names, if it names one.

    Raises:
        InputError: there is no such run, it shows another scene, or its field cannot be converted.
    """
    config = method.recipe.field
    source = getattr(config, "source", "")
    if not source:
        return plan
    folder = RunFolder(Path(source))
    shown = str(folder.read_json("provenance.json")["scene"])
    if Path(shown).resolve() != Path(scene_spec).resolve():
        raise InputError(f"field.source: {source} is a run on '{shown}', not on '{scene_spec}'.")
    source_field = load_fitted(folder, plan.scene).field
    torch.manual_seed(plan.seed)  # loading the source has drawn its own initial values
    return replace(plan, field=config.converted(source_field, plan.scene).to(plan.device))


def memory_forecast(field: Field, method: Method) -> str:
    """What the most primitives that the fit may make will need, in words; nothing for fields without primitives.

    Raises:
        InputError: more than this machine has.
    """
    now = field.primitive_count()
    if not now:
        return ""
    most = max(now, *(int(getattr(hook, "max_primitives", 0)) for hook in method.recipe.hooks), 0)
    row = sum(parameter[0].numel() * parameter.element_size() for parameter in field.parameters())
    needed = most * (COPIES * row + SCREEN_BYTES)
    on_gpu = next(field.parameters()).device.type == "cuda"
    has = (
        torch.cuda.get_device_properties(0).total_memory if on_gpu else os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    )
    if needed > has:
        sentence = f"{most:,} primitives need about {needed / 1e9:.1f} GB of memory, and this machine has {has / 1e9:.1f} GB."
        raise InputError(sentence, "Choose a lower --max-primitives.")
    return f" with up to {most:,} primitives in about {needed / 1e6:.0f} MB"
