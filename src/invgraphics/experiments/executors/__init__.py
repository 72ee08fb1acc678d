"""Executors: run many fits in parallel, on this machine or on a cluster."""

EXECUTORS = {
    "local": "invgraphics.experiments.executors.local:LocalExecutor",
    "ray": "invgraphics.experiments.executors.ray:RayExecutor",
}
"""Name -> a class with the interface of `invgraphics.experiments.executors.base.Executor`."""
