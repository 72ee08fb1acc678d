"""The README's first example in Python, run as it stands there, and its picture; part of ``make picture``."""

import re
import sys
from pathlib import Path

import matplotlib.pyplot as plt

README = Path(__file__).parents[1] / "README.md"


def example() -> str:
    """The first block of Python in the README."""
    found = re.search(r"^```python\n(.*?)^```", README.read_text(), flags=re.S | re.M)
    assert found is not None, "the README has no example"
    return found[1]


def draw(names: dict, out: Path) -> None:
    """Write ``out``: the photograph of a test view, and its rendering's colour, depth and normals."""
    scene, view, picture = names["scene"], names["view"], names["picture"]
    hit = picture.alpha >= 0.5
    normals = (picture.normal + 1) / 2 * hit[..., None] + ~hit[..., None]
    depth = picture.depth.where(hit, float("nan"))
    psnr = names["scores"].per_view("psnr")[0]
    panels = {
        "photograph": view.over(scene.background),
        f"rgb, {psnr:.1f} dB": picture.over(scene.background).clamp(0, 1),
        "depth": depth,
        "normal": normals,
    }
    figure, axes = plt.subplots(1, len(panels), figsize=(2.6 * len(panels), 2.9), dpi=130, facecolor="white")
    for axis, (title, pixels) in zip(axes, panels.items(), strict=True):
        axis.imshow(pixels, cmap="viridis_r", interpolation="lanczos" if pixels.ndim == 3 else "nearest")
        axis.set_title(title, fontsize=10)
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(out)


if __name__ == "__main__":
    found: dict = {}
    exec(example(), found)
    draw(found, Path(sys.argv[1]))
