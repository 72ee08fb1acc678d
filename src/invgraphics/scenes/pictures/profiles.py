"""Conversion of photographs from their embedded ICC profile, such as Display P3 or Adobe RGB, to sRGB."""

from __future__ import annotations

import io
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

ROUNDING = 2
"""Largest difference in levels of 255 up to which a profile counts as sRGB, whose bytes are kept: sRGB profiles of
several makers differ by one in the tables of their curves."""

_STEPS = 9  # levels per channel of the lattice of colours on which profiles are compared


@dataclass(frozen=True, eq=False)
class Profile:
    """An embedded profile.

    Attributes:
        name: its description; empty where it is sRGB or is not used.
        to_srgb: Pillow's transform of 8-bit RGB; ``None`` where pixels are kept.
        fault: why a broken profile is ignored.
    """

    name: str = ""
    to_srgb: Any = None
    fault: str = ""


def converted(image: Any, info: Mapping[Any, Any], path: Path) -> Any:
    """Convert a loaded Pillow image of 8-bit RGB or RGBA to sRGB; alpha is kept.

    Unchanged where the embedded profile is sRGB, absent or no RGB profile; a broken one is warned of and ignored.

    Args:
        image: the colours.
        info: of the opened file, with its profile.
        path: its file.
    """
    found = _profile_of(info)
    if found.fault:
        _warn(path, found.fault)
    if found.to_srgb is None:
        return image
    from PIL import Image, ImageCms

    bands = image.split()
    colour = ImageCms.applyTransform(Image.merge("RGB", bands[:3]), found.to_srgb)
    assert colour is not None, "not in place"
    return Image.merge(image.mode, (*colour.split(), *bands[3:]))


def profile_name(info: Mapping[Any, Any]) -> str:
    """Name of the profile in a Pillow image's ``info`` from which `converted` converts; empty where it converts nothing."""
    return _profile_of(info).name


def profile_words(names: Sequence[str]) -> dict[str, str]:
    """A scene's note on the profiles of its photographs, by `profile_name`; empty where none is converted."""
    found = Counter(name for name in names if name)
    words = ", ".join(f"{count} from {name}" for name, count in sorted(found.items()))
    return {"colour_profile": f"of {len(names)} photographs converted to sRGB: {words}"} if found else {}


def _profile_of(info: Mapping[Any, Any]) -> Profile:
    content = info.get("icc_profile")
    return _read(content) if isinstance(content, bytes) and content else Profile()


@lru_cache(maxsize=16)
def _read(content: bytes) -> Profile:
    from PIL import Image, ImageCms

    try:
        profile: Any = ImageCms.ImageCmsProfile(io.BytesIO(content))
        if profile.profile.xcolor_space.strip() != "RGB":
            return Profile()
        intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
        to_srgb = ImageCms.buildTransform(profile, ImageCms.createProfile("sRGB"), "RGB", "RGB", intent)
        levels = np.linspace(0, 255, _STEPS).round().astype(np.uint8)
        lattice = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(_STEPS, -1, 3)
        changed = np.asarray(ImageCms.applyTransform(Image.fromarray(lattice), to_srgb))
        name = " ".join(ImageCms.getProfileDescription(profile).split()) or "a profile without a name"
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError) as error:
        return Profile(fault=str(error) or type(error).__name__)
    is_srgb = np.abs(changed.astype(int) - lattice).max() <= ROUNDING
    return Profile() if is_srgb else Profile(name, to_srgb)


@lru_cache(maxsize=256)
def _warn(path: Path, fault: str) -> None:
    """Warn once of each file."""
    print(f"Warning: the colour profile of {path} is broken ({fault}); its pixels count as sRGB.", file=sys.stderr, flush=True)
