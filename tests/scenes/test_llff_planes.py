"""A multi-plane image of a folder of LLFF: made of the toy scene, loaded, fitted, scored on its held-out views."""

import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from invgraphics.core import Scene
from invgraphics.core.transforms import opencv_to_llff
from invgraphics.experiments.build import build_plan
from invgraphics.fields.planes import PlaneField
from invgraphics.recipes.recipe import load_method
from invgraphics.scenes.open import SceneOptions, open_scene
from invgraphics.testing import toy_scene
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit

SIZE = 28


def write_llff(scene: Scene, folder: Path) -> Path:
    """Write opaque photographs and ``poses_bounds.npy``, near and far from 1.8 to 4.2."""
    rows = []
    (folder / "images").mkdir(parents=True)
    for index, view in enumerate(scene.train):
        image = (view.over(torch.tensor([0.2, 0.3, 0.25])) * 255).round().byte().numpy()
        Image.fromarray(image).save(folder / "images" / f"{index:03}.png")
        hwf = torch.tensor([[SIZE, SIZE, float(view.camera.focal[0])]]).T
        rows.append([*torch.cat([opencv_to_llff(view.camera.cam_to_world), hwf], dim=1).flatten().tolist(), 1.8, 4.2])
    np.save(folder / "poses_bounds.npy", np.array(rows, dtype=np.float64))
    return folder


def psnr(model, scene: Scene) -> float:
    errors = [
        (model.render(view.camera, normals=False).over(scene.background) - view.colour()).square().mean() for view in scene.test
    ]
    return -10 * math.log10(float(torch.stack(errors).mean()))


def test_planes_fit_a_folder_of_llff(tmp_path: Path) -> None:
    balls = toy_scene(views=12, size=SIZE, checks=2.5, zoom=1.2, facing="forward")
    folder = write_llff(balls, tmp_path / "balls")
    scene = open_scene(str(folder), SceneOptions())
    assert scene.bounds.space == "contracted"
    assert len(scene.test) == 2
    overrides = ["field.count=12", "field.far=2.0"]
    plan = build_plan(load_method("planes/mpi", "laptop", overrides), scene, Budget(steps=120), 0, torch.device("cpu"))
    assert isinstance(plan.model.field, PlaneField)
    assert float(plan.model.field.depths[0]) > 0
    before = psnr(plan.model, scene)
    Fit(plan).run(lambda loss: False)
    after = psnr(plan.model, scene)
    mean = torch.stack([view.colour() for view in scene.train]).mean(dim=0)
    average = -10 * math.log10(float(torch.stack([(mean - view.colour()).square().mean() for view in scene.test]).mean()))
    assert after > before + 2
    assert after > average + 0.3  # the views differ little
    # Its depth, in the data set's units, is that of the balls, not of one plane for all.
    view, true = scene.test[0], balls.train[0].depth
    depth = plan.model.render(view.camera).depth * scene.scale
    seen = true.isfinite()
    assert float((depth - true)[seen].abs().median()) < 0.3
