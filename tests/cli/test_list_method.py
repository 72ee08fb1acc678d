"""`invgraphics list METHOD`: what it shows is what ``--set`` takes; and helps that say what is so."""

import re
from pathlib import Path

import pytest

from invgraphics.cli import main
from invgraphics.cli.list import KINDS
from invgraphics.recipes.recipe import load_method, methods, presets
from invgraphics.recipes.settings import NOT_SET, described_attributes, settings_of, shown


@pytest.fixture
def shows(capsys):
    """Run a command that must end well; returns what it printed, with white space as single blanks."""

    def run(*words: str) -> str:
        with pytest.raises(SystemExit) as stop:
            main.main(words)
        assert not stop.value.code
        return " ".join(re.sub("[│╭╮╰╯─]", " ", capsys.readouterr().out).split())

    return run


def test_a_method_is_shown_with_paper_presets_and_keys(shows) -> None:
    text = shows("list", "volumetric/hash", "protocols")
    assert "marched through an occupancy grid. Paper: Müller et al. 2022" in text
    assert "Presets (chosen on): laptop (bricks, fence, materials, mic, textured), long, hour, paper" in text
    assert "Settings under the preset laptop (--set KEY=VALUE)" in text
    levels = load_method("volumetric/hash").recipe.field.encoding.levels
    assert f"field.encoding.levels {levels} number of resolutions." in text
    assert "Protocols" in text


def test_a_preset_and_changes_are_those_of_the_name(shows, tmp_path: Path) -> None:
    long = load_method("volumetric/hash", "long").recipe
    text = shows("list", "volumetric/hash:preset=long:batches.views=7")
    assert "Settings under the preset long" in text
    assert f"field.encoding.log2_size {long.field.encoding.log2_size} most entries of a level, as a power of two." in text
    assert "batches.views 7 most views" in text
    file = tmp_path / "mine.toml"
    file.write_text((Path(__file__).parents[2] / "renderers/volumetric/hash.toml").read_text().split("[presets")[0])
    assert "Presets (chosen on): none Settings without a preset" in shows("list", str(file))


@pytest.mark.parametrize("name", [name for name in methods() if not name.startswith("sphere")])
def test_what_is_shown_can_be_set(name: str) -> None:
    """Setting every shown value makes the same recipe; every key that is there is shown; most have a meaning."""
    for preset in presets(name):
        method = load_method(name, preset)
        settings = settings_of(method.recipe)
        there = [one for one in settings if one.value != NOT_SET and not one.value.startswith("(")]
        again = load_method(name, preset, [f"{one.key}={one.value}" for one in there])
        assert again.digest == method.digest
        assert len({one.key for one in settings}) == len(settings)
        absent = [one.key for one in settings if not one.meaning]
        assert len(absent) <= 0.1 * len(settings), absent


def test_a_part_that_is_not_there_shows_what_it_would_be() -> None:
    settings = {one.key: one.value for one in settings_of(load_method("volumetric/hash").recipe)}
    assert settings["training"] == NOT_SET
    assert settings["training.poses.optimise"] == "(true)"
    method = load_method("volumetric/hash", overrides=["training.poses.optimise=false"])
    settings = {one.key: one.value for one in settings_of(method.recipe)}
    assert (settings["training.poses.optimise"], settings["training.exposure"]) == ("false", NOT_SET)


def test_meanings_are_first_sentences_of_the_docstring() -> None:
    class Base:
        """Base.

        Attributes:
            one: first, by
                Yariv et al. 2020. Second.
            two, three: shared.

        Args:
            four: none.
        """

    class Derived(Base):
        """Derived.

        Attributes:
            two (int): its ``own``.
        """

    assert described_attributes(Derived) == {"one": "first, by Yariv et al. 2020.", "two": "its own.", "three": "shared."}


def test_text_is_quoted_where_it_would_be_read_as_something_else() -> None:
    assert [shown(value) for value in ("adam", "3", "", "true", ("a", "b"), 1e-5, False)] == [
        "adam",
        '"3"',
        '""',
        '"true"',
        '["a", "b"]',
        "1e-05",
        "false",
    ]


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("instant-ngp", "There is no list of 'instant-ngp'. Did you mean 'volumetric/hash'?"),
        ("method", "There is no list of 'method'. Did you mean 'methods'?"),
        ("volumetric/hahs", "There is no method 'volumetric/hahs'. Did you mean 'volumetric/hash'?"),
        ("volumetric/hash:preset=lnog", "has no preset 'lnog'. Did you mean 'long'?"),
        ("nonesuch.toml", "nonesuch.toml does not exist"),
    ],
)
def test_what_cannot_be_listed_is_refused(word: str, sentence: str, capsys) -> None:
    assert main.run(["list", "protocols", word]) == main.BAD_INPUT
    shown = capsys.readouterr()
    assert sentence in shown.err and shown.out == ""


def test_helps_say_what_is_so(shows) -> None:
    listed = shows("list", "--help")
    assert all(re.search(rf"\b{kind}\b", listed.split("What to list:")[1]) for kind in KINDS)
    assert "--no-open Do not open the page in a browser. (default: it is opened, where there is a screen)" in shows(
        "view", "--help"
    )
    report = shows("report", "--help")
    assert "needed for single runs" in report and "(default: )" not in report


@pytest.mark.parametrize("seed", ["-1", str(2**63), "9" * 5000])
@pytest.mark.parametrize(
    "words",
    [
        ["fit", "volumetric/hash", "bricks", "--seed"],
        ["compare", "bricks", "--methods", "volumetric/hash", "--seeds"],
        ["ablate", "families", "--seeds"],
    ],
    ids=lambda words: words[0],
)
def test_seeds_out_of_range_are_refused(words: list[str], seed: str, capsys) -> None:
    assert main.run([*words, seed]) == main.BAD_INPUT
    message = capsys.readouterr().err
    assert words[-1] in message and len(message.strip().splitlines()) <= main.MOST_LINES
    if len(seed) < 100:
        assert f"{words[-1]} cannot be" in message and str(2**63 - 1) in message
