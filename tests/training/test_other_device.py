"""A fit and its evaluation on a device other than the CPU, which is pretended: nothing may be left behind on the CPU."""

import pytest
import torch
from other_device import Elsewhere, other_device
from test_lattice_methods import BATCH, SAMPLER, SHRUNK

from invgraphics.experiments.build import build_plan
from invgraphics.experiments.recorder import Monitor
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit

SPARSE = ["field.encoding.resolution=8", "field.appearance.resolution=8", "hooks=[]"]
METHODS = {
    "volumetric/nerf": [],
    "volumetric/hash": [],
    "volumetric/tensorf-vm": [*SHRUNK["volumetric/tensorf-vm"], *SAMPLER, *BATCH],
    "volumetric/plenoxels": SPARSE,
    "splatting/gaussians": [],
}


@pytest.mark.parametrize("name", METHODS)
def test_fit_and_evaluate_elsewhere(name: str, scene, small) -> None:
    with other_device() as device:
        fit = Fit(build_plan(small(name, *METHODS[name]), scene, Budget(steps=12), 0, device))
        fit.warmup_step()
        fit.run(lambda loss: False)
        assert fit.steps == 12
        assert all(isinstance(parameter, Elsewhere) for parameter in fit.plan.model.field.parameters())
        picture = fit.plan.model.render(scene.test[0].camera)
        assert Monitor(scene, device).psnr(fit) > 0
    assert picture.rgb.device.type == picture.depth.device.type == "cpu"
    assert bool(torch.isfinite(picture.rgb).all())
    assert float(picture.alpha.max()) > 0


def test_the_pretended_device_does_not_mix() -> None:
    with other_device() as device:
        there, here = torch.ones(3, device=device), torch.ones(3)
        with pytest.raises(RuntimeError, match="same device"):
            there + here
        with pytest.raises(RuntimeError, match="generator"):
            torch.rand(3, device=device, generator=torch.Generator())
        with pytest.raises((RuntimeError, TypeError), match="numpy"):
            there.numpy()
        assert (there + here.to(device)).cpu().tolist() == [2, 2, 2]
