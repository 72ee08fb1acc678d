"""The helpers of the teaching notebooks, without a kernel."""

import base64
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest
import torch

import invgraphics as ig
from invgraphics import notebook


@pytest.fixture(autouse=True)
def _no_window():
    with mpl.rc_context({"backend": "agg"}):
        yield
    plt.close("all")


def test_style_sets_the_colours_of_the_reports() -> None:
    notebook.style()
    (line,) = plt.plot([0, 1])
    assert line.get_color() == notebook.BLUE and not plt.gca().spines["top"].get_visible()


def test_a_row_of_pictures_fills_the_figure_with_square_cells() -> None:
    pictures = [torch.full((8, 16, 3), shade) for shade in (0.0, 0.5, 1.0)]
    axes = notebook.row(pictures, ["first", "second"], width=6, columns=2)
    assert [axis.get_title() for axis in axes] == ["first", "second", ""]
    assert axes[1].images[0].get_array()[0, 0].tolist() == [0.5, 0.5, 0.5]
    figure = axes[0].figure
    assert len(figure.axes) == 4 and not any(axis.axison for axis in figure.axes)
    assert figure.get_size_inches().tolist() == pytest.approx([6, 2 * (6 / 2 / 2) + notebook.TITLE])


def test_sliders_begin_at_the_defaults_and_draw_again() -> None:
    widgets = pytest.importorskip("ipywidgets", reason="needs the extra 'notebooks'")
    drawn, made = [], []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(widgets, "interact", lambda draw, **controls: made.append((draw, controls)))

        @notebook.sliders(count=(2, 10, 2), sigma=(0.5, 2, 0.5), density=[0.1, 1, 10])
        def draw(count: int = 4, sigma: float = 1.5, density: float = 10) -> None:
            drawn.append((count, sigma, density))

    ((redraw, controls),) = made
    assert [type(control).__name__ for control in controls.values()] == ["IntSlider", "FloatSlider", "SelectionSlider"]
    redraw(**{name: control.value for name, control in controls.items()})
    controls["count"].value = 100
    assert drawn == [(4, 1.5, 10)] and controls["count"].value == 10


def test_what_a_notebook_writes_is_gone_with_its_process() -> None:
    code = "from invgraphics import notebook; folder = notebook.scratch(); open('kept', 'w').close(); print(folder)"
    code += "; print((folder / 'kept').is_file())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    folder, written = done.stdout.split()
    assert written == "True" and not Path(folder).exists()


def test_a_film_becomes_part_of_the_page(tmp_path: Path) -> None:
    display = pytest.importorskip("IPython.display", reason="needs the extra 'notebooks'")
    film, shown = tmp_path / "film.mp4", []
    film.write_bytes(b"pictures")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(display, "display", shown.append)
        notebook.video(film, width=320)
    page = shown[0]._repr_html_()
    assert base64.b64encode(b"pictures").decode() in page and 'width="320"' in page


def test_psnr_is_the_one_that_scores_a_fit() -> None:
    scene = ig.testing.toy_scene(views=4, size=16)
    renderer = ig.renderers.volumetric.VolumetricConfig(ig.renderers.samplers.StratifiedConfig(16)).build(scene)
    model = ig.Model(ig.testing.TwoBalls(), renderer, scene.bounds)
    scores = ig.evaluate(model, scene).per_view("psnr")
    assert [notebook.psnr(model.render(view.camera), view, scene) for view in scene.test] == pytest.approx(scores)
