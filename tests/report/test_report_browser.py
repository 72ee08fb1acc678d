"""The page in a real browser, opened from disk."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

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
    """Opens a report (of the comparison, if nothing is said); complaints and requests are kept in ``page.heard``."""
    contexts = []

    def visit(folder: Path = built_report, **options: Any) -> Any:
        context = browser.new_context(**options)
        contexts.append(context)
        page = context.new_page()
        page.heard = {"complaints": [], "requests": []}
        page.on("console", lambda message: page.heard["complaints"].append(message.text) if message.type != "log" else None)
        page.on("pageerror", lambda error: page.heard["complaints"].append(str(error)))
        page.on("requestfailed", lambda request: page.heard["complaints"].append(request.url))
        page.on("request", lambda request: page.heard["requests"].append(request.url))
        page.goto((folder / "index.html").as_uri())
        page.wait_for_load_state("load")
        return page

    yield visit
    for context in contexts:
        context.close()


CUT = "slider => getComputedStyle(slider.querySelector('.over')).clipPath"


@pytest.fixture(params=["built_report", "built_study"])
def either(request: pytest.FixtureRequest) -> Path:
    """The folder of a reported comparison, then of a reported study."""
    return Path(request.getfixturevalue(request.param))


def test_page_is_quiet_and_asks_no_network(opened: Any, either: Path) -> None:
    page = opened(either)
    assert page.heard["complaints"] == []
    assert page.heard["requests"]
    assert all(url.startswith(("file:", "data:")) for url in page.heard["requests"])


LOADED = """async () => {
  for (const image of document.images) image.loading = 'eager';
  await Promise.allSettled([...document.images].map(image => image.decode()));
  return [...document.images].map(image => [image.getAttribute('src'), image.naturalWidth]);
}"""


def test_every_picture_has_size(opened: Any, either: Path) -> None:
    page = opened(either)
    sizes = page.evaluate(LOADED)
    assert len(sizes) > 60
    assert [source for source, width in sizes if not width] == []


def test_pictures_load_when_they_are_looked_at(opened: Any, either: Path) -> None:
    page = opened(either, viewport={"width": 1280, "height": 900})
    views = page.locator(".gallery").first.locator(".view")
    assert views.count() > 1
    hidden = views.nth(1)
    widths = "view => [...view.querySelectorAll('img')].map(image => image.naturalWidth)"
    assert set(hidden.evaluate(widths)) == {0}
    page.locator(f"nav.views a[href='#{hidden.get_attribute('id')}']").first.click()
    hidden.locator("img").first.scroll_into_view_if_needed()
    page.wait_for_function("image => image.naturalWidth > 0", arg=hidden.locator("img").first.element_handle(), timeout=60_000)


def test_printing_loads_all_pictures(opened: Any, built_report: Path) -> None:
    page = opened(built_report)
    views = page.locator(".view img")
    sources = {views.nth(k).get_attribute("src") for k in range(views.count())}
    # A browser without a screen prints what has arrived; one that somebody prints from waits.
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    page.wait_for_function("[...document.images].every(image => image.naturalWidth > 0)", timeout=60_000)
    # Skia writes a picture that is used several times once, and its objects' dictionaries are not compressed.
    assert len(re.findall(rb"/Subtype /Image", page.pdf())) >= len(sources)


def test_every_link_resolves(opened: Any, either: Path) -> None:
    page = opened(either)
    links = page.evaluate("[...document.querySelectorAll('a')].map(link => link.getAttribute('href'))")
    anchors = set(page.evaluate("[...document.querySelectorAll('[id]')].map(element => '#' + element.id)"))
    assert len(links) > 30
    for link in links:
        assert link in anchors if link.startswith("#") else (either / link).is_file(), link


def test_slider_follows_pointer_and_keyboard(opened: Any, either: Path) -> None:
    page = opened(either, viewport={"width": 1280, "height": 900})
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
    others = page.locator(".view:not([hidden])").first.locator(".slider").all()
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


def test_a_fragment_that_is_no_address_breaks_nothing(opened: Any, built_study: Path) -> None:
    page = opened(built_study)
    buttons = page.locator("button.sort").count()
    assert buttons > 0
    page.goto((built_study / "index.html").as_uri() + "#100%")
    page.reload()
    assert page.locator("button.sort").count() == buttons
    assert page.heard["complaints"] == []


def test_what_paper_opens_is_folded_again(opened: Any, built_study: Path) -> None:
    page = opened(built_study)
    states = "[...document.querySelectorAll('details')].map(one => one.open)"
    before = page.evaluate(states)
    assert not all(before)
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert all(page.evaluate(states))
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert page.evaluate(states) == before


def test_copy_button_copies_the_command(opened: Any) -> None:
    page = opened(permissions=["clipboard-read", "clipboard-write"])
    page.locator("button.copy").first.click()
    page.get_by_text("Copied").wait_for()
    assert page.evaluate("navigator.clipboard.readText()").startswith("invgraphics compare balls")


def test_no_sideways_scrolling(opened: Any, either: Path) -> None:
    page = opened(either)
    page.evaluate("document.querySelectorAll('details').forEach(details => (details.open = true))")
    for width in (360, 768, 1280):
        page.set_viewport_size({"width": width, "height": 800})
        assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_a_long_name_of_a_variant_does_not_widen_a_phone_s_page(opened: Any) -> None:
    page = opened(viewport={"width": 390, "height": 800})
    page.evaluate("document.querySelectorAll('details').forEach(details => (details.open = true))")
    name = "gaussian-volume/exact, count 625, max_init 625, opacity extinction, no self attenuation"
    page.evaluate("name => document.querySelectorAll('select.left option').forEach(option => (option.text = name))", name)
    assert page.locator("select.left").count() > 0
    assert page.evaluate("document.documentElement.scrollWidth") <= 390


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


SEEN = """frame => {
  // What part of the picture a frame shows: left, top, right and bottom in shares of the picture.
  const box = frame.getBoundingClientRect();
  const image = frame.querySelector('img').getBoundingClientRect();
  const x = value => (value - image.left) / image.width;
  const y = value => (value - image.top) / image.height;
  return [x(box.left), y(box.top), x(box.right), y(box.bottom)];
}"""


def seen(page: Any) -> list[list[float]]:
    """What every frame of the first open view shows."""
    view = page.locator(".view:not([hidden])").first
    return [frame.evaluate(SEEN) for frame in view.locator(".lens, .slider").all()]


def test_buttons_zoom_all_pictures_of_a_view_about_their_middle(opened: Any, either: Path) -> None:
    page = opened(either, viewport={"width": 1280, "height": 900})
    view = page.locator(".view:not([hidden])").first
    view.get_by_label("Zoom in").click()
    view.get_by_label("Zoom in").click()
    assert view.locator(".zoom output").inner_text() == "4×"
    frames = seen(page)
    assert len(frames) > 8
    for frame in frames:
        assert frame == pytest.approx([0.375, 0.375, 0.625, 0.625], abs=0.01)
    other = page.locator("nav.views a").nth(1)
    other.click()
    assert seen(page)[0] == pytest.approx([0, 0, 1, 1], abs=0.01)  # another view has its own zoom
    page.locator("nav.views a").nth(0).click()
    for _ in range(2):
        view.get_by_label("Zoom out").click()
    assert seen(page)[3] == pytest.approx([0, 0, 1, 1], abs=0.01)


def test_wheel_with_ctrl_zooms_at_the_pointer_and_without_it_scrolls(opened: Any) -> None:
    page = opened(viewport={"width": 1280, "height": 900})
    frame = page.locator(".view:not([hidden]) .lens").first
    frame.scroll_into_view_if_needed()
    box = frame.bounding_box()
    page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 0.5 * box["height"])
    page.keyboard.down("Control")
    for _ in range(3):
        page.mouse.wheel(0, -40)
    page.keyboard.up("Control")
    page.wait_for_function("parseFloat(document.querySelector('.view.zoomed output').textContent) >= 3")
    left, top, right, bottom = seen(page)[0]
    assert left + 0.25 * (right - left) == pytest.approx(0.25, abs=0.01)
    assert top + 0.5 * (bottom - top) == pytest.approx(0.5, abs=0.01)
    assert len({tuple(round(value, 2) for value in part) for part in seen(page)}) == 1
    before = page.evaluate("scrollY")
    page.mouse.wheel(0, 200)
    page.wait_for_function(f"scrollY > {before}")


def test_drag_moves_zoomed_pictures_and_double_click_returns(opened: Any) -> None:
    page = opened(viewport={"width": 1280, "height": 900})
    frame = page.locator(".view:not([hidden]) .lens").first
    frame.scroll_into_view_if_needed()
    box = frame.bounding_box()
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.dblclick(*middle)
    assert seen(page)[0] == pytest.approx([0.375, 0.375, 0.625, 0.625], abs=0.01)
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] - 0.4 * box["width"], middle[1] + 0.2 * box["height"], steps=4)
    page.mouse.up()
    for part in seen(page):
        assert part == pytest.approx([0.475, 0.325, 0.725, 0.575], abs=0.02)
    page.mouse.dblclick(*middle)
    assert seen(page)[2] == pytest.approx([0, 0, 1, 1], abs=0.01)


def test_line_of_a_zoomed_slider_stays_under_the_pointer(opened: Any) -> None:
    page = opened(viewport={"width": 1280, "height": 900})
    view = page.locator(".view:not([hidden])").first
    view.get_by_label("Zoom in").click()
    slider = view.locator(".slider").first
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    page.mouse.move(box["x"] + box["width"] * 0.5, box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.2, box["y"] + 20, steps=3)
    page.mouse.up()
    # Twice as large about the middle, the frame's 20% is the picture's 35%; the truth is cut 65% from its right.
    cut = slider.evaluate("s => getComputedStyle(s.querySelector('.over')).clipPath")
    assert float(re.findall(r"[\d.]+(?=%)", cut)[-1]) == pytest.approx(65, abs=1.5)
    handle = slider.locator(".handle").bounding_box()
    assert handle["x"] + handle["width"] / 2 == pytest.approx(box["x"] + 0.2 * box["width"], abs=2)


def test_two_fingers_zoom(opened: Any) -> None:
    page = opened(viewport={"width": 390, "height": 800}, has_touch=True, is_mobile=True)
    frame = page.locator(".view:not([hidden]) .slider").first
    frame.scroll_into_view_if_needed()
    box = frame.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    session = page.context.new_cdp_session(page)

    def touch(kind: str, *offsets: float) -> None:
        points = [{"x": x + offset, "y": y, "id": index} for index, offset in enumerate(offsets)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", -20, 20)
    for spread in (30, 40, 50, 60):
        touch("touchMove", -spread, spread)
    touch("touchEnd")
    page.wait_for_function("document.querySelector('.view.zoomed')")
    assert float(page.locator(".view.zoomed output").inner_text().removesuffix("×")) == pytest.approx(3, abs=0.3)
    assert page.evaluate("visualViewport.scale") == 1


def test_folded_scene_opens_when_it_is_asked_for(opened: Any, built_study: Path) -> None:
    page = opened(built_study)
    assert page.locator("#moons-scene .view:visible").count() == 0
    page.locator("nav a[href='#moons-scene']").click()
    page.wait_for_function("document.querySelector('#moons-scene > details').open")
    assert page.locator("#moons-scene .view:visible").count() == 1
    assert page.locator("#balls-scene .view:visible").count() == 1
    failed = page.locator(".matrix td.failed a")
    failed.click()
    page.wait_for_function("location.hash.startsWith('#failure-')")
    assert "not finite" in page.locator(failed.get_attribute("href")).inner_text()


def test_table_across_scenes_sorts_by_any_scene(opened: Any, built_study: Path) -> None:
    page = opened(built_study)
    values = "head => [...head.closest('table').tBodies[0].rows].map(row => row.cells[head.cellIndex].dataset.value ?? null)"
    for order in (True, False):
        head = page.locator("#across th[data-better]").first
        head.locator("button").click()
        shown = head.evaluate(values)
        known = [float(value) for value in shown if value is not None]
        assert known == sorted(known, reverse=order) and shown[: len(known)].count(None) == 0
        assert head.get_attribute("aria-sort") == ("descending" if order else "ascending")
        assert page.locator("#across th[aria-sort]").count() == 1


def test_shade_marks_a_table_with_more_to_the_right(opened: Any, built_study: Path) -> None:
    page = opened(built_study, viewport={"width": 375, "height": 800})
    region = page.locator("#cells .scroll")
    edge = Image.open(BytesIO(region.screenshot())).convert("L")
    region.evaluate("region => region.scrollTo(region.scrollWidth, 0)")
    end = Image.open(BytesIO(region.screenshot())).convert("L")
    rightmost = (edge.width - 1, 0, edge.width, edge.height)
    assert np.median(edge.crop(rightmost)) < 220 < np.median(end.crop(rightmost))
