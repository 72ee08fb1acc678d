"""Packaged data is found in a checkout and in a wheel, and a wrong name is answered with the right ones."""

from pathlib import Path

import pytest

from invgraphics import data
from invgraphics.errors import InputError


def test_checkout_folders_are_found():
    assert (data.find("scenes", "bricks") / "scene.toml").is_file()
    assert data.find("scenes") == Path(__file__).resolve().parents[1] / "scenes"


def test_wheel_comes_first(tmp_path, monkeypatch):
    (tmp_path / "wheel" / "scenes" / "mine").mkdir(parents=True)
    (tmp_path / "checkout" / "scenes" / "other").mkdir(parents=True)
    monkeypatch.setattr(data, "_roots", lambda: (tmp_path / "wheel", tmp_path / "checkout"))
    assert data.find("scenes", "mine") == tmp_path / "wheel" / "scenes" / "mine"
    with pytest.raises(InputError, match="mine"):
        data.find("scenes", "other")


def test_missing_folder_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(data, "_roots", lambda: (tmp_path,))
    with pytest.raises(InputError, match="studies"):
        data.find("studies")
