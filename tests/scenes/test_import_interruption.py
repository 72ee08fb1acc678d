"""Whoever asks a command to end is heard, whatever libraries it has loaded; what a killed one leaves misleads no other."""

import subprocess
import sys
from pathlib import Path

import pytest

from invgraphics.files import copy_file
from invgraphics.scenes.photos import PhotoJob, mapping
from invgraphics.scenes.photos.job import DATABASE
from invgraphics.scenes.photos.pairs import VerifiedMatches
from invgraphics.scenes.photos.strategies import Strategy

SCRIPT = """
import os, signal, time
signal.signal(signal.SIGTERM, signal.default_int_handler)
from invgraphics.scenes.pictures.lens import Lens
assert Lens("PINHOLE", (8.0, 8.0, 4.0, 4.0), 8, 8).is_pinhole()
try:
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(60)
except KeyboardInterrupt:
    print("interrupted")
"""


def test_reading_a_lens_leaves_signals_to_the_command() -> None:
    """COLMAP's logging takes SIGTERM when it is loaded."""
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n", "")


KILLED = """
import os, signal, sys, pycolmap
database = pycolmap.Database.open(sys.argv[1])
for number in range(2, 200):
    database.write_camera(pycolmap.Camera.create_from_model_name(number, "SIMPLE_RADIAL", 777.0, 160, 106), True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_the_log_of_a_killed_strategy_is_not_replayed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What it had written into its copy of the data base is not in the next copy."""
    import pycolmap

    with pycolmap.Database.open(tmp_path / DATABASE) as database:
        database.write_camera(pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 100.0, 160, 106), True)
    copy_file(tmp_path / DATABASE, tmp_path / mapping.COPY)
    subprocess.run([sys.executable, "-c", KILLED, str(tmp_path / mapping.COPY)], check=False)
    assert (tmp_path / f"{mapping.COPY}-wal").stat().st_size > 0
    monkeypatch.setattr(pycolmap, "calibrate_view_graph", lambda *_: None)
    matched = mapping.Matched(PhotoJob(str(tmp_path)), (), VerifiedMatches((), ()), tmp_path)
    path = mapping._database(Strategy("incremental", "radial", calibrated=True), matched, lambda *_: None)
    with pycolmap.Database.open(path) as database:
        assert database.num_cameras() == 1
