"""Parsing of command-line arguments: tyro with errors of at most four lines, options shared by commands, and their texts."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

from tyro.conf import Positional, UseAppendAction, arg

from invgraphics.errors import InputError
from invgraphics.experiments.request import DATA, LARGEST_SEED
from invgraphics.tables import LIMITS
from invgraphics.training.budget import Budget

T = TypeVar("T")

SMALLEST = 8
"""Pixels along the shorter side of the smallest pictures that are worth fitting."""

OPTIMISED = {"poses", "exposure"}
"""What ``--optimise`` can name: tables of a recipe's ``training``."""

_BOX = "│╭╮╰╯"
_POSITIONAL = get_args(Positional[int])[1]


@dataclass(frozen=True, kw_only=True)
class Shared:
    """Options shared by ``fit`` and ``compare``.

    Attributes:
        budget: How long each fit may optimise: seconds (60s, 2m, 1h), or steps (5000steps).
        preset: Size of the method. The budget chooses: laptop under two minutes (and for steps), long up to 30, hour above, or
            the nearest smaller one that the method has; paper holds the published values.
        overrides: Change one value of the recipe, for instance --set batches.rays=2048 (`invgraphics list METHOD` shows all of
            a method's keys), or of the training data: data.train_views=10, data.size, data.pose_noise (degrees and per cent),
            data.photo_noise, data.exposure (stops), data.background, data.scales (divisors of the size, [1, 2, 4, 8]),
            data.test_scales (more scores, of smaller pictures), data.init (points to start from: scene, sfm, random), data.box
            (scene: not that of the silhouettes).
        size: Size of the pictures; one number is the longest side.
        test_views: How many test views are scored: of a built-in scene the first N, which are evenly distributed; of a data set
            N evenly spaced ones.
        spp: Samples per pixel of the training views of a scene that is rendered; the others keep their proportion.
        max_primitives: Largest number of Gaussians or points, for methods that have some; short for --set max_primitives=N.
        optimise: Fit the training cameras' poses too, or an exposure of each training photograph, or both; short for --set
            training.poses.optimise=true and --set training.exposure.optimise=true. Exposures are fitted unasked where those of
            a COLMAP reconstruction's photographs differ.
        device: Device that computes.
        kernels: Force an implementation of the hot operations: numba, reference (plain torch), or cuda with --device cuda.
        protocol: How pictures are scored: default (rounded to 8 bits), or float.
        checkpoint_every: Interval between checkpoints, the most work that an interruption costs.
        render_with: Show the fitted fields through the renderers of other methods, too; METHOD:key=value changes a renderer's
            setting.
    """

    budget: Annotated[str, arg(metavar="60s|5000steps")] = "60s"
    preset: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: from the budget)")] = None
    overrides: Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="KEY=VALUE")] = ()
    size: Annotated[str | None, arg(metavar="WIDTHxHEIGHT|N", help_behavior_hint="(default: the scene's own)")] = None
    test_views: Annotated[str, arg(metavar="N|all")] = "16"
    spp: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: the scene's own)")] = None
    max_primitives: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: the recipe's)")] = None
    optimise: Annotated[str, arg(metavar="poses,exposure")] = ""
    device: Annotated[str | None, arg(metavar="cpu|cuda", help_behavior_hint="(default: cpu)")] = None
    kernels: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: the fastest here)")] = None
    protocol: Annotated[str, arg(metavar="NAME")] = "default"
    checkpoint_every: Annotated[str, arg(metavar="30s|5m|100steps")] = "30s"
    render_with: Annotated[str, arg(metavar="A,B")] = ""

    def settings(self) -> dict[str, Any]:
        """Convert the options to validated keyword arguments of a request.

        Raises:
            InputError: one of them cannot be read.
        """
        Budget.parse(self.budget)
        short = () if self.max_primitives is None else (f"max_primitives={self.max_primitives}",)
        if self.optimise:
            wanted = parse_list(self.optimise, "--optimise")
            if not set(wanted) <= OPTIMISED:
                raise InputError(f"--optimise cannot be '{self.optimise}'.", "Expected: poses, exposure, or poses,exposure.")
            short = (*(f"training.{part}.optimise=true" for part in wanted), *short)
        return {
            "budget": self.budget,
            "preset": self.preset,
            "overrides": tuple(self.overrides) + short,
            "size": None if self.size is None else parse_size(self.size),
            "test_views": parse_views(self.test_views),
            "spp": parse_samples(self.spp),
            "device": self.device,
            "kernels": self.kernels,
            "protocol": self.protocol,
            "checkpoint_every": self.checkpoint_every,
            "render_with": parse_list(self.render_with, "--render-with") if self.render_with else (),
        }

    def check_primitives(self, methods: Sequence[str]) -> None:
        """Refuse ``--max-primitives`` where no method has primitives; a method that cannot be resolved is left to the fit.

        Raises:
            InputError: it would do nothing.
        """
        if self.max_primitives is None or not methods:
            return

        from invgraphics.recipes.recipe import load_method

        overrides = [item for item in self.settings()["overrides"] if not item.startswith(DATA)]
        for method in methods:
            try:
                resolved = load_method(method, self.preset, overrides, Budget.parse(self.budget))
            except InputError:
                return
            if resolved.recipe.has_primitives:
                return
        which = f"{methods[0]}, which has" if len(methods) == 1 else "these methods, which have"
        refuse_idle({"--max-primitives": self.max_primitives}, f"for {which} no Gaussians or points")


def parse(command: type[T], program: str, arguments: Sequence[str]) -> T:
    """Parse arguments to a command; ``--help`` prints its help and exits.

    Raises:
        InputError: an argument is missing, unknown or of the wrong type.
    """
    if not arguments:
        with contextlib.suppress(TypeError):  # something is required, which tyro says better
            return command()  # a third of the time that `invgraphics list` takes is tyro's

    import tyro

    complaints = io.StringIO()
    if {"-h", "--help"} & set(arguments):  # tyro's short usage line leaves out the options that are required
        program = " ".join([program, *required_options(command)])
    try:
        with contextlib.redirect_stderr(complaints):
            return tyro.cli(command, prog=program, args=arguments, config=(tyro.conf.FlagCreatePairsOff,))
    except SystemExit as stop:
        if not stop.code:
            raise
        raise InputError(*condense(complaints.getvalue())) from None


def required_options(command: type) -> list[str]:
    """List a command's required options as ``--name METAVAR``, without positional arguments."""
    words = []
    hints = get_type_hints(command, include_extras=True)
    for field in dataclasses.fields(command):
        marks = get_args(hints[field.name])[1:]
        metavar = next((mark.metavar for mark in marks if getattr(mark, "metavar", None)), None)
        optional = field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING
        if metavar and not optional and _POSITIONAL not in marks:
            words.append(f"--{field.name.replace('_', '-')} {metavar}")
    return words


def condense(box: str) -> tuple[str, str]:
    """Condense tyro's framed error message to a sentence (one or two lines) and a remedy."""
    lines = [line.strip(_BOX + " ") for line in box.splitlines()]
    # Inside the frame, horizontal rules part the message from suggestions, the argument's help and the pointer to --help.
    parts = [" ".join(part.split()) for part in re.split(r"[─-]{4,}", "\n".join(lines[1:]))]
    parts = [part for part in parts if part and not part.startswith(("Argument helptext", "Available subcommands"))]
    if not parts:
        return "The arguments cannot be read.", ""
    sentence = re.sub(r"invalid literal for int\(\) with base 10: ('.*')", r"\1 is not a whole number", parts[0])
    sentence = re.sub(
        r"no type matching .* could be instantiated from \['(.*?)'\]\. Got errors: .*<class '(\w+)'>.*", _misfit, sentence
    )
    hints = [part for part in parts[1:-1] if part.startswith("Perhaps")]
    if re.fullmatch(r"Unrecognized options: [^-]\S*/.*", sentence) and "invgraphics compare" in parts[-1]:
        hints = ["Names of several methods have commas between them: --methods A,B."]
    return "\n".join([sentence, *hints[:1]]), parts[-1] if len(parts) > 1 else ""


def _misfit(found: re.Match[str]) -> str:
    """A value of a wrong type, in words; of tyro's list of types that may be left out, the last is the type proper."""
    kinds = {"int": "whole number", "float": "number"}
    return f"'{found[1]}' is not a {kinds.get(found[2], found[2])}"


def refuse_idle(given: Mapping[str, Any], why: str, remedy: str = "") -> None:
    """Refuse options that would do nothing.

    Args:
        given: option -> its value; ``None`` where it was not given.
        why: beside what they do nothing, in words that follow "does nothing".
        remedy: what to do besides leaving them out; may be empty.

    Raises:
        InputError: one of them was given.
    """
    idle = [option for option, value in given.items() if value is not None]
    if idle:
        names = ", ".join(idle[:-1]) + " and " + idle[-1] if len(idle) > 1 else idle[0]
        raise InputError(f"{names} {'do' if len(idle) > 1 else 'does'} nothing {why}.", f"Leave out {names}{remedy}.")


def parse_size(text: str) -> int | tuple[int, int]:
    """Parse ``480`` (longest side) or ``640x480`` to pixels.

    Raises:
        InputError: anything else, or less than `SMALLEST` pixels.
    """
    found = re.fullmatch(r"(\d+)(?:[xX×](\d+))?", text.strip())
    sides = [int(side) for side in found.groups() if side is not None] if found else [0]
    if min(sides) < SMALLEST:
        expected = (
            f"Expected WIDTHxHEIGHT, for instance 320x240, or one number for the longest side; at least {SMALLEST} pixels."
        )
        raise InputError(f"--size cannot be '{text}'.", expected)
    return sides[0] if len(sides) == 1 else (sides[0], sides[1])


def parse_views(text: str) -> int | None:
    """Parse a number of views; ``all`` gives ``None``.

    Raises:
        InputError: anything else.
    """
    if text.strip() == "all":
        return None
    if not text.strip().isdecimal() or int(text) < 1:
        raise InputError(f"--test-views cannot be '{text}'.", "Expected a number of views, 1 or more, or 'all'.")
    return int(text)


def parse_samples(count: int | None) -> int | None:
    """Validate a number of samples per pixel; ``None`` passes.

    Raises:
        InputError: it is less than one.
    """
    if count is not None and count < 1:
        raise InputError(f"--spp cannot be {count}.", "Expected a number of samples per pixel, 1 or more.")
    return count


def parse_list(text: str, option: str) -> tuple[str, ...]:
    """Split a comma-separated list; commas within brackets, braces and quotes do not separate.

    Raises:
        InputError: nothing in it.
    """
    items = tuple(item.strip() for item in _split(text) if item.strip())
    if not items:
        raise InputError(f"{option} is empty.", "Expected one name or several, with commas between them.")
    return items


def _split(text: str) -> list[str]:
    """Parts between the commas of a list of TOML values that are in none of them."""
    parts, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        else:
            depth += (letter in "[{") - (letter in "]}")
        if letter == "," and depth <= 0 and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def parse_seeds(text: str) -> tuple[int, ...]:
    """Parse comma-separated seeds to integers.

    Raises:
        InputError: one of them is not a whole number from 0 to `LARGEST_SEED`.
    """
    items = parse_list(text, "--seeds")
    if not all(item.isdecimal() and len(item) <= LIMITS.digits and int(item) <= LARGEST_SEED for item in items):
        expected = f"Expected whole numbers from 0 to {LARGEST_SEED} (2^63 - 1), with commas between them: 0,1,2."
        raise InputError(f"--seeds cannot be '{text}'.", expected)
    return tuple(int(item) for item in items)


def check_seed(seed: int) -> int:
    """Validate one seed.

    Raises:
        InputError: it is not from 0 to `LARGEST_SEED`.
    """
    if not 0 <= seed <= LARGEST_SEED:
        raise InputError(f"--seed cannot be {seed}.", f"Expected a whole number from 0 to {LARGEST_SEED} (2^63 - 1).")
    return seed
