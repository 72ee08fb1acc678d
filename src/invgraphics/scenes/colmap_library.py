"""pycolmap, without what its import does to the process.

COLMAP's logging takes SIGTERM as a crash: it prints a stack trace and dies, and a command could not save what it has computed.
Whoever listened before gets the signal back here, and its account of every photograph and pair, printed to the terminal, is
left out: errors are shown. This takes a second to import: do it where it is needed.
"""

import signal
import threading

import pycolmap

__all__ = ["pycolmap"]

pycolmap.logging.minloglevel = 2

_listener = signal.getsignal(signal.SIGTERM)
# pycolmap has replaced the handler; signal handlers can be set in the main thread only.
if _listener is not None and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, _listener)
