"""Checkpoints hold every tensor, however it lies in memory, and are written from where it lies."""

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from invgraphics.runs import checkpoint


def test_tensors_that_share_memory_or_are_turned_come_back(tmp_path: Path) -> None:
    base = torch.arange(12.0).reshape(3, 4)
    part = {
        "whole": base,
        "same": base,
        "rows": base[1:],
        "turned": base.T,
        "every other": base[:, ::2],
        "repeated": torch.ones(1).expand(5),
        "none": torch.zeros(0, 3),
        "nothing": torch.zeros(0, 3),
        "learnt": nn.Parameter(torch.ones(2)),
        "number": torch.tensor(3),
    }
    checkpoint.save(tmp_path / "file", {"field": part, "hooks": {"whole": base}})
    found = checkpoint.load(tmp_path / "file")
    assert found["field"].keys() == part.keys()
    assert all(torch.equal(found["field"][name], value) for name, value in part.items())
    assert torch.equal(found["hooks"]["whole"], base)


def test_tensors_are_not_copied_to_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a large fit the copy was as much memory again as parameters and moments."""
    given: dict[str, Tensor] = {}
    monkeypatch.setattr(checkpoint, "save_file", lambda flat, path: (given.update(flat), path.write_bytes(b"x")))
    module = nn.Linear(3, 4)
    checkpoint.save(tmp_path / "file", {"field": dict(module.state_dict())})
    assert given["field|weight"].data_ptr() == module.weight.data_ptr()
