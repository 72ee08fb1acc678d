"""``invgraphics doctor``: check processor, kernels, LLVM, CUDA and extras of this machine, with remedies."""

from __future__ import annotations

import importlib.util
import os
import platform
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from invgraphics.cli.output import show_table
from invgraphics.thread_pools import usable_cores


@dataclass(frozen=True)
class Finding:
    """Result of one check of the machine.

    Attributes:
        subject: what was looked at.
        found: what there is.
        remedy: what to do; empty if all is well.
    """

    subject: str
    found: str
    remedy: str = ""


@dataclass(frozen=True)
class Doctor:
    """Check this machine: processor, kernels, LLVM for Mitsuba, CUDA and extras, with a remedy for what is missing.

    Attributes:
        warm_up: Compile the kernels now, so that no later command waits for it.
    """

    warm_up: bool = False

    def run(self) -> int:
        """Run the checks and print them; returns exit status 0."""
        findings = list(examine(self.warm_up))
        rows = [("!" if finding.remedy else "ok", finding.subject, finding.found) for finding in findings]
        show_table("This machine", ("", "subject", "found"), rows)
        for finding in findings:
            if finding.remedy:
                print(f"{finding.subject}: {finding.remedy}")
        missing = [finding for finding in findings if finding.remedy]
        print("Nothing is missing." if not missing else "What is marked ! is slower or not there; everything else works.")
        return 0


def examine(warm_up: bool) -> Iterator[Finding]:
    """Run all checks of the machine; compiles the kernels if ``warm_up``."""
    yield Finding("invgraphics", f"{version('invgraphics')}, Python {platform.python_version()}, {platform.platform()}")
    yield from _processor()
    yield _kernels(warm_up)
    yield _llvm()
    yield from _cuda()
    yield _lpips()
    yield _extra("viewer", "viser", "`invgraphics view`")
    yield _extra("ray", "ray", "studies on a cluster")
    yield _data()


def _processor() -> Iterator[Finding]:
    import torch

    from invgraphics.experiments.environment import cpu_name

    cores, threads = os.cpu_count() or 1, torch.get_num_threads()
    allowed = usable_cores()
    yield Finding("processor", f"{cpu_name()}, {cores} cores, {torch.backends.cpu.get_cpu_capability()} instructions")
    limited = threads < allowed and "OMP_NUM_THREADS" in os.environ
    remedy = "unset OMP_NUM_THREADS, or accept slower fits; scores are compared at equal threads only" if limited else ""
    pinned = f", for which {allowed} of {cores} cores are allowed" if allowed < cores else ""
    yield Finding("torch", f"{torch.__version__}, {threads} threads{pinned}", remedy)


def _kernels(warm_up: bool) -> Finding:
    from invgraphics import kernels
    from invgraphics.kernels.dispatch import unavailable_reason

    reason = unavailable_reason("numba")
    if reason:
        return Finding("Numba kernels", f"not usable: {reason}", "reinstall with `pip install --force-reinstall numba`")
    compiled = f", compiled in {kernels.warm_up():.1f} s" if warm_up else ", compiled at first use (--warm-up does it now)"
    return Finding("Numba kernels", f"Numba {version('numba')}{compiled}")


def _llvm() -> Finding:
    from invgraphics.scenes.mitsuba import llvm

    try:
        found = f"{version('mitsuba')}, Dr.Jit {version('drjit')}"
    except PackageNotFoundError as error:
        return Finding("Mitsuba", f"{error.name} is not installed", "reinstall with `pip install invgraphics`")
    status = llvm.status()
    return Finding("Mitsuba", f"{found}, variant {status.variant}: {status.reason}", status.remedy)


def _cuda() -> Iterator[Finding]:
    import torch

    if torch.cuda.is_available():
        name, memory = torch.cuda.get_device_name(0), torch.cuda.get_device_properties(0).total_memory
        yield Finding("CUDA", f"{torch.version.cuda}, {name}, {memory / 2**30:.0f} GiB")
        yield from _cuda_kernels()
        return
    if torch.version.cuda is None:
        yield Finding("CUDA", "this torch is built for the CPU", "with an NVIDIA GPU: install torch from https://pytorch.org")
        return
    yield Finding("CUDA", f"torch is built for CUDA {torch.version.cuda}, but finds no device", "check `nvidia-smi`")


def _cuda_kernels() -> Iterator[Finding]:
    purpose = "splatting, hash encoding, lattices, ray marching and compositing"
    if importlib.util.find_spec("triton") is None:
        remedy = f"`pip install 'invgraphics[cuda]'`; until then {purpose} run as plain torch on the GPU"
        yield Finding("Triton", "not installed", remedy)
    else:
        yield Finding("Triton", f"{version('triton')}, for {purpose} on the GPU")


def _lpips() -> Finding:
    from invgraphics.metrics.perceptual import why_no_lpips

    reason = why_no_lpips()
    if not reason:
        return Finding("LPIPS", f"lpips {version('lpips')} with its weights")
    if importlib.util.find_spec("lpips") is None:
        return Finding("LPIPS", "not installed", "an extra: `pip install 'invgraphics[lpips]'`, and weights of your own")
    return Finding("LPIPS", "installed without weights", reason)


def _extra(name: str, package: str, purpose: str) -> Finding:
    """Finding about an extra of one package."""
    if importlib.util.find_spec(package) is None:
        return Finding(package, "not installed", f"for {purpose}: `pip install 'invgraphics[{name}]'`")
    return Finding(package, f"{version(package)}, for {purpose}")


def _data() -> Finding:
    root = os.environ.get("INVGRAPHICS_DATA")
    if root and Path(root).is_dir():
        return Finding("INVGRAPHICS_DATA", root)
    found = "not set" if not root else f"{root} is no folder"
    return Finding("INVGRAPHICS_DATA", found, "set it to a folder of data sets to run the tests that need real photographs")
