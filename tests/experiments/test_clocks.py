"""What a fit's clocks say about it: costs, shares of the processor, and warnings."""

from pathlib import Path

import pytest

from invgraphics.experiments.clocks import LEAST_SHARE, disturbance, fit_costs, load_average, processor_share
from invgraphics.runs.fit import FitRecord
from invgraphics.runs.schema import from_table


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


@pytest.mark.skipif(not Path("/proc/loadavg").exists(), reason="only Linux tells it independently")
def test_load_average_is_that_of_the_machine() -> None:
    assert load_average() == pytest.approx(float(Path("/proc/loadavg").read_text().split()[0]), abs=1.0)
