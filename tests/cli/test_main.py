"""Exit statuses and messages, and the reading of arguments, without processes."""

import errno
import sys
from pathlib import Path

import pytest

from invgraphics.cli import arguments, main
from invgraphics.cli.compare import Compare
from invgraphics.cli.evaluate import Evaluate
from invgraphics.cli.fit import Fit
from invgraphics.cli.output import not_scored
from invgraphics.errors import InputError, NumericalError

AGAIN = "Free some space there, and give the command again (a fit: with --resume).\n"


class Failing:
    """A command that raises what it is given."""

    error: BaseException

    def run(self) -> int:
        raise self.error


@pytest.mark.parametrize(
    ("error", "status", "expected"),
    [
        (InputError("wrong", "do this"), 2, "wrong\ndo this\n"),
        (InputError("1\n2\n3", "4\n5"), 2, "1\n2\n3\n4\n"),
        (NumericalError("step 7: density is not finite"), 1, "step 7: density is not finite\n"),
        (KeyboardInterrupt(), 130, "Interrupted.\n"),
        (OSError(errno.ENOSPC, "No space left on device", "/x/y"), 2, "'/x/y' cannot be written: the disk is full.\n" + AGAIN),
        (PermissionError(errno.EACCES, "Permission denied", "/x"), 2, "'/x' cannot be used: permission denied.\n"),
        (OSError(errno.EROFS, "Read-only", "/x"), 2, "'/x' cannot be used: the file system is read-only.\n"),
        (
            RuntimeError("I/O error: No space left on device (os error 28)"),
            2,
            f"A file cannot be written: the disk is full.\n{AGAIN}",
        ),
        (MemoryError(), 1, "There is not enough memory.\nTry a smaller --size, or smaller settings of the method (--set).\n"),
    ],
)
def test_what_goes_wrong_becomes_a_sentence_and_a_status(error, status, expected, monkeypatch, capsys) -> None:
    command = Failing()
    command.error = error
    monkeypatch.setattr(main, "_command", lambda name: None)
    monkeypatch.setattr(main, "parse", lambda *_: command)
    with pytest.raises(SystemExit) as stop:
        main.main(["fit"])
    assert stop.value.code == status
    assert capsys.readouterr().err == expected


def test_an_unexpected_error_owns_up(monkeypatch, capsys) -> None:
    command = Failing()
    command.error = KeyError("tensor")
    monkeypatch.setattr(main, "_command", lambda name: None)
    monkeypatch.setattr(main, "parse", lambda *_: command)
    assert main.run(["fit"]) == 1
    message = capsys.readouterr().err
    assert message.startswith("Unexpected KeyError: 'tensor'\n")
    assert "--debug" in message


def test_the_status_of_a_command_is_passed_on(monkeypatch) -> None:
    monkeypatch.setattr(main, "parse", lambda *_: type("Partly", (), {"run": lambda self: 1})())
    assert main.run(["fit"]) == main.FAILED


@pytest.mark.parametrize("name", main.COMMANDS)
def test_every_command_has_help(name: str, capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        main.main([name, "--help"])
    assert not stop.value.code
    text = capsys.readouterr().out
    assert f"usage: invgraphics {name}" in text
    assert name in main.overview()


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("render", "--out FILM.mp4 [-h] [OPTIONS] RUN"),
        ("explain", "--view N --pixel COLUMN,ROW [-h] [OPTIONS] RUN"),
        ("import", "--scene SCENE [-h] [OPTIONS] FILE"),
        ("evaluate", "[-h] RUN [SCENE] [--protocol NAME]"),
        ("view", "[-h] [OPTIONS] RUN [RUN2]"),
        ("list", "[-h] [KIND|METHOD ...]"),
        ("report", "[-h] RUN ... [--out FOLDER] [--public] [--check]"),
    ],
)
def test_usage_tells_what_is_optional(name: str, expected: str, capsys) -> None:
    with pytest.raises(SystemExit):
        main.main([name, "--help"])
    assert capsys.readouterr().out.splitlines()[0] == f"usage: invgraphics {name} {expected}"


@pytest.mark.parametrize(
    ("words", "guess"),
    [
        (["fit", "volumetric/hahs", "bricks"], "volumetric/hash"),
        (["fit", "gaussians", "bricks"], "splatting/gaussians"),
        (["compare", "brics", "--methods", "volumetric/hash"], "bricks"),
        (["fit", "volumetric/hash", "bricks", "--preset", "laptpo"], "laptop"),
        (["fit", "volumetric/hash", "bricks", "--set", "batches.ray=3"], "rays"),
        (["fit", "volumetric/hash", "bricks", "--set", "fields.width=3"], "field"),
        (["fit", "volumetric/hash", "bricks", "--set", "field.encoding.type=hesh"], "hash"),
        (["fit", "volumetric/hash", "bricks", "--protocol", "defualt"], "default"),
        (["make-scene", "material"], "materials"),
        (["ablate", "training-view"], "training-views"),
        (["list", "method"], "methods"),
        (["rescore", "nowhere", "--protocol", "defualt"], "default"),
    ],
)
def test_misspelt_names_get_a_guess(words: list[str], guess: str, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert main.run(words) == main.BAD_INPUT
    assert f"Did you mean '{guess}'?" in capsys.readouterr().err


def test_what_could_not_be_scored_takes_one_line() -> None:
    reasons = {
        "ms_ssim": "needs 161 pixels",
        "lpips": "the package lpips is not installed",
        "depth_rmse": "the scene has no true depth",
        "depth_abs_rel": "the scene has no true depth",
        "normal_deg": "the scene has no true normals",
        "alpha_iou": "the scene has no true alpha",
    }
    assert not_scored(reasons) == (
        "Not scored (6 metrics): the scene has no true depth, normals, alpha; ms_ssim: needs 161 pixels; "
        "lpips: the package lpips is not installed."
    )


@pytest.mark.parametrize(
    ("text", "size"), [("480", 480), ("640x480", (640, 480)), ("64X32", (64, 32)), ("16×8", (16, 8)), (" 9 ", 9)]
)
def test_sizes(text: str, size) -> None:
    assert arguments.parse_size(text) == size


@pytest.mark.parametrize("text", ["", "0", "-480", "640x", "x480", "640x480x3", "4.5", "1e3", "640x7", "7", "big"])
def test_bad_sizes(text: str) -> None:
    with pytest.raises(InputError, match="--size"):
        arguments.parse_size(text)


def test_numbers_of_views() -> None:
    assert arguments.parse_views("all") is None
    assert arguments.parse_views("16") == 16
    for text in ("0", "-3", "", "few", "1.5"):
        with pytest.raises(InputError, match="--test-views"):
            arguments.parse_views(text)


def test_samples_per_pixel() -> None:
    assert arguments.parse_samples(None) is None
    with pytest.raises(InputError, match="--spp cannot be 0"):
        arguments.parse_samples(0)


def test_fit_becomes_a_request() -> None:
    words = ["splatting/gaussians", "data/fox/", "--budget", "2m", "--set", "batches.rays=-2", "--set", "a.b=c d"]
    words += ["--size", "480", "--test-views", "all", "--seed", "3", "--optimise", "exposure,poses"]
    request = arguments.parse(Fit, "invgraphics fit", words).request()
    assert (request.method, request.scene, request.budget, request.seed) == ("splatting/gaussians", "data/fox/", "2m", 3)
    optimised = ("training.exposure.optimise=true", "training.poses.optimise=true")
    assert request.overrides == ("batches.rays=-2", "a.b=c d", *optimised)
    with pytest.raises(InputError, match=r"--optimise cannot be 'lens'.*\n?.*poses, exposure"):
        arguments.parse(Fit, "invgraphics fit", [*words[:-1], "lens"]).request()
    assert (request.size, request.test_views, request.existing) == (480, None, "refuse")
    assert Path(request.out) == Path("runs/fox-splatting-gaussians-seed-3")


def test_the_recorded_command_gives_the_same_request(tmp_path) -> None:
    """What a run writes down to be reproduced by is read back as itself."""
    import shlex

    words = ["volumetric/hash", "bricks", "--preset", "paper", "--size", "64x48", "--set", "x=[1, 2]", "--device", "cpu"]
    words += ["--kernels", "reference", "--protocol", "float", "--spp", "32", "--out", str(tmp_path)]
    request = arguments.parse(Fit, "invgraphics fit", words).request()
    again = arguments.parse(Fit, "invgraphics fit", shlex.split(request.shell())[2:]).request()
    assert again == request
    assert again.spp == 32
    comparison = arguments.parse(
        Compare, "invgraphics compare", ["bricks", "--methods", "a/b, c/d", "--seeds", "0,2", "--out", str(tmp_path)]
    ).request()
    assert (comparison.methods, comparison.seeds) == (("a/b", "c/d"), (0, 2))
    assert arguments.parse(Compare, "invgraphics compare", shlex.split(comparison.shell())[2:]).request() == comparison


def test_resume_is_asked_for() -> None:
    command = arguments.parse(Fit, "invgraphics fit", ["a/b", "bricks", "--out", "r", "--resume"])
    assert command.request().existing == "resume"


def test_compare_names_its_folder_after_the_scene() -> None:
    request = arguments.parse(Compare, "invgraphics compare", ["bricks", "--methods", "a/b"]).request()
    assert Path(request.out) == Path("reports/compare-bricks")


def test_evaluate_takes_another_copy_of_the_scene() -> None:
    command = arguments.parse(Evaluate, "invgraphics evaluate", ["run", "elsewhere/fox"])
    assert (command.folder, command.scene, command.protocol) == (Path("run"), "elsewhere/fox", "default")


def test_a_strange_complaint_is_still_a_sentence() -> None:
    assert arguments.condense("") == ("The arguments cannot be read.", "")
    assert arguments.condense("╭─ X ────╮\n│ no rules │\n╰────────╯") == ("no rules", "")


@pytest.fixture
def refused(capsys):
    """Run a command that must be refused for bad input, in this process, which has imported torch already."""

    def run(*arguments: str) -> str:
        assert main.run(arguments) == main.BAD_INPUT
        message = capsys.readouterr().err
        assert 1 <= len(message.strip().splitlines()) <= main.MOST_LINES
        return message

    return run


def test_unknown_setting_is_refused_with_the_known_ones(refused, tmp_path) -> None:
    message = refused("fit", "volumetric/hash", "bricks", "--set", "batches.rayz=7", "--out", str(tmp_path / "run"))
    assert "'batches.rayz'" in message
    assert "rays" in message


def test_unknown_preset_is_refused_with_the_known_ones(refused, tmp_path) -> None:
    message = refused("fit", "volumetric/hash", "bricks", "--preset", "huge", "--out", str(tmp_path / "run"))
    assert "'huge'" in message
    assert "laptop" in message


def test_folder_that_is_no_data_set_is_refused(refused, tmp_path) -> None:
    (tmp_path / "empty").mkdir()
    message = refused("fit", "volumetric/hash", str(tmp_path / "empty"), "--kernels", "reference", "--out", str(tmp_path / "r"))
    assert "empty folder" in message


@pytest.mark.parametrize("command", [["fit", "volumetric/hash"], ["compare", "--methods", "volumetric/hash"]])
def test_unwritable_output_is_refused(command: list[str], refused, tmp_path) -> None:
    (tmp_path / "file").write_text("")
    assert str(tmp_path / "file") in refused(*command, "bricks", "--out", str(tmp_path / "file" / "out"))


def test_doctor_looks_at_everything(capsys, monkeypatch) -> None:
    monkeypatch.setenv("INVGRAPHICS_DATA", "/no/such/folder")
    assert main.run(["doctor"]) == main.DONE
    text = capsys.readouterr().out
    for subject in ("processor", "torch", "Numba kernels", "Mitsuba", "CUDA", "LPIPS", "INVGRAPHICS_DATA"):
        assert subject in text
    assert "/no/such/folder is no folder" in text


def test_arguments_default_to_those_of_the_process(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["invgraphics", "--version"])
    with pytest.raises(SystemExit) as stop:
        main.main()
    assert stop.value.code == 0
    assert capsys.readouterr().out.strip()


def test_commas_within_values_do_not_separate_names() -> None:
    sampler = 'volumetric/hash:renderer.sampler={type="stratified",samples=64}'
    lists = "volumetric/nerf:hooks=[[1,2],[3,4]]"
    quoted = "a:b='x,y'"
    assert arguments.parse_list(f"{sampler},{lists},{quoted}, c", "--methods") == (sampler, lists, quoted, "c")
