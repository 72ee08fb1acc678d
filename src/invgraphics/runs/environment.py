"""``environment.json``: machine and package versions that a run, a comparison or a study depends on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from invgraphics.runs.schema import Record, plain, stored_fields


@dataclass(frozen=True, kw_only=True)
class Environment(Record):
    """Record of a machine and its software. Schema 1 had the packages beside the other keys.

    Attributes:
        invgraphics: version, and hash of the sources.
        commit: of the working copy; ``+ changes`` where tracked files differ from it; empty outside a repository.
        python: version.
        torch: version.
        platform: operating system and architecture.
        cpu: name of the processor.
        cores: of the machine.
        threads: of the process.
        kernels: implementation of the hot operations.
        device: that computed.
        deterministic: whether equal requests give equal bits.
        date: when the record was made, UTC.
        packages: name -> version; ``None`` where it is not installed.
        gpu: its name.
        note: what limits repeatability, a sentence.
        begun_on: machines and packages of earlier parts of a fit, or their code, where it was resumed with others.
        executor: of a study: what ran its fits.
        jobs: of a study: fits that shared the machine.
    """

    SCHEMA: ClassVar[int] = 2
    FILE: ClassVar[str] = "environment.json"

    invgraphics: str = ""
    commit: str = ""
    python: str = ""
    torch: str = ""
    platform: str = ""
    cpu: str = ""
    cores: int | None = None
    threads: int | None = None
    kernels: str = ""
    device: str = ""
    deterministic: bool | None = None
    date: str = ""
    packages: dict[str, str | None] = field(default_factory=dict)
    gpu: str = ""
    note: str = ""
    begun_on: tuple[str, ...] = ()
    executor: str = ""
    jobs: int | None = None

    @classmethod
    def migrate(cls, table: dict[str, Any], schema: int) -> dict[str, Any]:
        """Convert schema 1, which had every package's version under a key of its own."""
        own = {key: value for key, value in table.items() if key in stored_fields(cls) or key == "schema"}
        rest = {key: value for key, value in table.items() if key not in own and isinstance(value, str | None)}
        return own | {"packages": rest}

    def facts(self) -> dict[str, Any]:
        """All recorded facts, name -> value, packages among them."""
        known = plain(self)
        del known["schema"]
        packages = known.pop("packages", {})
        return known | packages
