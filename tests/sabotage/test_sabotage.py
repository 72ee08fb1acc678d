"""Faults at random moments of commands: afterwards the same command goes on, and ends with the results of an undisturbed one.

``INVGRAPHICS_SABOTAGE`` is the number of moments, of a seed that changes with the day (YYYYMMDD), which
``INVGRAPHICS_SABOTAGE_SEED`` repeats. The test suite takes a handful of fits and reports, of one seed; ``make sabotage`` takes
200 of everything. ``INVGRAPHICS_SABOTAGE_ONLY`` picks some of them
by their numbers, ``19,55,100-149`` for instance.
"""

from __future__ import annotations

import contextlib
import datetime
import itertools
import os
import random
import shutil
import sys
import time
from collections import Counter
from fnmatch import fnmatch
from pathlib import Path

import pytest

pytest.importorskip("resource", reason="signals and locks are POSIX's")

from commands import Case, made, results
from faults import DONE, faults, small_disk

HANDFUL = 6
COUNT = int(os.environ.get("INVGRAPHICS_SABOTAGE", HANDFUL))
TODAY = f"{datetime.datetime.now(datetime.UTC):%Y%m%d}" if "INVGRAPHICS_SABOTAGE" in os.environ else "20261130"
SEED = int(os.environ.get("INVGRAPHICS_SABOTAGE_SEED", TODAY))
ONLY = os.environ.get("INVGRAPHICS_SABOTAGE_ONLY", "")
ON_A_DISK_OF_ITS_OWN = "full disk"


class Undisturbed:
    """A command's results and duration.

    Args:
        case: the command.
        folder: where it runs, twice: what differs then is left out of comparisons, but for what must not differ.
    """

    def __init__(self, case: Case, folder: Path) -> None:
        found, self.seconds = [], 0.0
        for number in range(2):
            place = folder / f"{case.name}-{number}"
            place.mkdir()
            began = time.monotonic()
            process = case.start(place)
            assert process.wait() == DONE, process.said()
            self.seconds = time.monotonic() - began
            found.append(results(place))
            shutil.rmtree(place)
        assert found[0].keys() == found[1].keys()
        self.files = found[0].keys()
        self.same = {name: digest for name, digest in found[0].items() if found[1][name] == digest}
        for pattern in case.results:
            matching = {name for name in self.files if fnmatch(name, pattern)}
            assert matching and matching <= self.same.keys(), f"{case.name}: {matching - self.same.keys()} differ by themselves"

    def check(self, place: Path) -> None:
        """Compare the results in ``place``."""
        found = results(place)
        assert found.keys() == self.files, f"files: {sorted(found.keys() ^ self.files)}"
        different = [name for name, digest in self.same.items() if found[name] != digest]
        assert not different, f"different: {different}"


def disturb(case: Case, fault: str, seconds: float, place: Path, whole: Undisturbed) -> str:
    """One moment; returns what was seen."""
    with contextlib.ExitStack() as stack:
        if fault == ON_A_DISK_OF_ITS_OWN:
            try:
                stack.enter_context(small_disk(place))
            except PermissionError:
                return "skipped: nothing can be mounted here"
        seen = faults()[fault](case, place, seconds)
        process = case.start(place, finish=True)
        assert process.wait() == DONE, f"{seen}, and then it did not go on:\n{process.said()}"
        whole.check(place)
        return f"{seen}, then the same results"


def moments(cases: list[Case], count: int) -> list[tuple[Case, str, float]]:
    """Command, fault and share of the command's duration; each pair as often as any other."""
    chance = random.Random(SEED)
    pairs = list(itertools.product(cases, faults()))
    chance.shuffle(pairs)
    return [(case, fault, chance.random()) for case, fault in itertools.islice(itertools.cycle(pairs), count)]


def chosen(only: str, count: int) -> set[int]:
    """Numbers below ``count`` that a list like ``19,55,100-149`` names; all if it is empty."""
    ranges = [part.partition("-") for part in only.split(",")] if only else [("0", "-", str(count - 1))]
    return {number for first, _, last in ranges for number in range(int(first), int(last or first) + 1) if number < count}


@pytest.mark.timeout(0)
def test_nothing_is_lost(tmp_path: Path) -> None:
    say(f"INVGRAPHICS_SABOTAGE_SEED={SEED} INVGRAPHICS_SABOTAGE={COUNT}")
    cases = [case for case in made(tmp_path) if case.quick or COUNT > HANDFUL]
    wholes: dict[str, Undisturbed] = {}
    tried: Counter[tuple[str, str]] = Counter()
    failed: Counter[tuple[str, str]] = Counter()
    failures = []
    for number, (case, fault, share) in enumerate(moments(cases, COUNT)):
        if number not in chosen(ONLY, COUNT):
            continue
        if case.name not in wholes:
            wholes[case.name] = Undisturbed(case, tmp_path)
        place = tmp_path / f"{number:03}"
        place.mkdir()
        whole = wholes[case.name]
        what = f"#{number} {case.name}, {fault} at {share * whole.seconds:.2f} of {whole.seconds:.2f} s"
        tried[fault, case.name] += 1
        try:
            say(f"{what}: {disturb(case, fault, share * whole.seconds, place, whole)}")
        except AssertionError as error:
            failed[fault, case.name] += 1
            failures.append(f"{what}: {error}")
            say(f"FAILED {failures[-1]}")
        shutil.rmtree(place, ignore_errors=True)
    say(table([case.name for case in cases], tried, failed))
    assert not failures, "\n".join(failures)


def table(names: list[str], tried: Counter[tuple[str, str]], failed: Counter[tuple[str, str]]) -> str:
    """Faults x commands: how many moments went well, of how many."""
    lines = ["".join([f"{'':15}", *(f"{name:>15}" for name in names)])]
    for fault in faults():
        cells = (f"{tried[fault, name] - failed[fault, name]} of {tried[fault, name]}" for name in names)
        lines.append("".join([f"{fault:15}", *(f"{cell:>15}" for cell in cells)]))
    return "\n".join(lines)


def say(text: str) -> None:
    """Print at once."""
    print(text, flush=True, file=sys.stdout)
