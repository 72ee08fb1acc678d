"""The viewer in a real browser, without a graphics card: it connects, shows every family's pictures, and obeys its controls."""

import io
import itertools
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT
from invgraphics.tools.camera_path import read_camera_path

viser = pytest.importorskip("viser")

from invgraphics.viewer.cameras import LetterboxedView  # noqa: E402
from invgraphics.viewer.launch import ViewerConfig, open_viewer  # noqa: E402
from invgraphics.viewer.server import Viewer  # noqa: E402

pytestmark = pytest.mark.browser

ARGUMENTS = [
    "--headless",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
KNOWN = (
    "THREE.Clock: This module has been deprecated",
    "THREE.BufferGeometry.computeBoundingSphere(): Computed radius is NaN",  # its splats are squares without a z
)
"""Warnings of viser's own page."""
PATIENCE = 60_000
WINDOW = {"width": 900, "height": 520}
METHODS = ("volumetric/nerf", "volumetric/hash", "splatting/gaussians")


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


class Watcher:
    """A page with a viewer, and what it complained about."""

    def __init__(self, page: Any, viewer: Viewer, shots: Path) -> None:
        self.page, self.viewer, self.shots = page, viewer, shots
        self.complaints: list[str] = []
        self.requests: set[str] = set()
        page.on("console", lambda message: self._heard(message.type, message.text))
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("request", lambda request: self.requests.add(request.url.removeprefix("blob:")))
        page.goto(f"http://127.0.0.1:{viewer.port}")
        self.rest()
        # Viser says that there is no graphics card, in front of the picture.
        page.add_style_tag(content=".mantine-Notification-root { visibility: hidden }")

    def _heard(self, kind: str, text: str) -> None:
        if kind in ("warning", "error") and not text.startswith(KNOWN):
            self.complaints.append(text)

    def rest(self) -> None:
        """Wait until the finest picture is there and the browser shows the same thing for a while."""
        text, before = "document.body.innerText", np.zeros(0)
        for _ in range(100):
            done = f"({text}.includes(' pixels') || {text}.includes('Drawn by')) && !{text}.includes('getting finer')"
            self.page.wait_for_function(done, timeout=PATIENCE)
            now = self.canvas()
            if np.array_equal(now, before):
                return
            before = now
            self.page.wait_for_timeout(500)
        raise AssertionError("the picture does not come to rest")

    def choose(self, label: str, option: str) -> None:
        box = self.page.locator(f"xpath=//*[text()='{label}']/following::input[@role='combobox'][1]")
        box.click()
        self.page.get_by_role("option", name=option, exact=True).click()
        self.page.wait_for_timeout(100)
        self.rest()

    def tick(self, label: str) -> None:
        self.page.locator(f"xpath=//*[text()='{label}']/following::input[@type='checkbox'][1]").click()
        self.page.mouse.move(250, 250)  # its hint would cover others
        self.page.wait_for_timeout(800)
        self.rest()

    def value(self, label: str) -> str:
        return self.page.locator(f"xpath=//*[text()='{label}']/following::input[@role='combobox'][1]").input_value()

    def canvas(self, name: str = "") -> np.ndarray:
        """What the browser shows of the scene, float colours 0 to 255; kept as a file if it gets a name."""
        box = self.page.locator("canvas").first.bounding_box()
        panel = self.page.locator("xpath=//*[text()='Show']").bounding_box()
        clip = box | {"width": min(box["width"], panel["x"] - box["x"] - 15)}
        shot = self.page.screenshot(clip=clip)
        if name:
            self.page.screenshot(path=self.shots / f"{name}.png")
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(float)

    def turn(self) -> None:
        """Drag the scene around."""
        self.page.mouse.move(250, 250)
        self.page.mouse.down()
        self.page.mouse.move(330, 280, steps=6)
        self.page.mouse.up()
        self.page.wait_for_timeout(800)
        self.rest()


@pytest.fixture
def watch(browser: Any, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Any]:
    opened: list[Any] = []

    def start(*runs: Path) -> Watcher:
        viewer = open_viewer(ViewerConfig(runs, port=0, max_size=96), print)
        opened.append(viewer.stop)
        context = browser.new_context(viewport=WINDOW)
        opened.append(context.close)
        return Watcher(context.new_page(), viewer, tmp_path)

    yield start
    for close in reversed(opened):
        close()


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).mean())


def _at_photograph(watcher: Watcher, picture: np.ndarray) -> float:
    """Mean difference, 0 to 255, between what the window shows of a photograph's camera and ``picture``."""
    seen = watcher.canvas()
    height, width = seen.shape[:2]
    letterbox = LetterboxedView.fit(watcher.viewer._runs[0].scene.test[0].camera, width / height)
    scale = height / letterbox.height
    left, top = round(letterbox.left * scale), round(letterbox.top * scale)
    side = round(letterbox.camera.width * scale)
    part = Image.fromarray(seen[top : top + side, left : left + side].astype(np.uint8))
    small = np.asarray(part.resize((letterbox.camera.width, letterbox.camera.height), Image.Resampling.BOX)).astype(float)
    return _apart(small[2:-2, 2:-2], picture[2:-2, 2:-2])


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_every_family_is_shown_and_every_choice_changes_the_picture(watch: Any, runs: dict[str, Path], method: str) -> None:
    run = runs[method]
    watcher = watch(run)
    family = method.split("/")[1]
    assert watcher.value("View") == "test 0: r_0"
    prediction = np.asarray(Image.open(run / "test" / "0000.png")).astype(float)
    truth = run / json.loads((run / "provenance.json").read_text())["truth"] / "0000.png"
    shown = {"prediction": watcher.canvas(f"{family}-prediction")}
    assert _at_photograph(watcher, prediction) < 4, "the very picture that was scored"
    for choice in ("truth", "error", "depth", "normal"):
        watcher.choose("Show", choice)
        shown[choice] = watcher.canvas(f"{family}-{choice}")
        if choice == "truth":
            assert _at_photograph(watcher, prediction) > 12
            assert _at_photograph(watcher, np.asarray(Image.open(truth)).astype(float)) < 8, "but for smoothed edges"
    watcher.choose("Show", "prediction")
    assert _apart(watcher.canvas(), shown["prediction"]) < 1
    for (one, picture), (other, another) in itertools.combinations(shown.items(), 2):
        assert _apart(picture, another) > 1, (one, other)
    assert watcher.complaints == []
    assert all(url.startswith(f"http://127.0.0.1:{watcher.viewer.port}") for url in watcher.requests), "nothing from elsewhere"


def test_turning_leaves_the_photograph_and_truth_comes_back_to_one(watch: Any, runs: dict[str, Path]) -> None:
    watcher = watch(runs["splatting/gaussians"])
    watcher.choose("Show", "truth")
    truth = watcher.canvas()
    watcher.turn()
    assert watcher.value("View") == "free camera"
    assert watcher.page.get_by_text("the truth is known at photographs only").count() == 1
    free = watcher.canvas("turned")
    assert _apart(free, truth) > 1
    watcher.choose("Show", "depth")
    assert _apart(watcher.canvas("turned-depth"), free) > 3
    watcher.choose("Show", "truth")
    assert watcher.value("View").startswith(("test", "train")), "truth goes to the nearest photograph"
    assert watcher.page.get_by_text("Moved to the nearest photograph, ").count() == 1
    assert _apart(watcher.canvas(), free) > 1
    assert watcher.complaints == []


def test_the_picture_can_be_saved_on_another_background(watch: Any, runs: dict[str, Path], tmp_path: Path) -> None:
    watcher = watch(runs["splatting/gaussians"])
    own = watcher.canvas()
    watcher.choose("Background", "black")
    black = watcher.canvas("black")
    assert _apart(black, own) > 5
    with watcher.page.expect_download(timeout=PATIENCE) as download:
        watcher.page.get_by_role("button", name="Save picture").click()
    download.value.save_as(tmp_path / "saved.png")
    saved = np.asarray(Image.open(tmp_path / "saved.png")).astype(float)
    assert float(saved.min()) < 5 and saved.shape == (32, 32, 3), "the photograph's camera, without bars"
    assert watcher.complaints == []


def _open_folder(watcher: Watcher, name: str) -> None:
    watcher.page.get_by_text(name, exact=True).click()
    watcher.page.wait_for_timeout(500)


def test_a_camera_path_is_recorded_played_saved_and_filmed(watch: Any, runs: dict[str, Path], tmp_path: Path) -> None:
    watcher = watch(runs["splatting/gaussians"])
    page = watcher.page
    _open_folder(watcher, "Camera path")
    page.get_by_role("button", name="Add keyframe").click()
    page.get_by_text("1 keyframe, 0.0 s").wait_for(timeout=PATIENCE)
    page.wait_for_timeout(1000)
    assert watcher.value("View") == "test 0: r_0", "adding one does not move the camera"
    watcher.turn()
    page.get_by_role("button", name="Add keyframe").click()
    page.get_by_text("2 keyframes, 2.0 s").wait_for(timeout=PATIENCE)
    page.wait_for_timeout(600)  # selections right after a change of the list count as the browser's echoes
    second = watcher.canvas("path")
    watcher.choose("Keyframe", "1 of 2")
    assert _apart(watcher.canvas(), second) > 1, "selecting a keyframe goes there"

    with page.expect_download(timeout=PATIENCE) as download:
        page.get_by_role("button", name="Save path").click()
    download.value.save_as(tmp_path / "path.json")
    path = read_camera_path(tmp_path / "path.json")
    scene = watcher.viewer._runs[0].scene
    assert len(path.keyframes) == 2
    first = path.keyframes[0].local_pose(scene)
    assert float((first - scene.test[0].camera.cam_to_world).abs().max()) < 2e-3, "it was recorded at test view 0"

    page.get_by_role("button", name="Play", exact=True).click()
    page.get_by_role("button", name="Stop", exact=True).wait_for(timeout=PATIENCE)
    page.get_by_role("button", name="Play", exact=True).wait_for(timeout=PATIENCE)
    watcher.rest()
    assert _apart(watcher.canvas("played"), second) < 2, "it ends at the second keyframe"

    with page.expect_download(timeout=2 * PATIENCE) as download:
        page.get_by_role("button", name="Export film").click()
    download.value.save_as(tmp_path / "film.mp4")
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "film.mp4"))
    assert next(reader)["size"] == (32, 32)
    film = [np.frombuffer(frame, np.uint8).reshape(32, 32, 3).astype(float) for frame in reader]
    assert len(film) == 49, "two seconds of 24, both ends included"
    prediction = np.asarray(Image.open(runs["splatting/gaussians"] / "test" / "0000.png")).astype(float)
    assert _apart(film[0], prediction) < 8 < _apart(film[-1], prediction), "from test view 0 to elsewhere"

    page.get_by_role("button", name="Delete keyframe").click()
    page.get_by_text("1 keyframe, 0.0 s").wait_for(timeout=PATIENCE)
    with page.expect_file_chooser(timeout=PATIENCE) as chooser:
        page.get_by_role("button", name="Load path").click()
    chooser.value.set_files(tmp_path / "path.json")
    page.get_by_text("Loaded path.json.").wait_for(timeout=PATIENCE)
    page.get_by_text("2 keyframes, 2.0 s").wait_for(timeout=PATIENCE)
    assert watcher.value("Keyframe") == "2 of 2"
    watcher.page.wait_for_timeout(1000)
    watcher.canvas("loaded")
    assert watcher.complaints == []


def test_another_field_of_view_frees_the_camera(watch: Any, runs: dict[str, Path]) -> None:
    watcher = watch(runs["splatting/gaussians"])
    before = watcher.canvas("photograph")
    number = watcher.page.locator("xpath=//*[text()='Field of view']/following::input[not(@type='hidden')][1]")
    assert abs(float(number.input_value()) - 50) > 1, "the photograph's, not what the slider began with"
    number.fill("90")
    number.press("Enter")
    watcher.page.wait_for_timeout(800)
    watcher.rest()
    assert watcher.value("View") == "free camera"
    assert watcher.viewer._sessions[0]._client.camera.fov == pytest.approx(np.pi / 2)
    wide = watcher.canvas("wide")
    near, far = (np.abs(one - 255).max(axis=2) > 40 for one in (before[:, 200:-200], wide[:, 200:-200]))
    assert 0 < far.sum() < 0.5 * near.sum(), "what is seen through a wider lens is smaller"
    assert watcher.complaints == []


def test_a_crop_box_hides_what_is_outside(watch: Any, runs: dict[str, Path]) -> None:
    watcher = watch(runs["volumetric/hash"])
    watcher.turn()
    whole = watcher.canvas()
    _open_folder(watcher, "Crop box")
    watcher.tick("Crop")
    assert watcher.page.get_by_text("Cropped: rays are sampled inside the box only.").count() == 1
    thumb = watcher.page.locator(
        "xpath=//*[text()='x (world units)']/following::*[contains(@class, 'thumb')][1]"
    ).bounding_box()
    x, y = thumb["x"] + thumb["width"] / 2, thumb["y"] + thumb["height"] / 2
    watcher.page.mouse.move(x, y)
    watcher.page.mouse.down()
    watcher.page.mouse.move(x + 130, y, steps=8)
    watcher.page.mouse.up()
    watcher.page.wait_for_timeout(500)
    watcher.rest()
    assert _apart(watcher.canvas("cropped"), whole) > 2
    watcher.tick("Crop")
    assert _apart(watcher.canvas(), whole) < 1
    assert watcher.complaints == []


@pytest.mark.slow
def test_cameras_and_splats_of_the_browser(watch: Any, runs: dict[str, Path]) -> None:
    watcher = watch(runs["splatting/gaussians"])
    watcher.turn()
    plain = watcher.canvas()
    watcher.tick("Splats drawn by the browser")
    splats = watcher.canvas("splats")
    assert watcher.page.get_by_text("Drawn by the browser: colours").count() == 1
    assert float(np.abs(plain - splats).mean()) < 0.5 * float(np.abs(plain - 255).mean()), "the same place, near enough"
    assert _apart(splats, plain) > 0.2, "another renderer"
    watcher.tick("Splats drawn by the browser")
    assert _apart(watcher.canvas(), plain) < 1
    watcher.page.mouse.move(250, 250)
    for _ in range(8):
        watcher.page.mouse.wheel(0, 200)
        watcher.page.wait_for_timeout(50)
    watcher.page.wait_for_timeout(800)
    watcher.rest()
    far = watcher.canvas()
    watcher.tick("Cameras")
    assert _apart(watcher.canvas("cameras"), far) > 1
    watcher.tick("Cameras")
    assert _apart(watcher.canvas(), far) < 0.5
    assert watcher.complaints == []


def test_two_runs(watch: Any, runs: dict[str, Path]) -> None:
    watcher = watch(runs["volumetric/hash"], runs["splatting/gaussians"])
    shown = {"split": watcher.canvas("split")}
    for layout in ("side by side", "first", "second"):
        watcher.choose("Runs", layout)
        shown[layout] = watcher.canvas(layout.replace(" ", "-"))
    middle = shown["split"].shape[1] // 2
    assert _apart(shown["split"][:, : middle - 12], shown["first"][:, : middle - 12]) < 1.5
    assert _apart(shown["split"][:, middle + 12 :], shown["second"][:, middle + 12 :]) < 1.5
    assert _apart(shown["first"], shown["second"]) > 0.5
    assert _apart(shown["side by side"], shown["first"]) > 3
    assert watcher.complaints == []


def test_a_fit_is_followed(watch: Any, runs: dict[str, Path], tmp_path: Path) -> None:
    run = Path(shutil.copytree(runs["splatting/gaussians"], tmp_path / "run"))
    watcher = watch(run)
    before = watcher.canvas()
    state = checkpoint.load(run / CHECKPOINT)
    state["field"]["means"][:, 2] += 0.4
    checkpoint.save(run / CHECKPOINT, state)
    (run / "fit.json").write_text('{"steps": 12345, "seconds": 6.0}')
    watcher.viewer.reload_if_changed()
    watcher.page.get_by_text("step 12,345").wait_for(timeout=PATIENCE)
    watcher.page.wait_for_timeout(500)
    watcher.rest()
    followed = watcher.canvas("followed")
    assert _apart(followed, before) > 2
    (run / CHECKPOINT).write_bytes(b"broken")
    watcher.viewer.reload_if_changed()
    watcher.page.get_by_text("is not a readable checkpoint").wait_for(state="attached", timeout=PATIENCE)
    assert _apart(watcher.canvas()[120:], followed[120:]) < 1, "what was there is still shown"
    assert watcher.complaints == []
