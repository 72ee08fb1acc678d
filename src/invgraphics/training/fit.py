"""The one fitting loop: any field through any renderer, within a budget."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as default
from typing import Any

import torch
from torch import Tensor, nn

from invgraphics.core import Batch, Context, Model, RayRenderer, Rendering, Scene, Trace
from invgraphics.core.finite import describe_non_finite
from invgraphics.errors import InputError, NumericalError
from invgraphics.kernels.allocator import keep_freed_memory
from invgraphics.kernels.openmp import limit_spinning
from invgraphics.training.batches import BatchConfig, Batches
from invgraphics.training.budget import Budget
from invgraphics.training.checks import check_results, check_term, check_values
from invgraphics.training.clock import SchedulerTimes, SpeedProbe
from invgraphics.training.hooks import FitState, Hook, generator_state, load_prefixed, prefixed
from invgraphics.training.losses import Loss
from invgraphics.training.optimiser import Optimiser, OptimiserConfig, allow_sparse_gradients
from invgraphics.training.penalties import Penalty, check_penalty
from invgraphics.training.poses import Poses, coarse_to_fine_encodings
from invgraphics.training.views.exposure import Exposures


@dataclass(frozen=True)
class Plan:
    """Everything a fit is made of.

    Attributes:
        model: field and renderer that are fitted.
        scene: training views, bounds and background.
        losses: their sum, and that of the penalties, is minimised.
        hooks: called around each step, in order.
        optimiser: parameter groups and Adam's settings.
        batches: size of a step.
        budget: when to stop.
        seed: of all randomness during the fit.
        device: where tensors live.
        poses: of the training cameras, where they are fitted too.
        penalties: of field and renderer alone.
        exposures: of the training views, where they are fitted too.
    """

    model: Model
    scene: Scene
    losses: Sequence[Loss]
    hooks: Sequence[Hook]
    optimiser: OptimiserConfig
    batches: BatchConfig
    budget: Budget
    seed: int = 0
    device: torch.device = default(default_factory=lambda: torch.device("cpu"))
    poses: Poses | None = None
    penalties: Sequence[Penalty] = ()
    exposures: Exposures | None = None

    @property
    def modules(self) -> dict[str, nn.Module]:
        """Modules with parameters, by the prefixes of the parameters' names."""
        own = {"poses": self.poses, "exposure": self.exposures}
        return self.model.parts | {name: module for name, module in own.items() if module is not None}


class Fit:
    """A fit in progress: `step` advances it; `state` and `load` resume it after an interruption, bit-exactly on a CPU.

    Attributes:
        plan: what is fitted, and how.
        steps: number of steps taken.
        seconds: wall time of these steps.
        loss: of the latest step.
        idle_losses: numbers of the losses that the first step gave nothing to act on, so that they are 0 without a gradient.
    """

    def __init__(self, plan: Plan) -> None:
        if not plan.losses and not plan.penalties:
            raise InputError("The recipe has neither losses nor penalties: there is nothing to fit.")
        for hook in plan.hooks:
            if not isinstance(hook, Hook):
                raise InputError(f"The hook {_name(hook)} is no training.hooks.Hook.", "Derive it from that class.")
            hook.check(plan.model.field)
            hook.check_fit(plan.model.field, plan.model.renderer)
        for penalty in plan.penalties:
            check_penalty(penalty, plan.model.field)
        keep_freed_memory()
        limit_spinning()
        self.plan = plan
        self.steps = 0
        self.seconds = 0.0
        self.idle_losses: tuple[int, ...] = ()
        self.loss: float | None = None
        self.resume_clocks({})
        self._bounds = plan.scene.bounds.to(plan.device)
        self._generator = torch.Generator().manual_seed(plan.seed)
        self._batches = Batches(plan.batches, plan.scene, self._generator, plan.device, plan.poses)
        self._coarse_to_fine = [] if plan.poses is None else coarse_to_fine_encodings(plan.model)
        self._optimiser = self._make_optimiser()

    def _make_optimiser(self) -> Optimiser:
        parameters = {
            f"{owner}.{name}": parameter
            for owner, module in self.plan.modules.items()
            for name, parameter in module.named_parameters()
            if parameter.requires_grad
        }
        self._trainable = bool(parameters)
        optimiser = Optimiser(self.plan.optimiser, parameters, self.plan.scene.extent)
        for owner, module in self.plan.modules.items():
            allow_sparse_gradients(module, owner, optimiser)
        return optimiser

    @property
    def model(self) -> Model:
        """What is being fitted, as it is now."""
        return self.plan.model

    @property
    def progress(self) -> float:
        """Share of the budget that is spent; 1 where there is nothing to fit."""
        return self.plan.budget.progress(self.seconds, self.steps) if self._trainable else 1.0

    def context(self) -> Context:
        """Context of the next training step."""
        return Context(self._bounds, training=True, progress=self.progress, generator=self._generator)

    def step(self) -> float:
        """One optimisation step: draw a batch, render, composite, sum all terms, backpropagate, update. Returns the loss.

        Raises:
            NumericalError: the loss is not finite; names the step and the first tensor, rendering or loss that is not.
        """
        began, cpu_began = time.perf_counter(), time.process_time()
        plan, ctx = self.plan, self.context()
        state = FitState(plan.model.field, plan.model.renderer, self._optimiser, plan.scene, ctx, self.steps, poses=plan.poses)
        self._optimiser.set_progress(ctx.progress)
        self._set_coarse_to_fine(ctx.progress)
        for hook in plan.hooks:
            hook.before_step(state)
        rendering, trace, batch = self._render(ctx)
        if self.steps == 0:
            check_values(rendering, trace, batch, plan.model)
        composited = _mask_rendering(replace(rendering, rgb=rendering.over(batch.background)), batch)
        losses = [check_term(loss(composited, trace, batch, ctx), loss, "loss") for loss in plan.losses]
        parts = plan.model.field, plan.model.renderer, ctx
        losses += [check_term(penalty(*parts), penalty, "penalty") for penalty in plan.penalties]
        terms = torch.stack(losses)
        if self.steps == 0:
            idle = (index for index, value in enumerate(losses[: len(plan.losses)]) if not value.requires_grad)
            self.idle_losses = tuple(idle)
        loss = terms.sum()
        value = loss.item()
        if not torch.isfinite(loss):
            raise NumericalError(self._first_not_finite(rendering, terms))
        self._optimiser.zero_grad()
        if loss.requires_grad:
            loss.backward()
        state.rendering, state.trace, state.batch = rendering, trace, batch
        for hook in plan.hooks:
            hook.after_backward(state)
        self._optimiser.step()
        for hook in plan.hooks:
            hook.after_step(state)
        plan.model.renderer.update(plan.model.field, ctx)
        self.steps, self.loss = self.steps + 1, value
        if plan.device.type == "cuda":
            torch.cuda.synchronize(plan.device)
        self._advance_clocks(time.perf_counter() - began, time.process_time() - cpu_began)
        if plan.device.type == "cpu":
            self._speed.probe_at(self.seconds)
        return value

    def _advance_clocks(self, seconds: float, cpu_seconds: float) -> None:
        """Add a step's wall and CPU time to the clocks, without a standstill."""
        still = self._scheduler.standstill(seconds, cpu_seconds) if self.plan.device.type == "cpu" else 0.0
        self.standstill_seconds += still
        self.seconds += seconds - still
        self.cpu_seconds += cpu_seconds

    def _set_coarse_to_fine(self, progress: float) -> None:
        for encoding in self._coarse_to_fine:
            if encoding.window_alpha is not None and self.plan.poses is not None:
                encoding.window_alpha.fill_(self.plan.poses.config.alpha(progress))

    def _render(self, ctx: Context) -> tuple[Rendering, Trace, Batch]:
        renderer, fitted, exposures = self.plan.model.renderer, self.plan.model.field, self.plan.exposures
        if isinstance(renderer, RayRenderer):
            rays, batch = self._batches.rays(ctx.progress)
            views = rays.view
            rendering, trace = check_results(renderer.render_rays(fitted, rays, ctx), renderer)
            self._batches.observe(0 if trace.samples is None else len(trace.samples))
        else:
            camera, batch = self._batches.image(ctx.progress)
            views = batch.view
            rendering, trace = check_results(renderer.render_image(fitted, camera, ctx), renderer)
        if exposures is not None:
            rendering, trace = exposures.expose(rendering, trace, views)
        return rendering, trace, batch

    def _first_not_finite(self, rendering: Rendering, terms: Tensor) -> str:
        """A sentence that names the first values that are not finite: parameters first, then the rendering, then the losses."""
        modules = self.plan.modules.items()
        parts: dict[str, dict[str, Tensor]] = {owner: dict(module.named_parameters()) for owner, module in modules}
        parts["rendering"] = {"rgb": rendering.rgb, "alpha": rendering.alpha}
        names = [type(term).__name__ for term in (*self.plan.losses, *self.plan.penalties)]
        broken = [name for name, term in zip(names, terms.tolist(), strict=True) if not math.isfinite(term)]
        where = (
            describe_non_finite(parts) or f"the loss is not finite ({', '.join(broken) or 'the sum of ' + ', '.join(names)})"
        )
        return f"Step {self.steps}: {where}; the fit stops here."

    def warmup_step(self) -> None:
        """Take one step and restore the state before it, so that compiling and allocating at first use is on no clock."""
        before = {part: {name: value.clone() for name, value in tensors.items()} for part, tensors in self.state().items()}
        clocks, seconds = self.clocks(), self.seconds
        self.step()
        self.load(before, seconds)
        self.resume_clocks(clocks)

    def clocks(self) -> dict[str, float | None]:
        """Clock readings of the fit by name, as `resume_clocks` takes them.

        ``seconds`` and ``cpu_seconds`` (of all threads) of the steps; ``standstill_seconds`` excluded because the process stood
        still; ``ran_seconds`` and ``waited_seconds`` of busy threads since the fit began (``None`` where the system reports
        none); ``processor_speed`` and ``speed_probes`` of the `SpeedProbe` (``None`` on other devices).
        """
        here = self._scheduler.seconds()
        ran, waited = (None, None) if here is None else (self._earlier[0] + here[0], self._earlier[1] + here[1])
        return {
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
            "ran_seconds": ran,
            "waited_seconds": waited,
            "standstill_seconds": self.standstill_seconds,
            "processor_speed": self._speed.speed,
            "speed_probes": self._speed.probes,
        }

    def resume_clocks(self, record: Mapping[str, Any]) -> None:
        """Continue from a record of `clocks`, but for ``seconds``, which `load` takes."""
        self.cpu_seconds = float(record.get("cpu_seconds") or 0.0)
        self.standstill_seconds = float(record.get("standstill_seconds") or 0.0)
        self._earlier = float(record.get("ran_seconds") or 0.0), float(record.get("waited_seconds") or 0.0)
        self._scheduler = SchedulerTimes()
        self._speed = SpeedProbe(float(record.get("processor_speed") or 0.0), int(record.get("speed_probes") or 0))

    def set_budget(self, budget: Budget) -> None:
        """Replace the budget; what hooks have begun and learning rates that were restarted stay so at the same step."""
        before = self.progress
        self.plan = replace(self.plan, budget=budget)
        self._optimiser.move_restart(self.progress / before if before else 1.0)
        for hook in self.plan.hooks:
            hook.rescale_progress(before, self.progress)

    def run(self, after_step: Callable[[float], bool]) -> None:
        """Step until the budget is spent or ``after_step(loss)`` returns True."""
        while self.progress < 1 and not after_step(self.step()):
            pass

    def state(self) -> dict[str, dict[str, Tensor]]:
        """Every tensor of the fit, by section; no clock readings."""
        return {
            **{owner: dict(module.state_dict()) for owner, module in self.plan.modules.items()},
            "optimiser": self._optimiser.state(),
            "hooks": prefixed(self.plan.hooks),
            "batches": self._batches.state(),
            "random": generator_state(self._generator),
            "fit": {"steps": torch.tensor(self.steps)},
        }

    def load(self, state: dict[str, dict[str, Tensor]], seconds: float) -> None:
        """Resume from a `state`; ``seconds`` is the optimisation time already spent."""
        for owner, module in self.plan.modules.items():
            module.load_state_dict(state.get(owner, {}))
        self._optimiser = self._make_optimiser()
        self._optimiser.load(state.get("optimiser", {}))
        load_prefixed(self.plan.hooks, state.get("hooks", {}))
        self._batches.load(state["batches"])
        self._generator.set_state(state["random"]["fit"].cpu())
        torch.set_rng_state(state["random"]["global"].cpu())
        self.steps, self.seconds = int(state["fit"]["steps"]), seconds


def _mask_rendering(rendering: Rendering, batch: Batch) -> Rendering:
    """Replace masked-out pixels by the ground truth: no loss has a gradient there, window-based ones (SSIM) included."""
    if batch.mask is None:
        return rendering
    rgb = torch.where(batch.mask[..., None], rendering.rgb, batch.target)
    return replace(rendering, rgb=rgb, alpha=torch.where(batch.mask, rendering.alpha, batch.alpha))


def _name(part: object) -> str:
    return f"{type(part).__module__}.{type(part).__name__}"
