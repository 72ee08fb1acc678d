"""What a fit's clocks say about it: costs, shares of the processor, and warnings."""

import json
from pathlib import Path

import pytest
from training_fixtures import SMALL

import invgraphics as ig
from invgraphics.core import Model
from invgraphics.experiments.clocks import LEAST_SHARE, PictureClock, disturbance, fit_costs, load_average, processor_share
from invgraphics.experiments.evaluate import evaluate_run
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.runs.fit import FitRecord
from invgraphics.runs.schema import from_table
from invgraphics.testing import TwoBalls, toy_scene
from invgraphics.training.clock import SchedulerTimes


@pytest.mark.parametrize(
    ("record", "share"),
    [
        ({"ran_seconds": 6.0, "waited_seconds": 2.0}, 0.75),
        ({"ran_seconds": 6.0, "waited_seconds": 2.0, "load_average": {"end": 50.0}, "cores": 2}, 0.75),
        ({"ran_seconds": None, "waited_seconds": None, "load_average": {"end": 4.0}, "cores": 2}, 0.5),
        ({"load_average": {"end": 1.0}, "cores": 2}, 1.0),
        ({"load_average": {"end": None}, "cores": 2}, None),
        ({}, None),
    ],
)
def test_share_of_the_processor(record: dict, share: float | None) -> None:
    assert processor_share(from_table(FitRecord, record, Path("fit.json"))) == share


def test_runs_from_before_have_no_share() -> None:
    """Their ``fit.json`` holds steps and seconds only."""
    assert fit_costs(FitRecord(steps=7, seconds=1.5)) == {
        "fit_seconds": 1.5,
        "fit_cpu_seconds": None,
        "fit_processor_share": None,
        "fit_standstill_seconds": None,
        "fit_processor_speed": None,
        "steps": 7,
        "peak_memory_bytes": None,
    }


def test_what_is_disturbed() -> None:
    assert disturbance({}) == disturbance({"fit_processor_share": LEAST_SHARE, "fit_standstill_seconds": 0.0}) == ""
    busy = "had 61 % of the processor time that it was ready to use; other programs had the rest"
    still = "stood still for 3 min 12 s, which are not counted: it was stopped, or the machine suspended"
    assert disturbance({"fit_processor_share": 0.614}) == busy
    assert disturbance({"fit_processor_share": 0.9, "fit_standstill_seconds": 192.0}) == still
    assert disturbance({"fit_processor_share": 0.614, "fit_standstill_seconds": 192.0}) == f"{busy}, and {still}"
    drawn = "rendered its pictures with 60 % of the processor time that it was ready to use"
    assert disturbance({"fit_processor_share": 0.9, "render_processor_share": 0.6}) == drawn
    assert disturbance({"fit_processor_share": 0.614, "render_processor_share": 0.6}) == f"{busy}, and {drawn}"
    assert disturbance({"fit_processor_share": 0.9, "render_processor_share": LEAST_SHARE}) == ""


DRAWN = "rendered its pictures with 60 % of the processor time that it was ready to use"


def test_the_clock_of_pictures_is_checked_whenever_they_are_rendered(
    toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fit had its processor for itself: what was wrong with the pictures' clock is said, and not of a later evaluation."""
    overrides = tuple(SMALL["splatting/gaussians"])
    given = {"method": "splatting/gaussians", "scene": str(toy_folder), "budget": "2steps", "overrides": overrides}
    run = fit_run(FitRequest(out=str(tmp_path / "run"), **given))
    record = json.loads((run / "fit.json").read_text()) | {"ran_seconds": 6.0, "waited_seconds": 0.0}
    (run / "fit.json").write_text(json.dumps(record))
    monkeypatch.setattr(SchedulerTimes, "seconds", lambda self: (0.3, 0.2))
    assert evaluate_run(run).disturbed == DRAWN
    assert json.loads((run / "scores.json").read_text())["cost"]["render_processor_share"] == pytest.approx(0.6)
    fitted = ig.load_run(run)
    assert fitted.evaluate().record.disturbed == DRAWN
    in_memory = ig.fit(fitted.method, fitted.scene, budget="2steps")
    monkeypatch.setattr(in_memory.fit, "clocks", lambda: record)
    assert in_memory.scores.record.disturbed == DRAWN
    monkeypatch.setattr(SchedulerTimes, "seconds", lambda self: (0.3, 0.0))
    assert evaluate_run(run).disturbed == ""
    assert json.loads((run / "scores.json").read_text())["cost"]["render_processor_share"] == 1.0


@pytest.mark.parametrize(
    ("picture", "whole", "share"),
    [((0.03, 0.04), (0.05, 0.06), None), ((0.03, 0.04), (2.0, 1.0), 2 / 3), ((0.05, 0.15), (2.0, 1.0), 0.25)],
)
def test_short_pictures_are_judged_by_what_they_are_spread_over(
    monkeypatch: pytest.MonkeyPatch, picture: tuple[float, float], whole: tuple[float, float], share: float | None
) -> None:
    """One stroke of another program is most of a few hundredths of a second; below 0.2 s in all nothing is said."""
    scene = toy_scene(views=2, size=8)
    model = Model(TwoBalls(), VolumetricConfig(StratifiedConfig(4)).build(scene), scene.bounds)
    clock, windows = PictureClock(), iter((picture, whole))
    monkeypatch.setattr(SchedulerTimes, "seconds", lambda self: next(windows))
    clock.render(model, scene.test[0].camera)
    assert clock.processor_share == (None if share is None else pytest.approx(share))


@pytest.mark.skipif(not Path("/proc/loadavg").exists(), reason="only Linux tells it independently")
def test_load_average_is_that_of_the_machine() -> None:
    assert load_average() == pytest.approx(float(Path("/proc/loadavg").read_text().split()[0]), abs=1.0)
