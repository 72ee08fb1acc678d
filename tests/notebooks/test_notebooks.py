"""Every notebook runs at a small size, and what it prints in numbers holds."""

import importlib.util
import itertools
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

FOLDER = Path(__file__).parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
TAGS = {"parameters", "setup", "widget", "solution"}

SMALL = {
    "01-cameras-and-rays": "size = 48",
    "02-volume-rendering-integral": "size, counts = 32, [4, 8, 16, 32, 64, 128]",
    "03-fit-a-nerf": "views, size, steps, curve_steps = 16, 24, 150, 200",
    "04-grids-and-hashing": (
        "views, size, steps, samples, march = 8, 16, 80, 2048, 48\n"
        "grid_steps, points, tables, edge, factor_steps, edge_steps = 60, 2048, [8, 12, 16], 16, 150, 150"
    ),
    "05-surfaces": "size, pixels, march, views, steps = 48, 41, 256, 8, 60",
    "06-aliasing-and-open-space": "draws, steps = 100_000, 120",
    "07-gaussians-and-ewa": "draws = 100_000",
    "08-fit-gaussians": "views, size, steps, flat_steps, starts = 12, 32, 200, 150, 3",
    "09-the-same-gaussians-two-ways": "size, turns = 72, 21",
    "10-from-photos-to-a-scene": "size, steps, levels = 64, 800, [0.0, 3.0]",
    "11-design-an-ablation": "size, views, steps, seeds, studies = 24, 8, 40, [0, 1], 100",
    "12-many-scenes-one-table": (
        "size, spp, test_views, steps, refit, front_steps = 32, 8, 8, 350, 40, 100\n"
        "points, gaussians, voxels, planes, trial_size, trial_voxels = 4000, 1200, 32, 16, 64, 32"
    ),
    "13-learning-to-render": "size, views, steps, attention_steps = 20, 12, 250, 20",
    "14-priors": "instances, seen_views, size, steps, alone_steps, infer_steps = 8, 6, 16, 300, 100, 60",
}


def _cells(path: Path) -> list[dict]:
    return json.loads(path.read_text())["cells"]


def _tagged(path: Path, tag: str) -> list[dict]:
    return [cell for cell in _cells(path) if tag in cell["metadata"].get("tags", [])]


def test_every_notebook_has_a_test_and_a_line_in_the_readme() -> None:
    assert [path.stem for path in NOTEBOOKS] == sorted(SMALL)
    linked = re.findall(r"\]\((\S+\.ipynb)\)", (FOLDER / "README.md").read_text())
    assert linked == [path.name for path in NOTEBOOKS]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_committed_without_outputs_and_with_known_tags(path: Path) -> None:
    cells = _cells(path)
    assert len({cell["id"] for cell in cells}) == len(cells)
    for cell in cells:
        assert not cell.get("outputs") and cell.get("execution_count") is None, f"cell {cell['id']} keeps its output"
        assert set(cell["metadata"]) <= {"tags", "jupyter"} and set(cell["metadata"].get("tags", [])) <= TAGS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_ends_with_an_exercise_whose_solution_is_hidden(path: Path) -> None:
    *_, exercise, solution = _cells(path)
    assert "## Exercise" in "".join(exercise["source"])
    assert solution["metadata"]["tags"] == ["solution"] and solution["metadata"]["jupyter"]["source_hidden"]
    assert len(_tagged(path, "parameters")) == 1 and _tagged(path, "widget")


@pytest.fixture(scope="module")
def render() -> ModuleType:
    for package in ("nbclient", "nbconvert", "ipykernel", "ipywidgets", "latex2mathml"):
        pytest.importorskip(package, reason="needs the extra 'notebooks'")
    spec = importlib.util.spec_from_file_location("render", FOLDER / "render.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class _Printed(str):
    """What a notebook printed."""

    __slots__ = ()

    def numbers(self, *fragments: str) -> tuple[float, ...]:
        """The number after each fragment, in order, all on one line."""
        gaps = "".join(f"{re.escape(fragment)}\\s*([-+]?[0-9.]+(?:e[-+]?[0-9]+)?).*?" for fragment in fragments)
        found = re.search(gaps, self)
        assert found, f"not printed: {fragments}\n{self}"
        return tuple(float(group.rstrip(".")) for group in found.groups())


def _cameras(out: _Printed) -> None:
    assert out.numbers("round trip pixel -> ray -> point -> pixel: at most") < (1e-3,)
    right, wrong = out.numbers("PSNR of the true field:", "right camera,")
    assert right > wrong + 5
    began, ended = out.numbers("pose from points: error", "at the start,")
    assert began > 1 and ended < 1e-2
    assert out.numbers("pose from points: the camera is") < (1e-3,)
    focal, shift = out.numbers("whole balls: focal length x", "distance")
    assert focal == pytest.approx(1, abs=0.01) and shift == pytest.approx(0, abs=0.03)
    slab, magnification = out.numbers("thin slab: focal length x", "f/Z x")
    assert abs(slab - 1) > 0.02 and magnification == pytest.approx(1, abs=1e-3)


def _integral(out: _Printed) -> None:
    assert out.numbers("composite: weights and the equation differ by at most") < (1e-12,)
    exact, one = out.numbers("slab: closed form", "one sample")
    assert one == exact
    assert out.numbers("a jump in density: error ~ N^")[0] == pytest.approx(-1, abs=0.25)
    assert out.numbers("cut by the far plane: error ~ N^")[0] == pytest.approx(-2, abs=0.1)
    equal, fine = (out.numbers(f"picture with {name}: error")[0] for name in ("8 equal strata", "4 coarse + 4 fine"))
    assert fine < equal
    for alpha, place in (("0.48", 3), ("0.52", 1)):  # less than half of the light stops in the pane at 1, or more
        mean, median = out.numbers(f"pane of alpha {alpha}: mean depth", "median")
        assert mean == pytest.approx(3 - 2 * float(alpha), abs=0.02) and median == pytest.approx(place, abs=0.06)


def _nerf(out: _Printed) -> None:
    none, some = (out.numbers(f"curve with {octaves} octaves: error")[0] for octaves in (0, 4))
    assert some < none / 2
    coordinates, encoded, hashed = (
        out.numbers(f"{name}: PSNR")[0] for name in ("coordinates", "positional encoding", "hash grid")
    )
    assert min(encoded, hashed) > coordinates + 0.5
    total, moved, share = out.numbers("hash grid:", "of one point moves", "(")
    assert moved < total and share < 5
    assert out.numbers("positional encoding:", "of one point moves", "(")[2] > 15
    small, large = (out.numbers(f"T = 2^{log2_size}:", "PSNR")[1] for log2_size in (7, 15))
    assert large > small


def _grids(out: _Printed) -> None:
    assert out.numbers("trilinear: lattice_encode and the equation differ by") < (1e-12,)
    assert out.numbers("one point moves", "of", "with weights that sum to") == (8, 125, 1)
    lost, kept = (out.numbers(f"from 5 to {count} vertices along an edge: the function changes by at most") for count in "89")
    assert kept < (1e-12,) < (0.1,) < lost
    surface, everything = out.numbers("surface:", "of")
    for name, count in (("all", everything), ("surface", surface)):
        random = 100 * (1 - math.exp(-count / 2**16))  # of the entries used, and of the vertices that collide
        assert out.numbers(f"T = 2^16, {name} vertices:", "% of the entries used,") == pytest.approx((random, random), abs=5)
    _collisions(out)
    _ranks(out)
    _edges(out)


def _collisions(out: _Printed) -> None:
    """What collisions cost, on the surface and in the volume, and which vertices have the gradients."""
    for model in ("one level, no network", "four levels and a network"):
        small, middle, large = out.numbers(f"{model}, surface: PSNR in dB, T = 2^8", "T = 2^12", "T = 2^16")
        assert small + 1 < middle < large
        assert large > out.numbers(f"{model}, volume: PSNR in dB, T = 2^8", "T = 2^16")[1] + 2
    small, large, dense = (out.numbers(f"scene, {name}:", "PSNR")[1] for name in ("T = 2^8", "T = 2^15", "dense"))
    assert small + 3 < large
    assert large == pytest.approx(dense, abs=1.5)
    before, vertices = out.numbers("gradients before the fit:", "% at the")
    assert out.numbers("gradients at its end:")[0] > 1.5 * before > 1.5 * vertices


def _ranks(out: _Printed) -> None:
    """Both factorisations are exact; a box along the axes is of rank 1, one that is turned about z is so for VM alone."""
    error = {}
    for kind in ("CP", "VM"):
        assert out.numbers(f"{kind}: products of interpolated factors and the interpolated tensor differ by") < (1e-8,)
        assert out.numbers(f"box, {kind}: error") < (2,)
        error[kind] = out.numbers(f"turned about z, {kind}: error", "rank 1,", "rank 4,")
    assert error["VM"][0] < 2
    assert error["CP"][0] > 2 * error["CP"][1] > 4 * error["CP"][2]
    assert out.numbers("values of 4 bytes") == (4 * 16**3,)
    assert out.numbers("memory, CP:", "rank 1,") == (4 * 3 * 16, 4 * 3 * 16 * 4)
    assert out.numbers("memory, VM:") == (4 * 3 * (16**2 + 16),)


def _cones(out: _Printed) -> None:
    """The cone's Gaussian and its encoding, against Monte Carlo; proposals that learn; splats with and without a filter."""
    mean, drawn, middle = out.numbers("cone: mean at", "Monte Carlo", "middle of the interval")
    assert mean == pytest.approx(drawn, abs=0.01) and mean > middle + 0.3
    assert out.numbers("cone: covariance and Monte Carlo differ by") < (1,)
    assert out.numbers("encoding: closed form and Monte Carlo differ by at most") < (1e-2,)
    assert out.numbers("encoding: without the Gaussian, at its mean, by") > (0.5,)
    centre, damped = (out.numbers(f"stripes, {name}: RMS error")[0] for name in ("at the centre", "damped"))
    assert damped < centre / 4
    for where in ("inside", "outside"):
        assert out.numbers(f"contraction, {where} the unit ball: encoding and Monte Carlo differ by at most") < (1.5e-2,)
    first, last = out.numbers("interlevel loss", "at the start,")
    assert last < first / 20
    before, after = out.numbers("at the end\nproposals:", "% of the samples inside a ball at the start,")
    assert after > 1.5 * before
    words = "on average, flicker along a row"
    flicker = [out.numbers(f"{name}: light x", words) for name in ("no filter", "(3DGS)", "antialiased")]
    assert flicker[0][0] == pytest.approx(1, abs=0.05)
    assert flicker[0][1] > 40 and flicker[1][1] < 5 and flicker[2][1] < 20
    assert flicker[1][0] > 3 and flicker[2][0] == pytest.approx(1, abs=0.1)
    near, far, half = (out.numbers(f"octaves, {name}:")[0] for name in ("near", "twice as far", "half the size"))
    assert far == half == near - 1


def _edges(out: _Printed) -> None:
    """Edges of one voxel, and of a shape in the plane, interpolated before, between and after activation and opacity."""
    line = "voxel of v = -400 and 100: pre half at", "and", "in half at", "and", "post half at", "and"
    pre, pre_width, between, between_width, post, post_width = out.numbers(*line)
    assert (pre, pre_width) == (0.5, 0.8)
    # 1 - exp(-100 x / 2) is one half at ln 2 / 50, and rises from 0.1 to 0.9 within ln 9 / 50.
    assert (between, between_width) == pytest.approx((math.log(2) / 50, math.log(9) / 50), abs=2e-3)
    assert post == pytest.approx(400 / 500, abs=5e-3)
    assert post_width < 0.02
    edges = [out.numbers(f"edge, {order}:", "voxels wide, RMS error") for order in ("post", "in", "pre")]
    assert all(list(column) == sorted(column) for column in zip(*edges, strict=True))
    assert edges[0][0] < edges[1][0] / 2


def _surfaces(out: _Printed) -> None:
    """Which combinations are distances, what steps cost, which derivatives are right, where weights are largest, depths."""
    for name in ("ball", "box", "union", "ball cut out", "rounded by 0.1"):
        assert out.numbers(f"{name}: the gradient's length is between", "and") == (1, 1)
    assert out.numbers("welded: the gradient's length is between", "and")[0] < 0.9
    assert out.numbers("squashed ball: the gradient's length is between", "and")[1] == pytest.approx(2, abs=0.01)
    assert out.numbers("ray, square:") < out.numbers("ray, past both:") < out.numbers("ray, grazing:")
    steep, grazing = (out.numbers(f"unrolled at {angle}°: after 16 steps off by")[0] for angle in (12, 74))
    assert steep < 1e-6
    assert grazing > 1
    assert out.numbers("unrolled bisection: the derivative is")[0] == 0
    assert out.numbers("implicit: differs from the closed form by")[0] < 1e-9
    for angle in (0, 60, 80):
        line = f"plane at {angle}°, width 0.02: the weight is largest at naive", ", VolSDF", ", NeuS"
        naive, volsdf, neus = out.numbers(*line)
        assert naive < -0.005 and abs(neus) < 1e-3
        assert volsdf == pytest.approx(0.02 * _early(angle), abs=2e-4)
    wide, narrow = out.numbers("ball, NeuS: off by", "by")
    assert wide > 20 * narrow
    turned = [out.numbers(f"ripples of 0.001, {waves} radians per length: normals turn by")[0] for waves in (20, 60, 180)]
    assert turned == sorted(turned) and turned[2] > 3
    wide, narrow = (out.numbers(f"one distance, VolSDF, β = {beta}: median depth")[0] for beta in (0.02, 0.003))
    assert narrow < wide
    half, formula = out.numbers("half of the light at 70°:", "by the formula")
    assert half == pytest.approx(formula, abs=1e-4)


def _early(angle: float) -> float:
    """Where VolSDF's weight on a plane is largest, in widths along the ray: the density's slope cos/β σ equals its square."""
    cosine = math.cos(math.radians(angle))
    # Before the plane σ = exp(-f/β) / (2 β); behind it σ = (1 - exp(f/β) / 2) / β, and (1 - u)² = u cos with u = exp(f/β) / 2.
    if cosine <= 0.5:
        return math.log(2 * cosine) / cosine
    u = 1 + cosine / 2 - math.sqrt(cosine + cosine**2 / 4)
    return -math.log(2 * u) / cosine


def _ewa(out: _Printed) -> None:
    assert out.numbers("(2 pi)^(-3/2) |V|^(-1/2) =") == (1.0,)
    for claim in ("M V M^T by", "the block of V by", "W V W^T by"):
        assert out.numbers(claim)[0] < 1.5, "percent; the noise to expect is 0.45"
    for claim in ("automatic differentiation differ by", "footprint differs from J V J^T by", "depth plane differ by"):
        assert out.numbers(claim)[0] < 1e-9
    assert out.numbers("grows with the power")[0] == pytest.approx(2, abs=0.05)
    assert out.numbers("within 3.37 sigma:")[0] == pytest.approx(99, abs=0.15)
    lost, limit = out.numbers("the largest alpha lost in the image:", "1/255 =")
    assert lost < limit
    line, predicted = out.numbers("central ray: integral", "|V_hat|^(1/2)) =")
    assert line == pytest.approx(predicted, rel=1e-4)
    assert out.numbers("exact line integral: at most")[0] < 0.03
    assert out.numbers("differs from V_hat + 0.3 I by")[0] < 1e-9
    # Integrals of max(0, x) times Legendre polynomials over [0, 1] are 1/2, 1/3, 1/8 and 0 (Ramamoorthi and Hanrahan 2001).
    held = [
        0.0,
        *itertools.accumulate((2 * band + 1) * integral**2 / 4 for band, integral in ((1, 1 / 3), (2, 1 / 8), (3, 0.0))),
    ]
    broad = out.numbers("highlight of exponent 1: degree 0 leaves", ", 1", ", 2", ", 3")
    assert broad == pytest.approx([math.sqrt(1 - part / (1 / 6 - 1 / 4**2)) for part in held], abs=0.01)
    assert out.numbers("highlight of exponent 100: degree 0 leaves", ", 1", ", 2", ", 3")[3] > 0.8


def _splatting(out: _Printed) -> None:
    points, random = (out.numbers(f"{name}: PSNR")[0] for name in ("surface points", "random"))
    assert points > random + 0.5
    narrow, wide = (out.numbers(f"sigma {sigma}: the target is felt within")[0] for sigma in ("0.08", "0.4"))
    assert narrow < wide < 1.9
    near, far = (out.numbers(f"start {name}: missed")[0] for name in ("near the truth", "random"))
    assert near == 0
    assert far > 0
    final = [out.numbers(f"final, {name}: PSNR", "with") for name in ("random", "random, grown")]
    assert final[0][1] == 400
    assert final[1][1] != 400
    kept, cloned, split, _, after = _first_round(out)
    assert after == kept + 2 * cloned + 2 * split
    assert out.numbers("time-lapse:") == (31,)


def _first_round(out: _Printed) -> tuple[int, ...]:
    """Numbers of the first round of density control."""
    found = re.search(r"round at step \d+: (\d+) kept, (\d+) cloned, (\d+) split, (\d+) pruned, (\d+) afterwards", out)
    assert found
    return tuple(map(int, found.groups()))


def _two_ways(out: _Printed) -> None:
    for ray in "AB":
        splatted, integrated = out.numbers(f"ray {ray}: left at the end", "splatted,")
        assert splatted == pytest.approx(integrated, abs=2e-4)
    for opacity, gap in (("0.1", 0.0013), ("0.5", 0.043), ("0.9", 0.24)):
        rendered, formula = out.numbers(f"opacity a = {opacity}: gap", "rendered,")
        assert rendered == pytest.approx(formula, abs=2e-4)
        assert formula == pytest.approx(gap, rel=0.04)
    on_axis, off_axis = (
        out.numbers(f"projection, {angle}° off axis: error of alpha", "grows with power")[1] for angle in (0, 45)
    )
    assert on_axis == pytest.approx(2, abs=0.15)
    assert off_axis == pytest.approx(1, abs=0.15)
    centre, ray, exact = (
        out.numbers(f"order, {name}: red changes by at most")[0]
        for name in ("sorted by centre", "sorted along each ray", "integrated")
    )
    assert centre > 0.1
    assert max(ray, exact) < 0.02
    assert out.numbers("overlap, one after the other: weights", "and") == pytest.approx((0.6, 0.24), abs=1e-3)
    assert out.numbers("overlap, integrated: weights", "and") == pytest.approx((0.42, 0.42), abs=1e-3)
    for name in ("projection", "order", "opacity", "overlap"):
        assert _step(out, name) < out.numbers("splat against integral: RMS difference")[0] * 1.5
    assert out.numbers("optical depth from the end over that from the side:") == pytest.approx((5,), abs=0.01)


def _step(out: _Printed, name: str) -> float:
    """RMS change of the picture when one approximation is undone."""
    found = re.search(rf"step, {name}[^\n]*RMS ([\d.]+)", out)
    assert found
    return float(found[1])


def _photos(out: _Printed) -> None:
    placed, taken = out.numbers("SfM: placed", "of")
    assert placed > 0.9 * taken
    assert out.numbers("SfM: mean reprojection error")[0] < 1
    assert out.numbers("epipolar lines:", "median distance")[1] < 1
    turn, shift = out.numbers("SfM: median rotation error", "position")
    assert turn < 0.5
    assert shift < 0.5
    exact, found, wrong = (out.numbers(f"poses {name}: PSNR")[0] for name in ("0° / 0 %", "SfM", "3° / 3 %"))
    assert found > exact - 2.5
    assert wrong < found - 3
    began, ended = out.numbers("refinement: median rotation error", "at the start,")
    assert ended < began / 2
    given, refined = (out.numbers(f"{name} poses: PSNR")[0] for name in ("given", "refined"))
    assert refined > given + 1
    assert out.numbers("located: off by")[0] < 1, "per cent of the extent"


def _ablation(out: _Printed) -> None:
    assert out.numbers("failed fits:") == (0,)
    assert out.numbers("design:", "combinations x", "seeds =") == (4, 2, 8)
    for factor in ("data.train_views 8 instead of 4", "field.sh_degree 2 instead of 0"):
        mean, low, high = out.numbers(f"{factor}:", "dB [", ",")
        plain, half = out.numbers("the equation:", "+-") if "views" in factor else (mean, (high - low) / 2)
        assert (plain, half) == pytest.approx((mean, (high - low) / 2), abs=0.02)
    naive, nested = out.numbers("null studies:", "views as independent,")
    assert naive > 20 and nested <= 12, "percent of 100 studies; 5 is right"
    assert out.numbers("factorial:") == (36,) and out.numbers("one-at-a-time:") == (24,)


def _tables(out: _Printed) -> None:
    """What each representation loses, and the law by which it does: slip of planes, holes between points, rims of voxels."""
    sizes = {name: out.numbers(f"\n{name} ")[0] for name in ("field", "planes", "lattice", "Gaussians")}
    assert min(sizes.values()) > out.numbers("\npoints ")[0]
    before, after = out.numbers("gaussians:", "dB as converted,")
    assert after > before + 1
    slips = [out.numbers(f"\n{count} planes at 40°: planes slip by", "px,") for count in (4, 16, 64)]
    for (coarse, _), (fine, _), planes in zip(slips, slips[1:], (4, 16), strict=False):
        assert coarse / fine == pytest.approx((4 * planes - 1) / (planes - 1), rel=0.02)
    assert slips[1][1] > slips[0][1] + 1
    holes = [out.numbers(f"points at {zoom} times the size: holes in", "predicted")[0] / 100 for zoom in (2, 4, 8)]
    assert holes == sorted(holes) and holes[-1] > 0.8
    for name, grows in (("lattice", True), ("mesh", False)):
        first, last = out.numbers(f"rim of the {name}:", "px at x4,")
        assert (last > 2.5 * first) is grows
    line = "of the rods is left", *[","] * 4, "fog's alpha"
    exact, mesh, planes = (out.numbers(f"\n{name}: {line[0]}", *line[1:]) for name in ("exact", "mesh", "planes"))
    assert exact[:5] == (1,) * 5
    assert mesh[0] > 0.8 and mesh[4] < 0.3
    assert mesh[5] < 0.05 and planes[5] == pytest.approx(exact[5], abs=0.1)
    assert out.numbers("mesh, low level: of the rods is left", "fog's alpha")[1] > 0.95
    near, far = out.numbers("one-sided:", "photograph,")
    assert near > far + 3


def _learnt(out: _Printed) -> None:
    learnt, traced = out.numbers("all rays: after 10 steps the LSTM is off by", "sphere tracing by")
    assert traced < 0.01 and learnt < 0.3
    assert out.numbers("ten steps more: the march drifts by")[0] > 0
    out.numbers("attention: its mean distance is")


def _priors(out: _Printed) -> None:
    itself, elsewhere = out.numbers("no prior:", "dB on its picture,")
    inferred = out.numbers("inferred:", "dB on its picture,")
    assert itself > elsewhere + 2
    assert inferred[1] > elsewhere
    out.numbers("nearest training figure:")
    free, believed = (out.numbers(f"weight {weight}:")[0] for weight in ("0", "1"))
    assert free > believed - 0.5


HEADLINES: dict[str, Callable[[_Printed], None]] = dict(
    zip(
        sorted(SMALL),
        (
            _cameras,
            _integral,
            _nerf,
            _grids,
            _surfaces,
            _cones,
            _ewa,
            _splatting,
            _two_ways,
            _photos,
            _ablation,
            _tables,
            _learnt,
            _priors,
        ),
        strict=True,
    )
)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_runs_and_its_headline_numbers_hold(path: Path, render: ModuleType, tmp_path: Path) -> None:
    notebook = render.execute(path, SMALL[path.stem], folder=tmp_path)
    HEADLINES[path.stem](_Printed(render.printed(notebook)))
    page = render.page(notebook)
    assert "<math" in page or "\\frac" not in page, "equations are not MathML"
    assert (
        "<details><summary>Solution" in page
        and "<script" not in page
        and not re.search("https?:", re.sub(r"http://www.w3.org\S*", "", page))
    )
