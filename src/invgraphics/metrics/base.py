"""Interface of metrics: a pure function of a prediction and its ground truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

from jaxtyping import Bool, Float
from torch import Tensor

OPAQUE = 0.5
"""Alpha from which a pixel counts as showing a surface (CONVENTIONS.md)."""


class Skip(Exception):  # noqa: N818 - an outcome, not an error
    """Raised where a metric does not apply to a view; the message is the reason in ``skipped``."""


class Inapplicable(Skip):
    """Raised by a metric that is not about such data at all: it is then left out of scores and of ``skipped``."""


@dataclass(frozen=True, eq=False)
class Pair:
    """A prediction and the truth of one view, prepared by a protocol: display colours, background applied, cropped.

    Attributes:
        image: predicted colour, display sRGB in [0, 1]; equals ``truth`` outside ``mask``, so that windows see no error there.
        truth: true colour, likewise.
        pred_alpha: predicted coverage in [0, 1].
        true_alpha: true coverage in [0, 1]; ``None`` where the data set has none.
        pred_depth: predicted distance along the unit ray, world units; means nothing where ``pred_alpha`` is below 0.5.
        true_depth: true distance, inf where nothing is hit; ``None`` where the data set has none.
        pred_normal: predicted unit normal, zero where there is none; ``None`` if it was not rendered.
        true_normal: true unit normal in the same frame; ``None`` where the data set has none.
        mask: True where a pixel counts; ``None`` means everywhere.
    """

    image: Float[Tensor, "h w 3"]
    truth: Float[Tensor, "h w 3"]
    pred_alpha: Float[Tensor, "h w"]
    true_alpha: Float[Tensor, "h w"] | None = None
    pred_depth: Float[Tensor, "h w"] | None = None
    true_depth: Float[Tensor, "h w"] | None = None
    pred_normal: Float[Tensor, "h w 3"] | None = None
    true_normal: Float[Tensor, "h w 3"] | None = None
    mask: Bool[Tensor, "h w"] | None = None

    def cropped(self, border: int) -> Pair:
        """The same pair without ``border`` pixels along every side."""
        height, width = self.pred_alpha.shape
        inner = (slice(border, height - border), slice(border, width - border))
        maps = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: values[inner] for name, values in maps.items() if values is not None})

    def mean_within(self, values: Float[Tensor, "h w"]) -> float:
        """Mean of a per-pixel map over unmasked pixels, in double precision."""
        kept = values if self.mask is None else values[self.mask]
        if kept.numel() == 0:
            raise Skip("the view's mask leaves no pixel to score")
        return float(kept.double().mean())


@dataclass(frozen=True)
class Metric:
    """A metric: a pure function of a `Pair`, with name, unit and direction of its value.

    Attributes:
        name: key in scores and tables.
        unit: unit of the value; empty for plain numbers.
        higher_is_better: direction.
        compute: the function; raises `Skip` where the metric does not apply.
        summary: one line for a table of metrics: the definition and its conventions.
    """

    name: str
    unit: str
    higher_is_better: bool
    compute: Callable[[Pair], float]
    summary: str
