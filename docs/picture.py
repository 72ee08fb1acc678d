"""The README's picture, from a comparison's folder: one test view's truth beside each method, with its score.

``make picture`` runs it on reports/compare-bricks.
"""

import json
import sys
from pathlib import Path

import matplotlib.pyplot as plt
from PIL import Image


def draw(folder: Path, out: Path, view: int = 0) -> None:
    """Write ``out``: the truth and each method's picture of one test view, the mean PSNR and frames per second below."""
    comparison = json.loads((folder / "compare.json").read_text())
    runs = [folder / run for run in comparison["runs"] if run.endswith(f"seed-{comparison['seeds'][0]}")]
    truth = runs[0] / json.loads((runs[0] / "provenance.json").read_text())["truth"]
    pictures = [(Image.open(truth / f"{view:04d}.png"), "Mitsuba (truth)", "")]
    for run in runs:
        scores = json.loads((run / "scores.json").read_text())
        caption = f"{scores['quality']['psnr']['mean']:.1f} dB, {scores['cost']['render_fps']:.3g} FPS"
        pictures.append((Image.open(run / "test" / f"{view:04d}.png"), scores["method"], caption))
    figure, axes = plt.subplots(1, len(pictures), figsize=(2.6 * len(pictures), 3.0), dpi=130, facecolor="white")
    for axis, (picture, title, caption) in zip(axes, pictures, strict=True):
        axis.imshow(picture, interpolation="lanczos")
        axis.set_title(title, fontsize=10)
        axis.set_xlabel(caption, fontsize=9)
        axis.set_xticks([])
        axis.set_yticks([])
        axis.spines[:].set_visible(False)
    figure.tight_layout()
    figure.savefig(out)


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
