"""One tiny run of each family, of one scene."""

from pathlib import Path

import pytest
from shared_folders import Once
from training_fixtures import SMALL, write_blender

from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.testing import toy_scene

STEPS = {"volumetric/nerf": 300, "volumetric/hash": 150, "splatting/gaussians": 60}


@pytest.fixture(scope="session")
def balls(once: Once) -> Path:
    """Two balls as a data set on disk."""
    return once("balls", lambda folder: write_blender(toy_scene(views=10, size=32, zoom=1.3), folder / "balls")) / "balls"


@pytest.fixture(scope="session")
def runs(balls: Path, once: Once) -> dict[str, Path]:
    """Method -> run folder."""

    def fit(folder: Path) -> None:
        for method, steps in STEPS.items():
            out, budget = str(folder / method.replace("/", "-")), f"{steps}steps"
            fit_run(FitRequest(method=method, scene=str(balls), out=out, budget=budget, overrides=tuple(SMALL[method])))

    folder = once("looked-at", fit)
    return {method: folder / method.replace("/", "-") for method in STEPS}
