"""Console script: dispatches commands, and turns exceptions into a sentence and an exit status.

Exit status: 0 done, 1 some cells failed, 2 bad input, 130 interrupted or terminated.
"""

from __future__ import annotations

import importlib
import os
import sys
import traceback
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

from invgraphics import plugins
from invgraphics.cli.arguments import parse
from invgraphics.errors import InputError, NumericalError, did_you_mean
from invgraphics.files import file_fault
from invgraphics.interruption import INTERRUPTED, Terminated, end_on_sigterm

COMMANDS = {
    "list": (
        "invgraphics.cli.list:List",
        "list methods, scenes, fields, renderers, metrics, and where each comes from; or all settings of one method",
    ),
    "doctor": ("invgraphics.cli.doctor:Doctor", "check this machine: processor, kernels, CUDA, extras, and what to install"),
    "make-scene": ("invgraphics.cli.make_scene:MakeScene", "render a scene's ground truth with Mitsuba"),
    "import-photos": (
        "invgraphics.cli.import_photos:ImportPhotos",
        "structure from motion: make a scene of photographs, camera poses included",
    ),
    "fit": ("invgraphics.cli.fit:Fit", "fit one method to one scene, and evaluate it"),
    "evaluate": ("invgraphics.cli.evaluate:Evaluate", "score a run again from its model"),
    "rescore": ("invgraphics.cli.rescore:Rescore", "score saved pictures again, under the conventions of other tools"),
    "compare": (
        "invgraphics.cli.compare:Compare",
        "fit several methods to one scene under one budget, and rank them",
    ),
    "ablate": ("invgraphics.cli.ablate:Ablate", "run a study: factors, levels and seeds, on this machine or a cluster"),
    "view": ("invgraphics.cli.view:View", "view a run interactively in a browser, during its fit too, or compare two"),
    "render": ("invgraphics.cli.render:Render", "film a run: around the scene, from photograph to photograph, or its fit"),
    "explain": (
        "invgraphics.cli.explain:Explain",
        "list and plot the contributions along one pixel's ray",
    ),
    "locate": ("invgraphics.cli.locate:Locate", "find a photograph's camera pose by gradient descent through a fitted scene"),
    "infer": (
        "invgraphics.cli.infer:Infer",
        "infer unseen instances of a class of objects from few views or a photograph, with a fitted prior",
    ),
    "report": ("invgraphics.cli.report:Report", "write page, tables and figures from finished runs"),
    "export": ("invgraphics.cli.export:Export", "write a run's model as a file for other programs, and report the loss"),
    "convert": (
        "invgraphics.cli.convert:Convert",
        "make a run's model another kind of scene: Gaussians, a lattice, a mesh, a multi-plane image",
    ),
    "import": ("invgraphics.cli.import_file:ImportFile", "make a run of a model that was trained elsewhere, and evaluate it"),
    "bench": ("invgraphics.cli.bench:Bench", "time the kernels against the reference, the machine's limits and peers"),
}
"""Name -> (``module:class`` of its arguments, summary). A class is imported when its command is given."""

DONE, FAILED, BAD_INPUT = 0, 1, 2
MOST_LINES = 4


def main(argv: Sequence[str] | None = None) -> None:
    """Run one command and exit with its status.

    Args:
        argv: arguments without the program's name; ``None`` for those of the process.
    """
    end_on_sigterm()
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    sys.exit(run([word for word in arguments if word != "--debug"], debug))


def run(arguments: Sequence[str], debug: bool = False) -> int:
    """Run one command and return its exit status; ``debug`` shows tracebacks of failures."""
    try:
        status = _dispatch(arguments)
        sys.stdout.flush()  # here, where a reader that has gone is no accident
        return status
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output has gone, as in `invgraphics list | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except Exception as error:
        if debug:
            traceback.print_exc()
        status, lines = (INTERRUPTED, ["Interrupted."]) if Terminated.raised else explain(error)
        for line in lines[:MOST_LINES]:
            print(line, file=sys.stderr)
        return status


def _dispatch(arguments: Sequence[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help") or arguments == ["help"]:
        print(overview())
        return DONE
    if arguments[0] == "--version":
        print(version("invgraphics"))
        return DONE
    if arguments[0] == "help":
        arguments = [*arguments[1:], "--help"]
    name, *rest = arguments
    return parse(_command(name), f"invgraphics {name}", rest).run()


def overview() -> str:
    """Format the text of ``invgraphics --help``."""
    width = max(map(len, COMMANDS))
    commands = "\n".join(f"  {name:{width}}  {summary}" for name, (_, summary) in COMMANDS.items())
    return f"""usage: invgraphics COMMAND ...   (invgraphics COMMAND --help for details; --debug shows tracebacks)

Compare differentiable renderers: neural radiance fields, hash grids and Gaussian splats under one protocol.

{commands}

Start with:  invgraphics compare bricks --methods volumetric/hash,splatting/gaussians --budget 60s"""


def explain(error: Exception) -> tuple[int, list[str]]:
    """Map an exception to an exit status and lines for standard error."""
    if isinstance(error, InputError):
        return BAD_INPUT, str(error).splitlines()
    if isinstance(error, NumericalError):
        return FAILED, str(error).splitlines()
    if fault := file_fault(error):
        return BAD_INPUT, str(fault).splitlines()
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError" or "can't allocate memory" in str(error):
        return FAILED, ["There is not enough memory.", "Try a smaller --size, or smaller settings of the method (--set)."]
    what, fault = plugins.unexpected(error)
    return FAILED, [what, f"{fault}; --debug shows where it happened."]


def _command(name: str) -> Any:
    """Import the class of a command's arguments."""
    if name not in COMMANDS:
        raise InputError(f"There is no command '{name}'.{did_you_mean(name, COMMANDS)}", f"Commands: {', '.join(COMMANDS)}.")
    module, _, attribute = COMMANDS[name][0].partition(":")
    return getattr(importlib.import_module(module), attribute)
