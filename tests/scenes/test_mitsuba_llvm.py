"""Choosing a Mitsuba variant: a bad library is survived, and the remedy is said."""

from pathlib import Path

import pytest

from invgraphics.scenes.mitsuba import llvm


@pytest.fixture(autouse=True)
def _forget():
    llvm.status.cache_clear()
    yield
    llvm.status.cache_clear()


def test_a_library_that_does_not_load_falls_back(tmp_path, monkeypatch):
    bad = tmp_path / "libLLVM.so"
    bad.write_text("not a library")
    monkeypatch.setenv(llvm.VARIABLE, str(bad))
    status = llvm.status()
    assert status.variant == "scalar_rgb"
    assert str(bad) in status.reason
    assert "pip install" in status.remedy
    assert status.library is None


def test_a_probe_that_aborts_is_survived(monkeypatch):
    """What LLVM 15 does: the process dies of SIGABRT."""
    monkeypatch.setattr(llvm, "_candidates", lambda: iter(["/some/libLLVM.so.15"]))
    monkeypatch.setattr(llvm, "_PROBE", "import os; os.abort()")
    assert llvm.status().variant == "scalar_rgb"


def test_first_working_candidate_wins(monkeypatch):
    monkeypatch.setattr(llvm, "_candidates", lambda: iter(["/bad", "/good", "/never"]))
    monkeypatch.setattr(llvm, "_PROBE", f"import os, sys; sys.exit(os.environ['{llvm.VARIABLE}'] != '/good')")
    status = llvm.status()
    assert (status.variant, status.library, status.remedy) == ("llvm_ad_rgb", "/good", "")
    assert status.environment()[llvm.VARIABLE] == "/good"


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM.so.19.1", 19),
        ("libLLVM-15.so", 15),
        ("libLLVM-15.so.1", 15),
        ("libLLVM.so.22.1", 22),
        ("libLLVM.19.1.dylib", 19),
        ("libLLVM-20.dylib", 20),
        ("libLLVM.dylib", llvm.OLDEST),
        ("libLLVM.so", 0),
        ("libLTO.so.23", 0),
    ],
)
def test_versions_are_read_from_names(name, version):
    assert llvm._version(Path("/usr/lib") / name) == version


def test_old_system_libraries_are_not_tried(tmp_path, monkeypatch):
    for name in ("libLLVM-14.so.1", "libLLVM.so.19.1", "libLLVM.so.22.1", "libLLVM-15.so"):
        (tmp_path / name).touch()
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    monkeypatch.setattr(llvm, "SYSTEM_FOLDERS", (str(tmp_path),))
    monkeypatch.setattr(llvm.sys, "prefix", str(tmp_path / "nowhere"))
    assert [Path(path).name for path in llvm._candidates()] == ["libLLVM.so.22.1", "libLLVM.so.19.1"]
