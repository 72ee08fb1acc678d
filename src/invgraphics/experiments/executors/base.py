"""The executor interface: resources given, outcomes returned."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from invgraphics.experiments.request import FitRequest


@dataclass(frozen=True, kw_only=True)
class Resources:
    """Compute resources: parallel jobs, threads and GPUs of each fit, the cluster's address.

    Attributes:
        jobs: fits that share this machine at the same time.
        threads: threads of each fit, pinned; ``None`` leaves them to the environment.
        gpus: GPUs of each fit, for executors that hand them out.
        address: of the cluster, for executors that have one; ``None`` for one of their own on this machine.
        logs: whether what a fit writes to its terminal goes into a file instead.
    """

    jobs: int = 1
    threads: int | None = None
    gpus: float = 0.0
    address: str | None = None
    logs: bool = False


@dataclass(frozen=True)
class Outcome:
    """Result of one fit: finished, failed or interrupted.

    Attributes:
        request: of that process.
        status: exit status of its process: 0 done, 130 interrupted, anything else failed.
        error: what went wrong, for a person; empty where nothing did.
        seconds: from the start of its process to the end, evaluation included.
    """

    request: FitRequest
    status: int
    error: str
    seconds: float


class Executor(Protocol):
    """Runs fits, each in a process of its own."""

    def __init__(self, resources: Resources) -> None: ...

    def run(self, requests: Sequence[FitRequest], jobs: Path) -> Generator[Outcome, None, None]:
        """Run all of ``requests``, yield each as it ends, in any order.

        Closing the generator stops the fits that are under way; they leave checkpoints.

        Args:
            requests: each writes a run folder of its own.
            jobs: folder for job files, error messages and logs; created if need be.
        """
        ...
