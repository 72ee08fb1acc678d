"""Options that would do nothing are refused in a sentence, before anything is opened."""

import pytest

from invgraphics.cli import main
from invgraphics.cli.arguments import parse
from invgraphics.cli.compare import Compare
from invgraphics.cli.fit import Fit

EXPORT = ["export", "no/run", "--out", "model", "--to"]
RENDER = ["render", "no/run", "--out", "film.mp4"]
FIT = ["fit", "volumetric/hash", "bricks", "--out", "no/run"]
COMPARE = ["compare", "bricks", "--out", "no/report", "--methods"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([*EXPORT, "mesh", "--planes", "8"], "--planes does nothing with --to mesh.\nLeave out --planes: it is for --to mpi."),
        ([*EXPORT, "ply", "--level", "0.0"], "--level does nothing with --to ply."),
        ([*EXPORT, "mpi", "--resolution", "192"], "--resolution does nothing with --to mpi."),
        ([*EXPORT, "spz", "--view", "0000"], "--view does nothing with --to spz."),
        ([*EXPORT, "splat", "--sh-degree", "2"], "--sh-degree does nothing with --to splat."),
        ([*EXPORT, "ply", "--world", "z-up"], "--world does nothing with --to ply."),
        (["export", "r", "--out", "a.obj", "--to", "mesh", "--world", "z-up"], "--world does nothing in a mesh"),
        ([*RENDER, "--path", "timelapse", "--frames", "30"], "--frames does nothing with --path timelapse"),
        ([*RENDER, "--path", "orbit", "--view", "0"], "--view does nothing along a path."),
        ([*RENDER, "--view", "3"], "or add --path timelapse."),
        ([*FIT, "--max-primitives", "99"], "--max-primitives does nothing for volumetric/hash, which has no Gaussians"),
        (
            [*COMPARE, "volumetric/hash,volumetric/nerf", "--max-primitives", "9"],
            "does nothing for these methods, which have no",
        ),
        (
            ["ablate", "families", "--gpus", "0"],
            "--gpus does nothing on this machine.\nLeave out --gpus, or add --executor ray.",
        ),
        ([*FIT, "--keep"], "--keep does nothing without --resume."),
        (["ablate", "families", "--gpus", "1", "--address", "a:1"], "--gpus and --address do nothing on this machine."),
        (["infer", "no/run", "--azimuth", "0"], "--azimuth does nothing without a photograph."),
        (["infer", "no/run", "--view", "a", "--elevation", "0"], "--view and --elevation do nothing without a photograph."),
        (["infer", "no/run", "a.png", "--views", "1"], "--views does nothing with a photograph."),
        (
            ["infer", "no/run", "a.png", "--no-prior", "9s", "--test-views", "4"],
            "--test-views and --no-prior do nothing with a",
        ),
        (["infer", "no/run", "a.png", "--view", "a", "--azimuth", "-60"], "--azimuth does nothing with --view"),
        (["report", "no/run", "--check", "--public"], "--public does nothing with --check"),
    ],
)
def test_an_option_that_does_nothing_is_refused(words: list[str], sentence: str, capsys) -> None:
    assert main.run(words) == main.BAD_INPUT
    message = capsys.readouterr().err
    assert sentence in message
    assert len(message.strip().splitlines()) == 2


@pytest.mark.parametrize(
    "words",
    [
        [*EXPORT, "splat", "--sh-degree", "0"],
        [*EXPORT, "spz", "--sh-degree", "2", "--world", "z-up"],
        ["export", "no/run", "--out", "a.glb", "--to", "mesh", "--world", "z-up", "--level", "1", "--resolution", "64"],
        [*EXPORT, "mpi", "--planes", "8", "--view", "0000"],
        [*RENDER, "--path", "timelapse", "--view", "0"],
        [*RENDER, "--frames", "9"],
    ],
)
def test_what_does_something_goes_on_to_the_run(words: list[str], capsys) -> None:
    assert main.run(words) == main.BAD_INPUT
    assert "no/run is not a run" in capsys.readouterr().err.replace("'", "")


def test_a_cap_is_refused_only_where_no_method_has_primitives() -> None:
    def check(*methods: str, preset: str = "laptop") -> None:
        words = ["bricks", "--methods", ",".join(methods), "--max-primitives", "99", "--preset", preset]
        parse(Compare, "invgraphics compare", words).check_primitives(methods)

    check("volumetric/hash", "splatting/gaussians")
    check("volumetric/point-nerf")
    check("volumetric/hash", preset="nonesuch")  # for whoever looks at presets to refuse
    parse(Fit, "invgraphics fit", ["volumetric/hash", "bricks"]).check_primitives(["volumetric/hash"])
