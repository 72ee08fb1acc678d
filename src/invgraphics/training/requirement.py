"""What hooks and penalties need of the field, declared so that a recipe can be refused before anything is built."""

from __future__ import annotations

from dataclasses import dataclass
from inspect import get_annotations

from typing_extensions import get_protocol_members

from invgraphics.core import Quantity
from invgraphics.errors import InputError


@dataclass(frozen=True)
class Requirement:
    """Members that a field must have, quantities that it must provide, or both.

    Attributes:
        words: what they are, for a sentence.
        protocol: a `typing.Protocol` that lists the members; ``None`` for none.
        quantities: that it provides.
    """

    words: str
    protocol: type | None = None
    quantities: Quantity = Quantity.NONE

    def met_by(self, field: object) -> bool:
        """Whether a field, or a class of fields, has all of them. Annotations of a class count as its members.

        A class whose fields differ in what they provide passes.
        """
        cls = field if isinstance(field, type) else type(field)
        declared = {name for base in cls.__mro__ for name in get_annotations(base)}
        members = () if self.protocol is None else get_protocol_members(self.protocol)
        provided = getattr(field, "provides", None)
        enough = self.quantities in provided if isinstance(provided, Quantity) else isinstance(field, type)
        return enough and all(hasattr(field, name) or name in declared for name in members)

    def check(self, part: str, field: object) -> None:
        """Refuse a field, or a class of fields, that lacks a member or a quantity.

        Raises:
            InputError: names the part of the recipe, what it needs, and the field.
        """
        if not self.met_by(field):
            name = (field if isinstance(field, type) else type(field)).__name__
            raise InputError(f"The {part} needs {self.words}, which {name} does not have.")
