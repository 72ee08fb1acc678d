"""``invgraphics infer``: infer unseen instances of a class of objects, from held-out views or from a photograph."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from invgraphics.cli.arguments import refuse_idle
from invgraphics.errors import InputError
from invgraphics.runs.collection import runs_of


@dataclass(frozen=True, kw_only=True)
class Infer:
    """Infer unseen instances of a class of objects with a fitted prior: only their codes are optimised.

    Without a photograph: the class's unseen instances, from their first observed views; their test views are scored beside the
    class mean, the nearest training instance and, on request, fits without a prior. Writes a page with pictures and intervals.
    The same command again keeps what is finished; other --views and --instances are added to it.

    With a photograph: the instance that it shows. Its camera has the class's lens and is that of --view, or else looks at the
    middle of the class from --azimuth and --elevation. Writes a picture of it from around, with normals, and its code.

    Attributes:
        folder: The folder of a fit to a class (`invgraphics fit prior/srn chairs`), or of a comparison or study of such fits.
        photo: A photograph of one object, before the scene's background or with alpha.
        views: Without a photograph: numbers of observed views from which instances are inferred.
        test_views: Without a photograph: test views of each instance that are scored.
        instances: Without a photograph: unseen instances, the first ones.
        against: Without a photograph: other fits to the same class to compare with, or comparisons and studies of them.
        no_prior: Without a photograph: also fit each instance without the prior, for so long (20s, 600steps).
        view: The photograph's camera is that of this view of the class.
        azimuth: The photograph's camera: angle around the vertical axis, from +x towards +y.
        elevation: The photograph's camera: angle above the horizon.
        steps: Steps of the optimisation of the codes.
        scene: Another copy of the class, for instance where the data set has moved.
        out: Where to write.
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    photo: Annotated[Positional[Path | None], arg(metavar="[PHOTO]", help_behavior_hint="(default: the unseen instances)")] = (
        None
    )
    views: Annotated[str | None, arg(metavar="N,N", help_behavior_hint="(default: 1)")] = None
    test_views: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 4)")] = None
    instances: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: all)")] = None
    against: Annotated[str | None, arg(metavar="RUN,RUN", help_behavior_hint="(default: none)")] = None
    no_prior: Annotated[str | None, arg(metavar="BUDGET", help_behavior_hint="(default: none)")] = None
    view: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: the angles)")] = None
    azimuth: Annotated[float | None, arg(metavar="DEGREES", help_behavior_hint="(default: -60)")] = None
    elevation: Annotated[float | None, arg(metavar="DEGREES", help_behavior_hint="(default: 25)")] = None
    steps: Annotated[int, arg(metavar="N")] = 200
    scene: Annotated[str | None, arg(metavar="SCENE", help_behavior_hint="(default: the run's own)")] = None
    out: Annotated[
        Path | None, arg(metavar="FOLDER|FILE.png", help_behavior_hint="(default: RUN-inferred, PHOTO-inferred.png)")
    ] = None

    def run(self) -> int:
        """Infer; prints what was found and where it was written. Returns exit status 0."""
        self._refuse_idle()
        others = tuple(Path(one) for one in (self.against or "").split(",") if one)
        runs = [run for folder in (self.folder, *others) for run in runs_of(folder)]
        if self.photo is not None:
            if len(runs) > 1:
                raise InputError(f"{self.folder} holds {len(runs)} runs.", f"Give one, for instance {runs[0]}.")
            return self._infer_photo(self.photo, runs[0])
        views, tests = self._view_counts(), 4 if self.test_views is None else self.test_views
        out = self.folder.with_name(f"{self.folder.name}-inferred") if self.out is None else self.out

        from invgraphics.report.inference import build_inference_report, inference_sentences
        from invgraphics.tools.infer import InferRequest, infer

        infer(InferRequest(self.folder, out, others, views, tests, self.instances, self.no_prior, self.steps, self.scene))
        page = build_inference_report(out)
        for sentence in inference_sentences(out):
            print(sentence)
        print(page)
        return 0

    def _refuse_idle(self) -> None:
        """Refuse options of the other use, with or without a photograph, and angles beside a named view."""
        angles = {"--azimuth": self.azimuth, "--elevation": self.elevation}
        if self.photo is None:
            refuse_idle({"--view": self.view, **angles}, "without a photograph")
            return
        ours = {"--views": self.views, "--test-views": self.test_views, "--instances": self.instances}
        refuse_idle({**ours, "--against": self.against, "--no-prior": self.no_prior}, "with a photograph")
        if self.view is not None:
            refuse_idle(angles, "with --view, whose camera is the photograph's")

    def _view_counts(self) -> tuple[int, ...]:
        try:
            return tuple(int(word) for word in (self.views or "1").split(","))
        except ValueError:
            raise InputError(f"--views cannot be '{self.views}'.", "Expected numbers, separated by commas: 1,2,4,8.") from None

    def _infer_photo(self, photo: Path, run: Path) -> int:
        out = Path(f"{photo.stem}-inferred.png") if self.out is None else self.out

        from invgraphics.tools.infer_photo import PhotoRequest, infer_photo

        azimuth = -60.0 if self.azimuth is None else self.azimuth
        elevation = 25.0 if self.elevation is None else self.elevation
        placed = (self.view, azimuth, elevation, self.steps, self.scene)
        print(f"the photograph is reproduced at {infer_photo(PhotoRequest(run, photo, out, *placed)):.2f} dB")
        print(out)
        return 0
