"""One tiny run of each family, of one scene."""

from pathlib import Path

import pytest
from training_fixtures import SMALL, write_blender

from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.testing import toy_scene

STEPS = {"volumetric/nerf": 150, "volumetric/hash": 150, "splatting/gaussians": 60}


@pytest.fixture(scope="session")
def balls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two balls as a data set on disk."""
    return write_blender(toy_scene(views=10, size=32, zoom=1.3), tmp_path_factory.mktemp("view") / "balls")


@pytest.fixture(scope="session")
def runs(balls: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Method -> run folder."""
    root = tmp_path_factory.mktemp("looked-at")
    made = {}
    for method, steps in STEPS.items():
        out = root / method.replace("/", "-")
        request = FitRequest(
            method=method, scene=str(balls), out=str(out), budget=f"{steps}steps", overrides=tuple(SMALL[method])
        )
        made[method] = fit_run(request)
    return made
