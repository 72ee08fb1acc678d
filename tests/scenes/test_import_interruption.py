"""Whoever asks a command to end is heard, whatever libraries it has loaded."""

import subprocess
import sys

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
