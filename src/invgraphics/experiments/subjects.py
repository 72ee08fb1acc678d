"""Classes of objects: the check that method and scene agree on them, and the models of unseen instances."""

from __future__ import annotations

from dataclasses import dataclass, replace

from invgraphics.core import Conditional, Field, Model, Renderer, Scene, View
from invgraphics.errors import InputError
from invgraphics.renderers.occupancy import OccupancyGridSampler
from invgraphics.scenes.mitsuba.spec import class_names
from invgraphics.training.codes.inference import CodeInference, infer_codes

OBSERVED = 1
"""Observed views of each unseen instance from which a run's scores infer it."""


def check_subjects(field: Field, renderer: Renderer, scene: Scene, method: str) -> None:
    """Check that a class of objects meets a field with codes, and a single subject one without.

    An occupancy grid would cover the mean code's cells only, and cull those of the instances.

    Raises:
        InputError: names the method and the scene.
    """
    conditional = isinstance(field, Conditional)
    if scene.is_class and not conditional:
        count = len({view.subject for view in scene.train})
        raise InputError(
            f"{method} fits one subject, and '{scene.name}' is a class of {count} to train on.",
            "Choose a method with a prior, such as prior/srn, or one of its instances (Scene.of_subject).",
        )
    if conditional and not scene.is_class:
        raise InputError(
            f"{method} learns a prior over a class of objects, and '{scene.name}' shows one subject.",
            f"Scenes of classes: {', '.join(class_names())}; or an .npz with the key 'subject'.",
        )
    if conditional and any(isinstance(part, OccupancyGridSampler) for part in renderer.modules()):
        raise InputError(
            f"{method} shows many subjects, and an occupancy grid holds the empty space of one.",
            "Choose another sampler, such as renderer.sampler.type = 'stratified'.",
        )


@dataclass(frozen=True, eq=False)
class UnseenInstances:
    """Models of the unseen instances of a class, each inferred from observed views.

    Attributes:
        models: by the instance's number.
    """

    models: dict[int, Model]

    @staticmethod
    def infer(model: Model, scene: Scene, views: int = OBSERVED, config: CodeInference | None = None) -> UnseenInstances:
        """Infer every instance that the test views show, from its first ``views`` observed views, all at once.

        Raises:
            InputError: an instance has fewer.
        """
        assert isinstance(model.field, Conditional)
        subjects = sorted({view.subject for view in scene.test if view.subject is not None})
        observed = [[view for view in scene.observed if view.subject == subject][:views] for subject in subjects]
        if few := [subject for subject, own in zip(subjects, observed, strict=True) if len(own) < views]:
            raise InputError(f"Instance {few[0]} of '{scene.name}' has fewer than {views} observed views.")
        codes = infer_codes(model, scene, observed, config)
        fields = (model.field.at(code) for code in codes)
        return UnseenInstances({subject: replace(model, field=field) for subject, field in zip(subjects, fields, strict=True)})

    def of(self, view: View) -> Model:
        """The model of the instance that a view shows."""
        assert view.subject is not None
        return self.models[view.subject]
