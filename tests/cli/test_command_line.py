"""The command line as a person meets it: in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from invgraphics.cli import main


def invgraphics(*arguments: str, cwd: Path | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "invgraphics", *arguments]
    env = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, cwd=cwd, env=env)


def refused(*arguments: str, cwd: Path | None = None) -> str:
    """The message of a command that must be refused for bad input: exit status 2, at most four lines, no traceback."""
    done = invgraphics(*arguments, cwd=cwd)
    assert done.returncode == 2, done
    lines = done.stderr.strip().splitlines()
    assert 1 <= len(lines) <= 4, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    return done.stderr


def test_unknown_command_is_refused_with_a_guess() -> None:
    message = refused("compere", "bricks")
    assert "no command 'compere'. Did you mean 'compare'?" in message
    assert "doctor" in message


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["fit", "volumetric/hash"], "SCENE"),
        (["fit", "volumetric/hash", "bricks", "--seed", "one"], "'one' is not a whole number"),
        (["fit", "volumetric/hash", "bricks", "--budget", "-5s"], "'-5s' is not a budget"),
        (["fit", "volumetric/hash", "bricks", "--size", "big"], "--size cannot be 'big'"),
        (["fit", "volumetric/hash", "bricks", "--test-views", "-1"], "--test-views cannot be '-1'"),
        (["compare", "bricks", "--methods", ","], "--methods is empty"),
        (["compare", "bricks", "--methods", "a", "--seeds", "x"], "--seeds cannot be 'x'"),
        (["evaluate", "no/such/run"], "is not a run"),
        (["report", "no/such/run"], "no/such/run"),
    ],
)
def test_bad_arguments_are_refused_in_a_few_lines(arguments: list[str], expected: str, capsys) -> None:
    try:
        status: object = main.run(arguments)
    except SystemExit as ended:
        status = ended.code
    said = capsys.readouterr()
    assert status == 2
    assert said.out == "" and expected in said.err and 1 <= len(said.err.strip().splitlines()) <= 4


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["fit"], "Missing from invgraphics fit: METHOD"),
        (["fit", "volumetric/hash", "bricks", "--budgte", "3s"], "--budget"),
        (["list", "animals"], "no list of 'animals'"),
    ],
)
def test_processes_end_with_a_few_lines_and_a_status(arguments: list[str], expected: str) -> None:
    assert expected in refused(*arguments)


def test_unknown_method_is_refused_with_the_known_ones(tmp_path) -> None:
    message = refused("fit", "volumetric/nrf", "bricks", "--out", "run", cwd=tmp_path)
    assert "no method 'volumetric/nrf'" in message
    assert "volumetric/nerf" in message
    assert list(tmp_path.iterdir()) == []  # nothing is left behind


def test_unknown_scene_is_refused_with_the_known_ones(tmp_path, capsys) -> None:
    """In this process: it imports torch."""
    commands = {
        "'atlantis' is neither a built-in scene nor an existing path": ["compare", "atlantis", "--methods", "volumetric/hash"],
        "no scene 'atlantis'": ["make-scene", "atlantis"],
    }
    for expected, words in commands.items():
        assert main.run([*words, "--out", str(tmp_path / "out")]) == main.BAD_INPUT
        out, message = capsys.readouterr()
        assert out == "" and expected in message and "bricks" in message and len(message.splitlines()) <= 4


def test_unwritable_output_is_refused_before_anything_is_rendered(tmp_path) -> None:
    (tmp_path / "file").write_text("")
    message = refused("make-scene", "bricks", "--out", str(tmp_path / "file" / "out"), "--spp", "1000000")
    assert str(tmp_path / "file") in message


def test_report_on_an_empty_folder_is_refused(tmp_path) -> None:
    assert str(tmp_path) in refused("report", str(tmp_path))


def test_debug_shows_the_traceback() -> None:
    done = invgraphics("list", "animals", "--debug")
    assert done.returncode == 2
    assert "Traceback" in done.stderr


@pytest.mark.parametrize("arguments", [["--help"], ["list"], ["compare", "--help"], ["fit", "--help"]])
def test_looking_around_imports_nothing_heavy(arguments: list[str]) -> None:
    script = (
        "import sys\n"
        "from invgraphics.cli.main import main\n"
        "try:\n    main(sys.argv[1:])\n"
        "finally:\n    print(sorted({'torch', 'numba', 'mitsuba', 'scipy', 'matplotlib'} & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", script, *arguments], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.strip() == "[]"


def test_list_answers_at_once() -> None:
    """At most six times the processor time of importing what every command needs (it is three to four; torch alone is 15).

    The two are measured in turns, so that a machine that is busy for a while slows both.
    """

    def seconds(*arguments: str) -> float:
        before = os.times()
        subprocess.run([sys.executable, *arguments], capture_output=True, timeout=60, check=True)
        after = os.times()
        return after.children_user + after.children_system - before.children_user - before.children_system

    turns = [(seconds("-m", "invgraphics", "list"), seconds("-c", "import tyro, rich.table")) for _ in range(3)]
    assert min(answer for answer, _ in turns) < 6 * min(imports for _, imports in turns)


def test_list_names_everything_that_is_registered() -> None:
    from invgraphics import plugins
    from invgraphics.cli.list import COMPONENTS

    text = invgraphics("list").stdout
    assert set(COMPONENTS.values()) | {"recipes"} == set(plugins.REGISTRIES)
    for registry in COMPONENTS.values():
        for name, target in plugins.names(registry).items():
            assert any(line.split()[:1] == [name] and target in line for line in text.splitlines()), name
    assert "splatting/gaussians" in text
    assert "bricks" in text


def test_a_third_party_package_shows_in_the_list(tmp_path) -> None:
    """A distribution made by hand, found through its entry points alone: its module does not even exist."""
    info = tmp_path / "their_package-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their-package\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[invgraphics.fields]\ntheirs = their_package:TheirConfig\n")
    done = invgraphics("list", "fields", PYTHONPATH=str(tmp_path))
    line = next(line for line in done.stdout.splitlines() if line.strip().startswith("theirs"))
    assert "their-package" in line
    assert "built in" in done.stdout


@pytest.mark.parametrize("argument", ["list", "--help"])
def test_a_closed_pipe_is_no_accident(argument: str) -> None:
    command = [sys.executable, "-m", "invgraphics", argument]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()  # before the command writes its first line
        assert process.stderr.read() == ""
    assert process.returncode == 1


def test_an_empty_list_of_methods_is_refused(tmp_path, capsys) -> None:
    """An unset shell variable is no request for the default ones."""
    assert main.run(["compare", "bricks", "--methods", "", "--out", str(tmp_path / "out")]) == main.BAD_INPUT
    assert "--methods is empty" in capsys.readouterr().err


def test_a_missing_file_of_a_study_is_named(tmp_path, capsys) -> None:
    assert main.run(["ablate", "nosuch.toml", "--out", str(tmp_path / "out")]) == main.BAD_INPUT
    assert "The file 'nosuch.toml' does not exist." in capsys.readouterr().err
