"""The page in a real browser, opened from disk."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.browser

ARGUMENTS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("there is no Chromium on this machine")
    with playwright.sync_playwright() as driver:
        instance = driver.chromium.launch(executable_path=chromium, args=ARGUMENTS)
        yield instance
        instance.close()


@pytest.fixture
def opened(browser: Any, built_report: Path) -> Iterator[Any]:
    """Opens the report with given options; complaints of the page and requests are kept in ``page.heard``."""
    contexts = []

    def visit(**options: Any) -> Any:
        context = browser.new_context(**options)
        contexts.append(context)
        page = context.new_page()
        page.heard = {"complaints": [], "requests": []}
        page.on("console", lambda message: page.heard["complaints"].append(message.text) if message.type != "log" else None)
        page.on("pageerror", lambda error: page.heard["complaints"].append(str(error)))
        page.on("requestfailed", lambda request: page.heard["complaints"].append(request.url))
        page.on("request", lambda request: page.heard["requests"].append(request.url))
        page.goto((built_report / "index.html").as_uri())
        page.wait_for_load_state("load")
        return page

    yield visit
    for context in contexts:
        context.close()


CUT = "slider => getComputedStyle(slider.querySelector('.over')).clipPath"


def test_page_is_quiet_and_asks_no_network(opened: Any) -> None:
    page = opened()
    assert page.heard["complaints"] == []
    assert page.heard["requests"]
    assert all(url.startswith(("file:", "data:")) for url in page.heard["requests"])


def test_every_picture_has_size(opened: Any) -> None:
    page = opened()
    sizes = page.evaluate("[...document.images].map(image => [image.getAttribute('src'), image.naturalWidth])")
    assert len(sizes) > 60
    assert [source for source, width in sizes if not width] == []


def test_every_link_resolves(opened: Any, built_report: Path) -> None:
    page = opened()
    links = page.evaluate("[...document.querySelectorAll('a')].map(link => link.getAttribute('href'))")
    anchors = set(page.evaluate("[...document.querySelectorAll('[id]')].map(element => '#' + element.id)"))
    assert len(links) > 30
    for link in links:
        assert link in anchors if link.startswith("#") else (built_report / link).is_file(), link


def test_slider_follows_pointer_and_keyboard(opened: Any) -> None:
    page = opened(viewport={"width": 1280, "height": 900})
    slider = page.locator(".view:not([hidden]) .slider").first
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    before = slider.evaluate(CUT)
    page.mouse.move(box["x"] + box["width"] * 0.5, box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.25, box["y"] + 30, steps=5)
    page.mouse.up()
    dragged = slider.evaluate(CUT)
    assert dragged != before
    assert float(slider.locator("input").input_value()) == pytest.approx(25, abs=1.5)
    handle = slider.locator(".handle").bounding_box()
    assert handle["x"] + handle["width"] / 2 == pytest.approx(box["x"] + box["width"] * 0.25, abs=2)
    page.keyboard.press("ArrowRight")
    assert slider.evaluate(CUT) != dragged
    others = page.locator(".view:not([hidden]) .slider").all()
    assert len({other.evaluate(CUT) for other in others}) == 1


def test_slider_follows_a_finger(opened: Any) -> None:
    page = opened(viewport={"width": 375, "height": 800}, has_touch=True, is_mobile=True)
    slider = page.locator(".view:not([hidden]) .slider").first
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    page.touchscreen.tap(box["x"] + box["width"] * 0.8, box["y"] + box["height"] / 2)
    assert float(slider.locator("input").input_value()) == pytest.approx(80, abs=1.5)


def test_left_side_can_be_another_method(opened: Any) -> None:
    page = opened()
    page.locator(".view:not([hidden]) select.left").select_option(label="splatting/gaussians")
    sources = page.evaluate(
        "[...document.querySelectorAll('.view:not([hidden]) .over')].map(image => image.getAttribute('src'))"
    )
    assert len(sources) == 3
    assert all("splatting-gaussians" in source for source in sources)


def test_view_selector_shows_one_view_at_a_time(opened: Any) -> None:
    page = opened()
    links = page.locator("nav.views a")
    assert links.count() >= 4
    for index in (1, 2):
        links.nth(index).click()
        shown = page.evaluate("[...document.querySelectorAll('.view:not([hidden])')].map(view => '#' + view.id)")
        assert shown == [links.nth(index).get_attribute("href")]
    page.locator(".thumbnails a").first.click()
    page.wait_for_function("location.hash && document.querySelector('.view:not([hidden])').id === location.hash.slice(1)")


def test_copy_button_copies_the_command(opened: Any) -> None:
    page = opened(permissions=["clipboard-read", "clipboard-write"])
    page.locator("button.copy").first.click()
    page.get_by_text("Copied").wait_for()
    assert page.evaluate("navigator.clipboard.readText()").startswith("invgraphics compare balls")


@pytest.mark.parametrize("width", [375, 768, 1280])
def test_no_sideways_scrolling(opened: Any, width: int) -> None:
    page = opened(viewport={"width": width, "height": 800})
    page.evaluate("document.querySelectorAll('details').forEach(details => (details.open = true))")
    assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_dark_mode_changes_page_and_plots(opened: Any) -> None:
    grounds, plots = [], []
    for scheme in ("light", "dark"):
        page = opened(color_scheme=scheme, viewport={"width": 1280, "height": 900})
        grounds.append(page.evaluate("getComputedStyle(document.body).backgroundColor"))
        plot = page.locator("#cost img").first
        plot.scroll_into_view_if_needed()
        plots.append(plot.screenshot())
    assert grounds[0] != grounds[1]
    assert plots[0] != plots[1]


def test_without_script_everything_is_there(opened: Any) -> None:
    page = opened(java_script_enabled=False)
    assert page.locator(".view").count() == page.locator(".view:visible").count() >= 4
    assert page.locator(".slider input:visible").count() == 0
    assert page.locator("table.scores:visible").count() >= 2


def test_on_paper_all_views_are_shown(opened: Any) -> None:
    page = opened()
    page.emulate_media(media="print")
    assert page.locator(".view:visible").count() == page.locator(".view").count()
    assert page.locator("button.copy:visible").count() == 0
