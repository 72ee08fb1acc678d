"""Codes of the instances of a class: their penalty, and their inference from views."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
