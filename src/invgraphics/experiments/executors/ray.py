"""Ray executor: fits on an existing cluster, or on one started on this machine for the duration.

Each fit is a Ray task that starts the same process as the local executor does. The folders of data and runs must be on a file
system that all nodes share, under the same path; invgraphics must be installed on all of them.
"""

from __future__ import annotations

import os
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

from invgraphics import plugins
from invgraphics.errors import InputError
from invgraphics.experiments.executors.base import Outcome, Resources
from invgraphics.experiments.executors.local import FitProcess
from invgraphics.experiments.request import FitRequest
from invgraphics.interruption import INTERRUPTED

RETRIES = 3
"""How often a fit whose worker or node is lost starts again, from its last checkpoint."""

OBJECT_STORE_BYTES = 100 * 2**20
"""Memory for objects of a cluster of our own: results travel as files, so Ray's smallest sensible store will do."""


class StoppedError(Exception):
    """A fit received a termination signal, as when its node shuts down; another node may resume it."""


class RayExecutor:
    """Runs fits as Ray tasks, as many at a time as the cluster's cores allow."""

    def __init__(self, resources: Resources) -> None:
        try:
            import ray  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise InputError("The executor 'ray' needs the package ray.", 'pip install "invgraphics[ray]"') from None
        self._ray: Any = ray
        self._resources = resources

    def run(self, requests: Sequence[FitRequest], jobs: Path) -> Generator[Outcome, None, None]:
        """See `Executor.run`."""
        jobs = jobs.resolve()
        jobs.mkdir(parents=True, exist_ok=True)
        self._connect()
        try:
            task = self._ray.remote(_fit).options(
                num_cpus=self._resources.threads or 1,
                num_gpus=self._resources.gpus,
                max_retries=RETRIES,
                retry_exceptions=[StoppedError],
                name="invgraphics fit",
                runtime_env={"env_vars": plugins.environment()},
            )
            folder = str(Path.cwd())
            waiting = {task.remote(request, str(jobs), self._resources, folder): request for request in requests}
            while waiting:
                done, _ = self._ray.wait(list(waiting), num_returns=1)
                for reference in done:
                    yield self._outcome(reference, waiting.pop(reference))
        finally:
            # Ray then ends the workers, whose fits see their standard input close and write a checkpoint.
            self._ray.shutdown()

    def _connect(self) -> None:
        address = self._resources.address
        own = {} if address else {"object_store_memory": OBJECT_STORE_BYTES, "include_dashboard": False}
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # telemetry stays off unless the user enables it
        try:
            self._ray.init(address or "local", log_to_driver=False, logging_level="error", **own)
        except (ConnectionError, ValueError, RuntimeError) as error:
            what = f"The Ray cluster at '{address}' cannot be reached" if address else "Ray cannot be started here"
            raise InputError(f"{what}: {str(error).splitlines()[0]}") from error
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        for kind, name, wanted in (("CPU", "cores", self._resources.threads or 1), ("GPU", "GPUs", self._resources.gpus)):
            most = max((node.get(kind, 0) for node in nodes), default=0)
            if most < wanted:
                self._ray.shutdown()
                raise InputError(
                    f"Each fit requests {wanted:g} {name}, and the cluster's largest node has {most:g}.",
                    "Give --jobs, which divides the cores among fits, or --gpus.",
                )

    def _outcome(self, reference: Any, request: FitRequest) -> Outcome:
        try:
            status, error, seconds = self._ray.get(reference)
        except self._ray.exceptions.RayError as failure:
            last = str(failure).strip().splitlines()[-1]
            return Outcome(request, 1, f"The worker was lost {RETRIES + 1} times: {last}", 0.0)
        return Outcome(request, status, error, seconds)


def _fit(request: FitRequest, jobs: str, resources: Resources, folder: str) -> tuple[int, str, float]:
    """Run one fit on a worker. Paths in requests are relative to the driver's ``folder``."""
    for path in (jobs, folder):
        if not Path(path).is_dir():
            return 1, f"A worker cannot access {path}, which must be on a file system that all nodes share.", 0.0
    os.chdir(folder)
    process = FitProcess(request, Path(jobs), resources)
    try:
        outcome = process.wait()
    except BaseException:  # the task was cancelled
        process.stop()
        raise
    if outcome.status == INTERRUPTED:
        raise StoppedError(request.out)
    return outcome.status, outcome.error, outcome.seconds
