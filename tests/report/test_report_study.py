"""A study's page and tables against scipy and statsmodels on the exported table, and folders that cannot be reported."""

from __future__ import annotations

import csv
import html
import itertools
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from pyarrow import parquet
from report_folders import (
    METHODS,
    STUDY_FACTORS,
    STUDY_SCENES,
    STUDY_SEEDS,
    study_cells,
    study_table,
    write_scores,
    write_study,
)
from scipy import stats
from statsmodels.stats.multitest import multipletests

from invgraphics.cli import main
from invgraphics.errors import InputError
from invgraphics.report.data.studies import read_study, scene_comparisons
from invgraphics.report.data.variants import short_names
from invgraphics.report.figures.effects import heat_map
from invgraphics.report.pages.across import across_scenes
from invgraphics.report.pages.study import design_words, study_facts
from invgraphics.report.statistics.effects import contrasts_of
from invgraphics.report.statistics.summary import summarise
from invgraphics.report.study import build_study_report, shown_variants, study_sentences
from invgraphics.report.wording import quality_quantity
from invgraphics.runs.scores import Score
from invgraphics.scenes.truth import POINTS

pytestmark = pytest.mark.usefixtures("unpainted")

VIEWS, LEVELS = STUDY_FACTORS
PSNR = quality_quantity("psnr", Score(mean=0.0, unit="dB", higher_is_better=True))


def exported(folder: Path) -> pd.DataFrame:
    return pd.read_csv(folder / "results.csv", dtype={"view": str, VIEWS: str, LEVELS: str})


def paired(table: pd.DataFrame, factor: str, before: str, after: str) -> pd.Series:
    """Mean difference of each (scene, seed) that has all levels of the other factor, from the exported table alone."""
    other = LEVELS if factor == VIEWS else VIEWS
    keys = ["scene", "method", "seed", "view", other]
    sides = [table[table[factor] == level].set_index(keys)["value"] for level in (before, after)]
    found = (sides[1] - sides[0]).dropna().reset_index().groupby(["scene", "seed"])
    levels = found[other].nunique()
    return found["value"].mean()[levels == levels.groupby("scene").transform("max")]


@pytest.mark.parametrize("metric", ["psnr", "flip", "ssim"])
def test_effects_are_what_scipy_and_statsmodels_find_in_the_exported_table(built_study: Path, metric: str) -> None:
    table = exported(built_study)
    table = table[(table["metric"] == metric) & (table["status"] == "ok")]
    page = (built_study / "index.html").read_text()
    rows = re.findall(
        rf'data-factor="([^"]+)" data-before="([^"]+)" data-after="([^"]+)" data-metric="{metric}">.*?data-value="([^"]+)"'
        r'.*?data-low="([^"]+)" data-high="([^"]+)">.*?</td><td>[^<]*</td><td>([^<]+)</td>',
        page,
    )
    assert [row[:3] for row in rows] == [(VIEWS, "40", "20"), (LEVELS, "8", "12"), (LEVELS, "8", "16"), (LEVELS, "12", "16")]
    p_values = []
    for factor, before, after, mean, low, high, _ in rows:
        units = paired(table, factor, before, after)
        one, other = (units[scene].to_numpy() for scene in STUDY_SCENES)
        expected = stats.ttest_ind(one, -other, equal_var=False)
        interval = expected.confidence_interval()
        assert float(mean) == pytest.approx((one.mean() + other.mean()) / 2, rel=1e-9)
        assert (float(low), float(high)) == pytest.approx((interval.low / 2, interval.high / 2), rel=1e-9)
        between, fits = (
            stats.sem([one.mean(), other.mean()]),
            expected.statistic and (one.mean() + other.mean()) / expected.statistic / 2,
        )
        # Scenes are the units of a verdict; that they agree better than their fits allow is chance.
        p_values.append(2 * stats.t.sf(abs(one.mean() + other.mean()) / 2 / max(between, abs(fits)), 1))
    corrected = multipletests(p_values, method="holm")[1]
    assert [float(row[6]) for row in rows] == pytest.approx(corrected, rel=0.06)  # two digits on the page


def test_parquet_holds_what_the_csv_holds(built_study: Path, built_report: Path) -> None:
    for folder in (built_study, built_report):
        with (folder / "results.csv").open(newline="") as file:
            lines = list(csv.DictReader(file))
        rows = parquet.read_table(folder / "results.parquet").to_pylist()
        assert len(rows) == len(lines) > 90
        for row, line in zip(rows, lines, strict=True):
            for name, value in row.items():
                if isinstance(value, float):
                    assert float(line[name]) == value
                else:
                    assert line[name] == (
                        "" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
                    )


def test_long_table_has_a_row_for_every_view_of_every_cell(built_study: Path) -> None:
    table = exported(built_study)
    done = table[(table["metric"] == "psnr") & (table["status"] == "ok")]
    assert len(done) == (18 - 2) * 3 + 18 * 2  # 3 views of the first scene, 2 of the second, one cell failed, one missing
    assert list(table.columns[:5]) == ["scene", "method", VIEWS, LEVELS, "seed"]
    failed = table[table["status"] == "failed"]
    assert failed["note"].tolist() == ["The loss is not finite at step 7."]
    assert (table["status"] == "missing").sum() == 1
    assert table[(table["group"] == "cost") & (table["metric"] == "steps")]["view"].isna().all()


def test_page_says_what_was_asked_found_and_lost(built_study: Path) -> None:
    page = html.unescape((built_study / "index.html").read_text())
    for words in (
        "What do training views and hash levels do?",
        "full factorial",
        "data.train_views 20 instead of 40: no verdict, −",
        "1 of train_views 40 (1 fit); what is left flatters 40",
        "field.encoding.levels 16 instead of 8: undecided, 0.86 dB [0.60, 1.13] for new fits on these 2 scenes, [−0.10, 1.83] ",
        "from 0.53 (train_views 20) to 1.14 (train_views 40); no scene decides it alone; an effect of 11.87 dB would be found",
        "1 of 36 cells failed",
        "1 of 36 cells has not run yet",
        "The loss is not finite at step 7.",
        "34 done, 1 failed, 1 missing",
        "for new fits on these scenes, each counted equally (the unit is the seed)",
        "for other scenes like these (the unit is the scene)",
        "2 seeds, not ranked",
        "How to read this",
        "Time to quality",
        "Quality against cost",
    ):
        assert words.lower() in page.lower(), words
    assert page.count('<td class="done') == 34
    sentences = study_sentences(built_study)
    assert len(sentences) == 4
    assert all(sentence in page for sentence in sentences)
    markdown = (built_study / "index.md").read_text()
    assert "## Failures" in markdown and "The loss is not finite" in markdown
    assert "| data.train\\_views | 20 − 40 | −" in markdown
    latex = (built_study / "effects.tex").read_text()
    assert latex.count(r"\textbf{") == 0  # two scenes are too few for any of the four
    assert latex.count("{") == latex.count("}")
    assert (built_study / "table-balls.tex").is_file() and (built_study / "table-moons.tex").is_file()
    for path in (built_study / "figures").rglob("*.svg"):
        ElementTree.parse(path)


def test_a_variant_that_lacks_a_hard_seed_is_never_called_best(built_study: Path) -> None:
    comparison = scene_comparisons(read_study(built_study))[0]
    rows = {row.label: row for row in summarise(comparison).rows}
    short, full = rows["levels 12"], rows["levels 16"]
    assert not short.complete and full.complete
    assert not any(cell.best for cell in short.cells)
    assert (short.cells[0].mean or 0) > (full.cells[0].mean or 0)  # by luck of the draw, which the mark must not follow


def test_heat_map_averages_over_what_all_fields_share(built_study: Path) -> None:
    study = read_study(built_study)
    psnr = quality_quantity("psnr", next(o.run for o in study.observations()).scores.quality["psnr"])
    table = heat_map((study.factors[0], study.factors[1]), psnr, study.observations())
    assert table is not None and table.matched and table.runs == 5
    scores = exported(built_study)
    scores = scores[(scores["metric"] == "psnr") & ~((scores["scene"] == "balls") & (scores["seed"] == 2))]
    # Seed 2 of the first scene lacks a field, so no field counts it; views are averaged within a run first.
    means = scores.groupby([VIEWS, LEVELS, "scene", "seed"])["value"].mean().groupby([VIEWS, LEVELS]).mean()
    assert table.values == pytest.approx(means.to_dict())


def test_no_heat_map_of_factors_that_were_never_combined(built_study: Path) -> None:
    """One factor at a time: a cross of fields through the base."""
    study = read_study(built_study)
    down, across = study.factors[0], study.factors[1]
    psnr = quality_quantity("psnr", next(o.run for o in study.observations()).scores.quality["psnr"])
    base = next(iter(study.observations())).levels
    cross = [o for o in study.observations() if any(o.levels[f.path] == base[f.path] for f in (down, across))]
    assert len({(o.levels[down.path], o.levels[across.path]) for o in cross}) == len(down.levels) + len(across.levels) - 1
    assert heat_map((down, across), psnr, cross) is None


def bare_study(root: Path, factors: dict[str, list[Any]], psnr_of: Callable[[dict[str, Any]], Any], **other: Any) -> Path:
    """A study of scores without pictures, to be read and compared only."""
    cells = study_cells(other.pop("scenes", STUDY_SCENES), other.pop("methods", METHODS[:1]), STUDY_SEEDS, factors)
    write_scores(root, cells, psnr_of)
    (root / "study.json").write_text(json.dumps(study_table(cells, factors, **other)))
    return root


def test_scenes_from_paths_have_their_last_folders_name(tmp_path: Path) -> None:
    """Where two have the same, both keep their paths."""
    scenes = ["balls", "$SOME_DATA/mic", "/here/fox", "/there/fox/"]
    study = read_study(bare_study(tmp_path, {}, lambda _: [30.0, 31.0], scenes=scenes))
    assert study.scenes == ("balls", "mic", "/here/fox", "/there/fox/")
    assert {one.scene for one in study.observations()} == set(study.scenes)


def test_null_study_says_no_effect_and_a_planted_one_is_found(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    shift = {20: -2.0, 40: 0.0}

    def psnr_of(cell: dict[str, Any]) -> Any:
        return 25 + shift[cell["levels"]["data.train_views"]] + rng.normal(0, 0.3) + rng.normal(0, 1, 6)

    sentences = study_sentences(bare_study(tmp_path, {"data.train_views": [40, 20], "field.seed_name": ["a", "b"]}, psnr_of))
    assert "costs 2." in sentences[0] or "costs 1." in sentences[0]
    assert re.fullmatch(
        r"field\.seed_name b instead of a: undecided, .* for new fits on these 2 scenes, .* would be found with 80% power "
        r"after correction for 2 comparisons\.",
        sentences[1],
    )


def test_methods_are_a_factor_and_factors_of_one_method_stay_its_own(tmp_path: Path) -> None:
    factor = f"{METHODS[1]}:field.encoding.levels"

    def psnr_of(cell: dict[str, Any]) -> Any:
        return [20.0 + METHODS.index(cell["method"]) + cell["levels"][factor] / 8 + 0.1 * cell["seed"]] * 2

    folder = bare_study(tmp_path, {factor: [8, 16]}, psnr_of, methods=METHODS[:2])
    table = json.loads((folder / "study.json").read_text())
    own = [cell for cell in table["cells"] if cell["method"] == METHODS[1] or cell["levels"][factor] == 8]
    (folder / "study.json").write_text(json.dumps(table | {"cells": own}))
    study = read_study(folder)
    assert study.variants == (METHODS[0], METHODS[1], f"{METHODS[1]}, levels 16")
    unknown = "no spread is known, so nothing is tested"
    assert study_sentences(folder) == [
        f"{METHODS[1]} instead of {METHODS[0]} gains 1.00 dB by the same amount each time, 3 seeds × 2 scenes: {unknown}.",
        f"{factor} 16 instead of 8 gains 1.00 dB by the same amount each time, 3 seeds × 2 scenes: {unknown}.",
    ]


def test_cells_may_share_a_run(tmp_path: Path) -> None:
    folder = bare_study(tmp_path, {"a.b": [1, 2]}, lambda cell: [20.0 + cell["seed"]])

    def share(table: dict[str, Any]) -> None:
        firsts = {(c["scene"], c["seed"]): c for c in table["cells"] if c["levels"]["a.b"] == 1}
        for cell in table["cells"]:
            cell |= {key: firsts[cell["scene"], cell["seed"]][key] for key in ("id", "run")}

    table = json.loads((folder / "study.json").read_text())
    share(table)
    (folder / "study.json").write_text(json.dumps(table))
    assert study_sentences(folder) == ["a.b 2 instead of 1: no difference at all, 3 seeds × 2 scenes."]


def test_one_at_a_time_pairs_around_the_base(tmp_path: Path) -> None:
    factors = {"a.x": [1, 2, 3], "b.x": ["p", "q"]}
    folder = bare_study(
        tmp_path, factors, lambda cell: [20.0 + cell["levels"]["a.x"] + cell["seed"]], base={"a.x": 2, "b.x": "p"}
    )
    table = json.loads((folder / "study.json").read_text())
    table["cells"] = [c for c in table["cells"] if (c["levels"]["a.x"] == 2) + (c["levels"]["b.x"] == "p") >= 1]
    (folder / "study.json").write_text(json.dumps(table))
    found = [sentence.split(" instead of ")[0] for sentence in study_sentences(folder)]
    assert found == ["a.x 1", "a.x 3", "a.x 3", "b.x q"]
    assert read_study(folder).factors[0].reference == "2"
    assert set(read_study(folder).variants) == {"base", "a.x 1", "a.x 3", "b.x q"}


def test_variants_are_named_by_their_difference_from_the_base(tmp_path: Path) -> None:
    factors = {"hooks.1.clone": [True, False], "field.isotropic": [False, True], "field.sh_degree": [2, 0]}
    study = read_study(bare_study(tmp_path, factors, lambda cell: [20.0 + cell["seed"] * cell["levels"]["field.sh_degree"]]))
    assert study.variants[:4] == ("base", "sh_degree 0", "isotropic", "isotropic, sh_degree 0")
    assert study.variants[-1] == "no clone, isotropic, sh_degree 0"
    labels = [sentence.partition(":")[0] for sentence in study_sentences(tmp_path)]
    assert labels[0] == "no clone" and labels[1].startswith("isotropic")
    assert "clone, no isotropic, sh_degree 2" in dict(study_facts(study)).values()


def test_facts_name_the_budgets_and_sizes_of_all_cells(tmp_path: Path) -> None:
    """A list of cells has settings of its own; the study's are those of cells that name none."""
    folder = bare_study(tmp_path, {}, lambda _: [30.0, 31.0], scenes=["balls", "cubes", "cones"])
    table = json.loads((folder / "study.json").read_text()) | {"budget": "60s", "size": None}
    own = {"balls": ("60s", 128), "cubes": ("5min", 128), "cones": ("1000steps", [800, 400])}
    table["cells"] = [cell | dict(zip(("budget", "size"), own[cell["scene"]], strict=True)) for cell in table["cells"]]
    (folder / "study.json").write_text(json.dumps(table))
    facts = dict(study_facts(read_study(folder)))
    assert facts["budget per fit"] == "60 s, 5 min and 1,000 steps"
    assert facts["picture size"] == "128 and 800 × 400"


def test_levels_have_the_words_that_the_study_gives_them(tmp_path: Path) -> None:
    factors = {"hooks.1.stop": [0.6, 0.0], "batches.rays": [1, 2, 3], "field.sh_degree": [2, 0]}
    words = {"hooks.1.stop 0": "no growth", "hooks.1.stop 0.6": "growth", "batches.rays 2": "some", "batches.rays 3": "many"}
    folder = bare_study(tmp_path, factors, lambda cell: [20.0 + cell["seed"]], words=words)
    study = read_study(folder)
    assert study.variants[0] == "base"
    assert study.variants[-1] == "no growth, many, sh_degree 0"
    assert "growth, rays 1, sh_degree 2" in dict(study_facts(study)).values()
    labels = [contrast.label for contrast in contrasts_of(study.factors)]
    assert labels == ["no growth", "some", "many", "many instead of some", "field.sh_degree 0 instead of 2"]
    assert study_sentences(folder)[0].startswith("no growth")


def test_a_full_factorial_is_called_one(tmp_path: Path) -> None:
    """One factor besides the method, whatever the study says of its design: every combination was planned."""
    factors = {"data.train_views": [40, 20]}
    crossed = bare_study(tmp_path / "a", factors, lambda cell: [20.0], methods=METHODS[:2], design="one-at-a-time")
    assert design_words(read_study(crossed)).startswith("full factorial")
    star = bare_study(tmp_path / "b", {"a.x": [1, 2], "b.x": [1, 2]}, lambda cell: [20.0], design="one-at-a-time")
    table = json.loads((star / "study.json").read_text())
    table["cells"] = [cell for cell in table["cells"] if sum(cell["levels"].values()) < 4]
    (star / "study.json").write_text(json.dumps(table))
    assert design_words(read_study(star)).startswith("one factor at a time")


def scoped_study(root: Path, **other: Any) -> Path:
    """A factorial study of two methods, with a factor that only the first one has."""
    factors = {"volumetric/*:a.x": [1, 2], "b.y": [1, 2]}
    folder = bare_study(root, factors, lambda cell: [20.0 + cell["seed"]], methods=[METHODS[0], METHODS[2]], **other)
    table = json.loads((folder / "study.json").read_text())
    table["cells"] = [
        cell for cell in table["cells"] if cell["method"] == METHODS[0] or cell["levels"]["volumetric/*:a.x"] == 1
    ]
    (folder / "study.json").write_text(json.dumps(table))
    return folder


def test_a_factorial_with_factors_of_single_methods_is_not_called_full(tmp_path: Path) -> None:
    assert METHODS[0].startswith("volumetric/") and not METHODS[2].startswith("volumetric/")
    assert design_words(read_study(scoped_study(tmp_path / "a"))).startswith("factorial within each method")
    own = bare_study(tmp_path / "b", {"volumetric/*:a.x": [1, 2]}, lambda cell: [20.0])  # all methods are in its scope
    assert design_words(read_study(own)).startswith("full factorial")


def test_an_interaction_that_was_not_measured_is_told(tmp_path: Path) -> None:
    """Of studies from before such questions were refused, and of unfinished ones."""
    asked = [["volumetric/*:a.x", "method"], ["b.y", "c.z"], ["volumetric/*:a.x", "b.y"]]
    folder = scoped_study(tmp_path, interactions=asked)
    told = [sentence for sentence in study_sentences(folder) if "was not measured" in sentence]
    assert told == [
        "The interaction of volumetric/*:a.x and method, about which the study asks, was not measured: "
        f"no finished fit has volumetric/*:a.x 2 and {METHODS[2]}.",
        "The interaction of b.y and c.z, about which the study asks, was not measured: c.z has a single level here.",
    ]
    table = json.loads((folder / "study.json").read_text())
    for cell in table["cells"]:
        odd = cell["seed"] == 0 if list(cell["levels"].values()) == [2, 2] else cell["seed"] > 0
        cell["status"] = "done" if odd else "missing"
    (folder / "study.json").write_text(json.dumps(table))
    assert "volumetric/*:a.x and b.y, about which the study asks, was not measured: no seed" in " ".join(
        study_sentences(folder)
    )


def test_the_best_of_many_levels_is_tested_against_the_next(tmp_path: Path) -> None:
    factors = {"batches.rays": [1, 2, 3, 4, 5, 6]}
    bare_study(tmp_path, factors, lambda cell: [20.0 + 2 * cell["levels"]["batches.rays"] + 0.1 * (cell["seed"] * 7 % 3)])
    *others, lead = study_sentences(tmp_path)
    assert len(others) == 5 and lead.startswith("best in PSNR against next: batches.rays 6 instead of 5 gains 2.00 dB")


def test_the_page_says_who_leads_among_many_levels(tmp_path: Path) -> None:
    folder = write_study(tmp_path / "many", {"balls": (0,)}, {"data.train_views": [5, 8, 20, 40, 80]}, (0, 1))
    build_study_report(folder)
    *_, lead = study_sentences(folder)
    assert lead.startswith("best in PSNR against next: data.train_views ")
    for page in ("index.html", "index.md"):
        assert lead in html.unescape((folder / page).read_text()).replace("\\", "")


def test_short_names_stay_distinct() -> None:
    assert short_names(["data.views", "field.levels"]) == {"data.views": "views", "field.levels": "levels"}
    assert short_names(["a.b.levels", "c.b.levels"]) == {"a.b.levels": "a.b.levels", "c.b.levels": "c.b.levels"}
    assert short_names(["levels", "a.levels"]) == {"levels": "levels", "a.levels": "a.levels"}


def test_study_before_its_first_run_has_a_page(small_study: Path, edit: Callable[..., None]) -> None:
    edit(small_study / "study.json", lambda t: [cell.update(status="missing") for cell in t["cells"]])
    page = build_study_report(small_study).read_text()
    assert "4 of 4 cells have not run yet" in page
    assert "Nothing can be compared yet" in page


def test_sentences_matrix_and_effects_are_of_the_studys_metric(pristine_study: Path, tmp_path: Path, edit: Any) -> None:
    """Recomputed from the exported table; a metric that no fit has is told, and PSNR stands in."""
    folder = Path(shutil.copytree(pristine_study, tmp_path / "views"))
    edit(folder / "study.json", lambda t: t.update(metric="flip"))
    page, told = build_study_report(folder).read_text(), (folder / "index.md").read_text()
    assert "Differences are of FLIP." in told and "figures/effects-flip.svg" in told
    table = exported(folder)
    flip = table[(table["metric"] == "flip") & (table["status"] == "ok")].groupby("cell")["value"].mean()
    fields = re.findall(r'<td class="done[^"]*" title="[^"]*"><a href="[^"]*">([^<]+)</a>', page)
    assert sorted(fields) == sorted(f"{value:.3f}" for value in flip)
    edit(folder / "study.json", lambda t: t.update(metric="psnr_at_1_8"))
    told = "The study asks about PSNR at 1/8, which no finished fit has: what follows is of PSNR."
    assert study_sentences(folder)[0] == told and told in build_study_report(folder).read_text()


def test_cells_of_other_code_are_told(small_study: Path, edit: Callable[..., None]) -> None:
    told = "Cells were made by 2 versions of the code"
    assert told not in build_study_report(small_study).read_text()
    edit(next(small_study.rglob("provenance.json")), lambda t: t.update(code_version="0.0.1+abc"))
    assert told in build_study_report(small_study).read_text()


def test_an_unequal_start_is_told_of_a_study_too(small_study: Path, edit: Callable[..., None]) -> None:
    for index, run in enumerate(sorted(path.parent for path in small_study.rglob("provenance.json"))):
        edit(run / "provenance.json", lambda t: t["notes"].update(points=POINTS))
        changes = (
            {"method": "splatting/gaussians", "cost": {"primitives": 10.0}} if index == 0 else {"method": "volumetric/hash"}
        )
        edit(run / "scores.json", lambda t, changes=changes: t.update(changes))
    told = "The start is not equal: splatting/gaussians may begin on exact surface points"
    assert told in build_study_report(small_study).read_text() and told in (small_study / "index.md").read_text()


def test_no_budget_is_stated_where_it_is_a_factor(tmp_path: Path) -> None:
    folder = bare_study(tmp_path, {"budget": ["1steps", "20steps"]}, lambda cell: [20.0])
    record = json.loads((folder / "study.json").read_text())
    for cell in record["cells"]:
        cell["budget"] = cell["levels"]["budget"].replace("steps", " steps")
    (folder / "study.json").write_text(json.dumps(record))
    assert {one.budget for one in scene_comparisons(read_study(folder))} == {""}
    for cell in record["cells"]:
        cell["budget"] = "1 steps"
    (folder / "study.json").write_text(json.dumps(record))
    assert {one.budget for one in scene_comparisons(read_study(folder))} == {"1 steps"}


def test_many_variants_show_pictures_of_eight_from_best_to_worst(tmp_path: Path) -> None:
    folder = bare_study(tmp_path, {"a.x": list(range(20))}, lambda cell: [20.0 + (7 * cell["levels"]["a.x"]) % 20])
    comparison = scene_comparisons(read_study(folder))[0]
    shown = shown_variants(comparison)
    quality = [comparison.runs_of(method)[0].scores.quality["psnr"].mean for method in shown]
    assert len(shown) == 8
    assert quality == sorted(quality, key=lambda value: -(value or 0))
    assert (quality[0], quality[-1]) == (39.0, 20.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.update(cells=[]), "lists no cells"),
        (lambda t: t.pop("cells"), "lacks the key 'cells'"),
        (lambda t: t["cells"][0].update(status="gone"), "'cells.0.status' cannot be 'gone'"),
        (lambda t: t["cells"][0].update(run="runs/nowhere"), "no run at"),
        (lambda t: t["cells"][0].pop("method"), "lacks the key 'cells.0.method'"),
        (lambda t: t.update(protocol=3), "'protocol' cannot be 3"),
    ],
)
def test_broken_studies_are_explained(
    small_study: Path, edit: Callable[..., None], change: Callable[[dict[str, Any]], Any], words: str
) -> None:
    edit(small_study / "study.json", change)
    with pytest.raises(InputError, match=words):
        build_study_report(small_study)


def test_report_command_knows_a_study(small_study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "page"
    assert main.run(["report", str(small_study), "--out", str(out)]) == main.DONE
    told = capsys.readouterr().out
    assert "data.train_views 20 instead of 40 costs" in told
    assert told.strip().endswith(str(out / "index.html"))
    assert main.run(["report", str(small_study), str(out)]) == main.BAD_INPUT
    assert "reported alone" in capsys.readouterr().err
    assert not (small_study / "index.html").exists()


def test_hostile_names_stay_text(small_study: Path, edit: Callable[..., None]) -> None:
    evil = "<script>alert(1)</script>|$x_1$`*"

    def poison(table: dict[str, Any]) -> None:
        table |= {"name": evil, "question": evil, "command": evil}
        for cell, scene in itertools.product(table["cells"], STUDY_SCENES[:1]):
            cell["levels"] = {evil if key == VIEWS else key: value for key, value in cell["levels"].items()}
            cell["scene"] = evil if cell["scene"] == scene else cell["scene"]
            cell["error"] = evil if cell["error"] else None

    edit(small_study / "study.json", poison)
    page = build_study_report(small_study)
    for path in [page, *small_study.rglob("figures/**/*.svg")]:
        assert "<script>alert" not in path.read_text(), path
    assert html.escape(evil, quote=False) in page.read_text()
    told = [
        line for line in (small_study / "index.md").read_text().splitlines() if not line.startswith("    ")
    ]  # code is inert
    assert "<script>" not in "".join(told)


def test_table_across_scenes_is_what_pandas_finds_and_refuses_means_of_different_scenes(built_study: Path) -> None:
    study = read_study(built_study)
    table = across_scenes(study, PSNR)
    assert table is not None
    found = exported(built_study)
    found = found[(found["metric"] == "psnr") & (found["status"] == "ok")]
    per_run = found.groupby([VIEWS, LEVELS, "scene", "seed"])["value"].mean()
    names = {cell.variant: (str(cell.levels[VIEWS]), str(cell.levels[LEVELS])) for cell in study.cells}
    ordered = [row for row in table.rows if row.mean is not None]
    assert [row.mean for row in ordered] == sorted((row.mean for row in ordered if row.mean is not None), reverse=True)
    assert len(ordered) < len(table.rows)  # some cells are lost
    for row in table.rows:
        values = per_run[names[row.variant]]
        for scene, value in zip(table.scenes, row.values, strict=True):
            if value is None:
                assert len(values.get(scene, [])) < len(STUDY_SEEDS) and scene in row.refused and row.mean is None
            else:
                assert value == pytest.approx(values[scene].mean(), abs=1e-9)
        if row.mean is not None:
            assert row.mean == pytest.approx(values.groupby("scene").mean().mean(), abs=1e-9)
    markdown = (built_study / "index.md").read_text()
    assert markdown.index(table.text(ordered[0].mean)) > markdown.index("## Across scenes")
    assert across_scenes(replace(study, scenes=study.scenes[:1]), PSNR) is None
