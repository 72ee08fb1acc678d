"""What a study states and asks before anything runs: refused where its cells and scores cannot answer it."""

import csv
from pathlib import Path

import pytest

from invgraphics.errors import InputError
from invgraphics.metrics.keys import quality_keys
from invgraphics.studies.reading import read_study

HEAD = 'question = "Why?"\nscenes = ["a", "b"]\nmethods = ["volumetric/hash", "splatting/gaussians"]\nseeds = [0, 1]\n'
HASH = 'question = "Why?"\nscenes = ["a"]\nmethods = ["volumetric/hash"]\n'
STAR, LIST = 'design = "one-at-a-time"\n', 'design = "list"\n'
SCOPED = '[factors]\n"splatting/*:field.isotropic" = [false, true]\n"data.train_views" = [6, 12, 24]\n'
TWO = '[factors]\n"data.train_views" = [6, 12, 24]\n"batches.rays" = [8, 16]\n'
RAYS = 'interactions = [["data.train_views", "batches.rays"]]\n'


@pytest.fixture
def study(tmp_path: Path):
    def read(text: str):
        (tmp_path / "trial.toml").write_text(text)
        return read_study(tmp_path / "trial.toml")

    return read


def interaction(first: str, second: str) -> str:
    return f'interactions = [["{first}", "{second}"]]\n'


def cells(*levels: tuple[int, int], more: str = "") -> str:
    return "".join(f'[[cells]]\n"data.train_views" = {views}\n"batches.rays" = {rays}\n{more}' for views, rays in levels)


def prediction(before: str, after: str, more: str = "") -> str:
    return f'[[predictions]]\ntext = "Less."\nsource = "me"\nbefore = {{ {before} }}\nafter = {{ {after} }}\nhigh = 0.0\n{more}'


VIEWS = ('"data.train_views" = 12', '"data.train_views" = 6')
CORNERS = [(6, 8), (6, 16), (24, 8)]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (HEAD + "margins = { psrn = 1.0 }\n", r"\[margins\] names the metric 'psrn', .* Did you mean 'psnr'"),
        (HEAD + "margins = { psnr_at_1_4 = 1.0 }\n", "'psnr_at_1_4', which no fit"),
        (HEAD + 'metric = "psrn"\n', "the key 'metric' names the metric 'psrn', .* Did you mean 'psnr'"),
        (HEAD + 'metric = "psnr_at_1_4"\n', "'psnr_at_1_4', which no fit"),
        (HEAD + TWO + prediction(*VIEWS, 'metric = "psrn"\n'), "prediction 1 names the metric 'psrn', .* mean 'psnr'"),
        (HEAD + TWO + prediction(*VIEWS, 'metric = "fit_seconds"\n'), "'fit_seconds', which no fit"),
        (
            HEAD + interaction("splatting/*:field.isotropic", "method") + SCOPED,
            "cannot be measured: no cell has splatting/.:field.isotropic = true and method = volumetric/hash",
        ),
        (HASH + interaction("data.train_views", "method") + TWO, "'method' has a single level"),
        (HASH + RAYS + TWO.replace("[8, 16]", "[8]"), "'batches.rays' has a single level"),
        (HASH + STAR + RAYS + TWO, "no cell has data.train_views = 24 and batches.rays = 16"),
        (HASH + LIST + RAYS + cells(*CORNERS), "no cell has data.train_views = 24 and batches.rays = 16"),
        (
            HEAD + LIST + RAYS + cells(*CORNERS, more='scenes = ["a"]\n') + cells((24, 16), more='scenes = ["b"]\n'),
            "no scene and other levels in common",
        ),
        (
            HEAD + LIST + RAYS + cells(*CORNERS, more="seeds = [0]\n") + cells((24, 16), more="seeds = [1]\n"),
            "no scene and other levels in common",
        ),
        (
            HASH + STAR + TWO + prediction(*(f'{side}, "batches.rays" = 16' for side in VIEWS)),
            "prediction 1 cannot be measured: no cell has data.train_views = 12 and batches.rays = 16",
        ),
        (HASH + LIST + cells((6, 8), (12, 16)) + prediction(*VIEWS), "prediction 1 cannot be measured: its sides"),
    ],
)
def test_questions_without_an_answer_are_refused(study, text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence) as error:
        study(text)
    assert len(str(error.value).splitlines()) <= 2


@pytest.mark.parametrize(
    "text",
    [
        HEAD + "margins = { psnr = 1.0, f_score = 0.1, pose_rotation_deg = 0.1, fit_seconds = 2.0 }\n",
        HEAD + "margins = { psnr_at_1_4 = 1.0 }\n[base]\ndata.test_scales = [2, 4]\n",
        HEAD + 'metric = "psnr_at_1_4"\n[base]\ndata.test_scales = [2, 4]\n',
        HEAD + 'margins = { ssim_at_1_8 = 0.1 }\n[factors]\n"volumetric/*:data.test_scales" = [[2], [4, 8]]\n',
        HEAD + interaction("method", "data.train_views") + TWO,
        HEAD + interaction("splatting/*:field.isotropic", "data.train_views") + SCOPED,
        HASH + LIST + RAYS + cells(*CORNERS, (24, 16)),
        # Fits of two methods need no seed in common.
        HEAD
        + LIST
        + interaction("data.train_views", "method")
        + cells((6, 8), (12, 8), more='methods = ["volumetric/hash"]\nseeds = [0]\n')
        + cells((6, 8), (12, 8), more='methods = ["splatting/gaussians"]\nseeds = [1]\n'),
        HASH + STAR + TWO + prediction(*VIEWS),
        HEAD + SCOPED + prediction('method = "volumetric/hash"', 'method = "splatting/gaussians"'),
    ],
)
def test_questions_with_an_answer_are_accepted(study, text: str) -> None:
    study(text)


def test_keys_are_those_of_finished_runs() -> None:
    """Of the reports that come along."""
    found = set()
    for path in (Path(__file__).parents[2] / "reports").glob("*/results.csv"):
        with path.open() as file:
            found |= {row["metric"] for row in csv.DictReader(file) if row["group"] == "quality"}
    assert {"psnr", "chamfer"} <= found <= set(quality_keys([2, 4, 8]))
