"""Exceptions with user-facing sentences: bad input, incompatible components, numerical failures."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

LONGEST = 1000
"""Characters of a sentence."""


class InputError(Exception):
    """Bad input, described in one clear sentence, with the remedy where there is one.

    The command line prints at most four lines of it and exits with status 2; library users catch it as an exception.

    Args:
        sentence: what is wrong: which file or key, and what was expected.
        remedy: what to do about it, one line; empty where there is nothing to add.
    """

    def __init__(self, sentence: str, remedy: str = "") -> None:
        sentence, remedy = _shortened(sentence), _shortened(remedy)
        super().__init__(sentence if not remedy else f"{sentence}\n{remedy}")
        self.sentence = sentence
        self.remedy = remedy


def _shortened(text: str) -> str:
    """Shorten a text that quotes a value of thousands of characters, by its middle."""
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 200]} ... {text[-200:]}"


class NotComposableError(InputError):
    """Incompatible field and renderer; the sentence names the missing quantity."""


class NumericalError(Exception):
    """Non-finite value in a fit; the sentence names the step and the tensor."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Suggest the closest known name to a misspelt one, as a question with a leading space; empty where none is close.

    Names with folders (``renderer/recipe``) are also known by their last part.
    """
    known = list(known)
    full = {name.rpartition("/")[2].lower(): name for name in reversed(known)} | {name.lower(): name for name in known}
    begun = [name for name in full if len(word) > 2 and name.startswith(word.lower())]
    close = begun if len(begun) == 1 else difflib.get_close_matches(word.lower(), full, n=1, cutoff=0.7)
    return f" Did you mean '{full[close[0]]}'?" if close else ""
