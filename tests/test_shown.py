"""What is shown is true: the README's table, commands, recipes and files are those of the code."""

import re
import shlex
import subprocess
from pathlib import Path

import pytest

from invgraphics.cli.main import main
from invgraphics.recipes.recipe import expand, load_method, methods
from invgraphics.recipes.table import markdown
from invgraphics.scenes.mitsuba.spec import names

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
COMMANDS = [shlex.split(line, comments=True) for line in re.findall(r"^(invgraphics .*)$", README, re.MULTILINE)]
TARGETS = re.findall(r"^make (\w+)", README, re.MULTILINE)


def test_commands_are_found_in_the_readme() -> None:
    """Without any, the tests of them below would all pass."""
    assert len(COMMANDS) > 10


def test_matrix_is_the_one_the_recipes_make() -> None:
    """To renew it: `invgraphics list matrix`, pasted between the markers."""
    shown = README.split("<!-- matrix: begin -->\n")[1].split("\n<!-- matrix: end -->")[0]
    assert shown == markdown()


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_commands_and_their_flags_exist(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([command[1], "--help"])
    assert not ended.value.code
    help_text = capsys.readouterr().out
    for word in command[2:]:
        if word.startswith("--"):
            assert re.search(rf"(?<![\w-]){word}(?![\w-])", help_text), word


def test_named_methods_scenes_and_settings_exist() -> None:
    for command in COMMANDS:
        for i, word in enumerate(command):
            if word == "--methods":
                assert set(expand(command[i + 1].split(","))[0]) <= set(methods())
            if word == "--set":
                load_method(command[2], None, [command[i + 1]])
    for scene in re.search(r"built-in ones \(([^;]*);", README).group(1).replace("\n", " ").split(","):
        assert scene.strip(" `") in names()


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text()
    assert TARGETS
    for target in TARGETS:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE)


def test_linked_files_exist() -> None:
    pages = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("*/README.md")]
    assert len(pages) > 10
    for page in pages:
        for link in re.findall(r"\]\((?!http)([^)#]+)(?:#[^)]*)?\)", page.read_text()):
            assert (page.parent / link).exists(), f"{page} links {link}"


def test_nothing_names_this_workplace() -> None:
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False).stdout.split()
    if not tracked:
        pytest.skip("not a git checkout")
    private = "../" + "shared"
    for name in tracked:
        path = ROOT / name
        if name != ".ci/run" and path.suffix in {".py", ".md", ".toml", ".txt", ".yml", ""} and path.is_file():
            assert private not in path.read_text(errors="ignore"), name
