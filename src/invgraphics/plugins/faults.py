"""Attribution of unexpected errors to a third-party part or to invgraphics."""

from __future__ import annotations

import sys

from invgraphics.plugins.sources import packages


def raised_in(error: BaseException) -> str:
    """The third-party function in which an error was raised, and its distribution; empty where no frame is of a plug-in."""
    known, found, trace = packages(), "", error.__traceback__
    while trace is not None:
        module = str(trace.tb_frame.f_globals.get("__name__", ""))
        if (top := module.partition(".")[0]) in known:
            version = f" ({known[top]})" if known[top] else ""
            found = f"{module}.{trace.tb_frame.f_code.co_qualname}{version}"
        trace = trace.tb_next
    return found


def unexpected(error: BaseException) -> tuple[str, str]:
    """Describe an unexpected exception and attribute it to a plug-in, if it was raised in one or may be, or to invgraphics."""
    first = (str(error).splitlines() or [""])[0]
    if where := raised_in(error):
        fault = f"It was raised in {where}"
    else:
        used = [package or top for top, package in packages().items() if top in sys.modules]
        fault = f"This is a fault of {' or '.join(['invgraphics', *dict.fromkeys(used)])}, not of your input"
    return f"Unexpected {type(error).__name__}: {first}", fault
