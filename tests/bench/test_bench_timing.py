"""The clock: order of calls, repetitions, medians and quartiles."""

import pytest

from invgraphics.bench import timing
from invgraphics.bench.timing import Timing, TimingBudget, alternate


@pytest.fixture
def clockwork(monkeypatch: pytest.MonkeyPatch):
    """Time that passes only when told to."""
    now = [0.0]
    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])
    calls: list[str] = []

    def variant(name: str, seconds: float):
        def work() -> None:
            calls.append(name)
            now[0] += seconds

        return work

    return calls, variant


def test_variants_take_turns(clockwork) -> None:
    calls, variant = clockwork
    alternate({"a": variant("a", 0.125), "b": variant("b", 0.125)}, TimingBudget(0.375, 1, 10))
    assert "".join(calls) == "ab" + "ababab"


def test_a_slow_variant_is_repeated_less(clockwork) -> None:
    calls, variant = clockwork
    found = alternate({"slow": variant("s", 2.0), "fast": variant("f", 0.1)}, TimingBudget(1.0, 2, 5))
    assert "".join(calls) == "sf" + "sf" + "sf" + "fff"
    assert (found["slow"].repetitions, found["fast"].repetitions) == (2, 5)
    assert found["slow"].median == pytest.approx(2.0) and found["fast"].median == pytest.approx(0.1)


@pytest.mark.parametrize("compiling", [0.5, 30.0])
def test_a_first_call_that_compiles_does_not_count(clockwork, compiling: float) -> None:
    """However long it takes: neither as a repetition nor to choose how many there are."""
    calls, variant = clockwork
    first, later = variant("c", compiling), variant("w", 0.1)
    found = alternate({"x": lambda: later() if calls else first()}, TimingBudget(1.0, 3, 9))
    assert found["x"].high == pytest.approx(0.1) and found["x"].repetitions == 9


def test_median_and_quartiles() -> None:
    assert Timing.of([5.0, 1.0, 2.0, 4.0, 3.0]) == Timing(3.0, 2.0, 4.0, 5)
    assert Timing.of([8.0, 16.0]).per(4) == Timing(3.0, 2.5, 3.5, 2)
