"""Strategies in turn, the judge between them, outliers, and what later readers are told; on COLMAP's own synthetic scene."""

import json
import os
import re
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from dots import ring, save
from scipy.spatial.transform import Rotation

from invgraphics.scenes.open import SceneOptions, open_scene
from invgraphics.scenes.photos import PhotoJob, attempts, reconstruct, sfm
from invgraphics.scenes.photos.attempts import choice, try_all_pairs, try_strategies
from invgraphics.scenes.photos.consistency import check_consistency
from invgraphics.scenes.photos.mapping import Matched
from invgraphics.scenes.photos.outlier_cameras import FAR, isolation, remove_outlier_cameras
from invgraphics.scenes.photos.pairs import MatchedPair, VerifiedMatches
from invgraphics.scenes.photos.panorama import is_panorama
from invgraphics.scenes.photos.prepare import Prepared
from invgraphics.scenes.photos.quality import refusal, registration_obstacle, unplaced
from invgraphics.scenes.photos.strategies import WIDE_ANGLE, Strategy, strategies

COUNT = 10


@pytest.fixture
def truth() -> pycolmap.Reconstruction:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, COUNT, 80
    model = pycolmap.synthesize_dataset(options)
    for number, image in model.images.items():
        image.name = f"{number}.png"
    return model


def photos_of(model: pycolmap.Reconstruction) -> tuple[Prepared, ...]:
    camera = next(iter(model.cameras.values()))
    return tuple(
        Prepared(model.images[number].name, f"{number}.jpg", camera.width, camera.height, "") for number in sorted(model.images)
    )


def evidence_of(model: pycolmap.Reconstruction) -> VerifiedMatches:
    """Matches are the observations of one point."""
    numbers, seen = sorted(model.images), {}
    for number in numbers:
        points = model.images[number].points2D
        seen[number] = {point.point3D_id: point.xy for point in points if point.has_point3D()}
    pairs = []
    for (i, first), (j, second) in combinations(enumerate(numbers), 2):
        shared = sorted(set(seen[first]) & set(seen[second]))
        if shared:
            places = [np.array([seen[number][point] for point in shared]) for number in (first, second)]
            pairs.append(MatchedPair(i, j, (places[0], places[1])))
    return VerifiedMatches((1000,) * len(numbers), tuple(pairs))


def turned(model: pycolmap.Reconstruction, every: int) -> pycolmap.Reconstruction:
    """A copy in which some cameras stand elsewhere."""
    copy = pycolmap.Reconstruction(model)
    about = Rotation.from_euler("xyz", [40, 70, 20], degrees=True).as_matrix()
    for number in sorted(copy.images)[::every]:
        frame = copy.frames[copy.images[number].frame_id]
        frame.rig_from_world = frame.rig_from_world * pycolmap.Rigid3d(np.column_stack([about, [0.5, 0, 0]]))
    return copy


def tried(truth: pycolmap.Reconstruction, outcomes: list, tmp_path: Path, **options):
    """Try strategies whose reconstructions are given; returns what `try_strategies` does, and the strategies used."""
    photos, used = photos_of(truth), []

    def place(strategy, matched, progress):
        used.append(strategy)
        progress(1, 2, "placing")
        model = outcomes[min(len(used), len(outcomes)) - 1]
        return [] if model is None else [pycolmap.Reconstruction(model)]

    done = []
    matched = Matched(PhotoJob(str(tmp_path), **options), photos, evidence_of(truth), tmp_path)
    best, rows = try_strategies(matched, lambda step, total, _: done.append(step / total), place)
    assert done == sorted(done)
    assert done[-1] < 1
    return best, rows, used


def test_a_sound_reconstruction_is_the_last(truth, tmp_path: Path) -> None:
    best, rows, used = tried(truth, [truth], tmp_path)
    assert used == [Strategy("incremental", "radial")]
    assert (best.registered, best.consistency["support"], best.outliers) == (COUNT, 1.0, {})
    assert choice(rows) == "incremental mapper, radial lens"


@pytest.mark.parametrize("first", ["folded", "nothing"])
def test_the_next_strategy_is_tried_and_the_choice_written_down(first: str, truth, tmp_path: Path) -> None:
    best, rows, used = tried(truth, [None if first == "nothing" else turned(truth, 2), truth], tmp_path)
    assert [strategy.mapper for strategy in used] == ["incremental", "global"]
    assert best.strategy == used[1]
    assert [row["kept"] for row in rows] == [False, True]
    assert rows[1]["reprojection_error_px"] < 1e-3
    assert choice(rows).startswith(f"global mapper, radial lens: {COUNT} placed")
    assert ("nothing placed" if first == "nothing" else ", suspicious") in choice(rows)
    json.dumps(rows)


def test_the_best_of_the_suspicious_is_kept(truth, tmp_path: Path) -> None:
    """The one whose poses explain most of the matches, not the last one."""
    best, rows, used = tried(truth, [turned(truth, 2), turned(truth, 5), turned(truth, 2)], tmp_path)
    assert len(used) == len(set(used)) == len(rows) == 6
    assert [row["kept"] for row in rows].index(True) == 1
    assert best.consistency["suspicious"]


def bent(truth: pycolmap.Reconstruction, cameras: tuple[int, ...] = (2,)) -> pycolmap.Reconstruction:
    """A copy in which some cameras have a lens that nothing straightens."""
    copy = pycolmap.Reconstruction(truth)
    for number in cameras:
        focal, x, y, _ = copy.cameras[number].params
        copy.cameras[number].params = [focal, x, y, -1.0]
    return copy


@pytest.fixture
def two_cameras() -> pycolmap.Reconstruction:
    """Five photographs by each of two cameras."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 2, 1, COUNT // 2, 80
    model = pycolmap.synthesize_dataset(options)
    for number, image in model.images.items():
        image.name = f"{number}.png"
    return model


def test_poses_whose_lenses_can_be_removed_are_better(two_cameras, tmp_path: Path) -> None:
    """Even where they explain fewer of the matches: of the others not all photographs can be written."""
    best, rows, _ = tried(two_cameras, [bent(two_cameras), turned(two_cameras, 2)], tmp_path)
    assert rows[0]["support"] > rows[1]["support"] + 0.2 and rows[0]["suspicious"] and rows[1]["suspicious"]
    assert [row["kept"] for row in rows].index(True) == 1
    assert (best.registered, best.outliers) == (COUNT, {})


def test_photographs_whose_lens_cannot_be_removed_are_left_out(two_cameras, tmp_path: Path) -> None:
    best, rows, _ = tried(two_cameras, [bent(two_cameras)], tmp_path)
    placed = {image.camera_id for image in best.pieces[0].images.values() if image.has_pose}
    assert (placed, best.registered, rows[0]["registered"]) == ({1}, COUNT // 2, COUNT // 2)
    gone = {f"{number}.jpg" for number, image in two_cameras.images.items() if image.camera_id == 2}
    assert set(best.outliers) == gone and rows[0]["outlier_cameras"] == len(gone)
    assert all(why.startswith("no straight picture can be made of it: The distort") for why in best.outliers.values())
    assert not best.consistency["implausible"], "judged anew, without them"


def test_without_any_lens_that_can_be_removed_nothing_is_placed(two_cameras, tmp_path: Path) -> None:
    best, rows, _ = tried(two_cameras, [bent(two_cameras, (1, 2))], tmp_path)
    assert (best.registered, best.pieces, best.consistency, len(best.outliers)) == (0, [], None, COUNT)
    assert rows[0]["outcome"] == "nothing placed"


def without(model: pycolmap.Reconstruction, left_out: int) -> pycolmap.Reconstruction:
    """A copy in which some photographs are not placed."""
    copy = pycolmap.Reconstruction(model)
    for number in sorted(copy.images)[:left_out]:
        copy.deregister_frame(copy.images[number].frame_id)
    return copy


def test_a_sound_half_is_not_the_end(truth, tmp_path: Path) -> None:
    """The strategy that places most photographs is kept, though others explain as many of the matches of theirs."""
    best, rows, used = tried(truth, [without(truth, 4), without(truth, 2), truth], tmp_path)
    assert len(used) == 3 and best.registered == COUNT
    best, rows, used = tried(truth, [without(truth, 5), without(truth, 2), without(truth, 3)], tmp_path)
    assert len(used) == 6 and [row["kept"] for row in rows].index(True) == 1
    best, rows, used = tried(truth, [without(truth, 1)], tmp_path)
    assert (best.registered, len(used)) == (COUNT - 1, 1), "nine in ten are enough"


def test_more_photographs_are_worth_more_than_a_better_explanation() -> None:
    """Of sound attempts; of suspicious ones, whose photographs may stand anywhere, the explanation counts."""

    def attempt(registered: int, support: float, suspicious: bool) -> attempts.Attempt:
        model = SimpleNamespace(num_reg_images=lambda: registered)
        return attempts.Attempt(Strategy("global", "radial"), [model], {}, {"suspicious": suspicious, "support": support}, 1.0)

    order = [(60, 0.8, True), (40, 0.9, True), (31, 0.7, False), (50, 0.6, False), (50, 0.65, False)]
    ranks = [attempt(*each).rank(60) for each in order]
    assert ranks == sorted(ranks) and len(set(ranks)) == len(ranks)


def test_suspicious_poses_of_all_do_not_beat_sound_ones_of_half(truth, tmp_path: Path) -> None:
    best, _, _ = tried(truth, [turned(truth, 4), without(truth, 5)], tmp_path)
    assert best.registered == 5 and not best.consistency["suspicious"]
    best, _, _ = tried(truth, [turned(truth, 4), without(truth, 7)], tmp_path)
    assert best.registered == COUNT, "three of ten are no scene"


def test_photographs_that_show_nothing_are_not_waited_for(truth, tmp_path: Path, monkeypatch) -> None:
    """Two of ten are blurred: what places the other eight is the end."""
    evidence = evidence_of(truth)
    monkeypatch.setitem(globals(), "evidence_of", lambda _: replace(evidence, features=(5, 5, *evidence.features[2:])))
    assert len(tried(truth, [without(truth, 2)], tmp_path)[2]) == 1


@pytest.mark.parametrize(("matching", "features"), [("auto", 1000), ("sequential", 1000), ("auto", 50)])
def test_all_pairs_are_matched_where_neighbours_place_few(
    truth, tmp_path: Path, monkeypatch, matching: str, features: int
) -> None:
    """Once, and only where the choice was ours and photographs show something."""
    full = evidence_of(truth)
    near = [pair for pair in full.pairs if pair.second == pair.first + 1]
    few = VerifiedMatches((features,) * COUNT, tuple(near))
    monkeypatch.setattr(sfm, "EXHAUSTIVE", COUNT - 1)
    wanted, done = [], []
    monkeypatch.setattr(attempts, "match", lambda pairs, *_: wanted.extend(pairs))
    monkeypatch.setattr(attempts, "read_verified_matches", lambda *_: full)

    def place(strategy, matched, progress):
        return [truth if matched.evidence is full else without(truth, 7)]

    def show(step: int, total: int, _: str) -> None:
        done.append(step / total)

    matched = Matched(PhotoJob(str(tmp_path), matching=matching), photos_of(truth), few, tmp_path)
    after, best, rows = try_all_pairs(matched, *try_strategies(matched, show, place), show, place)
    assert done == sorted(done) and done[-1] < 1
    if (matching, features) != ("auto", 1000):
        assert (wanted, best.registered, after) == ([], 3, matched)
        return
    assert wanted == list(combinations(range(COUNT), 2))
    assert best.registered == COUNT and after.evidence is full
    assert [row["kept"] for row in rows] == [False] * (len(rows) - 1) + [True]
    assert choice(rows).startswith("incremental mapper, radial lens, all pairs matched: 10 placed")


@pytest.mark.parametrize("mapper", ["auto", "incremental", "global"])
def test_every_lens_is_tried_by_the_mappers_that_may(mapper: str) -> None:
    """As `--help` says of `--lens auto` and `--mapper auto`."""
    rows = strategies(PhotoJob("p", mapper=mapper), [Prepared("a.png", "a", 10, 10, "")])
    assert {row.lens for row in rows} == {"radial", "pinhole", "opencv"}
    assert {row.mapper for row in rows} == ({"incremental", "global"} if mapper == "auto" else {mapper})


def test_settings_restrict_what_is_tried() -> None:
    photos = [Prepared("a.png", "a", 10, 10, "")]
    anything = strategies(PhotoJob("p"), photos)
    assert {row.mapper for row in anything} == {"incremental", "global"}
    assert {row.lens for row in anything} == {"radial", "pinhole", "opencv"}
    assert {row.initial_angle for row in anything} == {16.0, WIDE_ANGLE}
    assert any(row.guided for row in anything) and any(row.calibrated for row in anything)
    assert {row.mapper for row in strategies(PhotoJob("p", mapper="global"), photos)} == {"global"}
    assert {row.lens for row in strategies(PhotoJob("p", lens="fisheye"), photos)} == {"fisheye"}
    assert {row.lens for row in strategies(PhotoJob("p"), [replace(photos[0], centre=(5.0, 5.0))])} == {"pinhole"}
    assert strategies(PhotoJob("p", mapper="incremental"), photos)[0] == Strategy("incremental", "radial")


def test_outlier_cameras_are_removed_and_reported(truth) -> None:
    far, bare = sorted(truth.images)[2:4]
    frame = truth.frames[truth.images[far].frame_id]
    frame.rig_from_world = pycolmap.Rigid3d(np.column_stack([np.eye(3), [1e4, 0, 0]]))
    for index, point in enumerate(truth.images[bare].points2D):
        if index >= 5 and point.has_point3D():
            truth.delete_observation(bare, index)
    found = remove_outlier_cameras(truth, photos_of(truth))
    assert set(found) == {f"{far}.jpg", f"{bare}.jpg"}
    assert "times as far" in found[f"{far}.jpg"]
    assert re.search(r"only [1-5] of the points", found[f"{bare}.jpg"])  # some of the first five may show none
    assert truth.num_reg_images() == COUNT - 2
    assert not truth.images[far].has_pose


def test_a_reconstruction_that_hangs_by_threads_is_left_as_it_is(truth) -> None:
    for number in sorted(truth.images)[:6]:
        for index, point in enumerate(truth.images[number].points2D):
            if index >= 5 and point.has_point3D():
                truth.delete_observation(number, index)
    assert remove_outlier_cameras(truth, photos_of(truth)) == {}
    assert truth.num_reg_images() == COUNT


def test_a_walk_has_no_outliers() -> None:
    """Steps of one to three metres, then a look from ten metres away."""
    places = np.cumsum([1.0, 2, 3, 1, 2, 3, 1, 2, 3, 10])
    assert isolation(np.column_stack([places, 0 * places, 0 * places])).max() == pytest.approx(10 / 3)


def test_near_duplicates_isolate_no_other_camera() -> None:
    """Stations 0.4 m apart, all but two photographed twice, and a film beside stills: nothing there is an outlier."""
    generator = np.random.default_rng(0)
    stations = np.column_stack([0.4 * np.arange(31), np.zeros((31, 2))])
    bursts = np.concatenate([stations, stations[1:-1] + 0.01 * generator.normal(size=(29, 3)) / 3**0.5])
    assert isolation(bursts).max() < FAR
    angle = np.linspace(0, 2, 200)
    film = 1.5 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    stills = 2.0 * np.column_stack([np.cos(angle[::17]), np.sin(angle[::17]), 0 * angle[::17]])
    assert isolation(np.concatenate([film, stills])).max() < FAR
    assert isolation(np.concatenate([film, [[9.0, 0, 0]]])).max() > FAR


def test_a_film_is_not_taken_from_one_place() -> None:
    """Most pairs of a film are of neighbouring frames, which move by a few pixels; frames far apart move by hundreds."""
    photos = [Prepared(str(index), str(index), 1600, 900, "") for index in range(300)]
    apart = [(first, first + step) for step in (1, 2, 4, 8, 64, 256) for first in range(300 - step)]

    def evidence(per_frame: float) -> VerifiedMatches:
        """Points of different depths move by a half to one and a half times as much."""
        places = np.random.default_rng(0).uniform(0, 900, (40, 2))
        rates = np.linspace(0.5, 1.5, 40)[:, None] * [per_frame, 0]
        pairs = [MatchedPair(a, b, (places, places + (b - a) * rates)) for a, b in apart]
        return VerifiedMatches((5000,) * 300, tuple(pairs))

    assert registration_obstacle(photos, evidence(1.4)) is None
    assert "one and the same place" in registration_obstacle(photos, evidence(0.01))[0]


@pytest.mark.parametrize("focal", [None, 1000.0])
def test_a_panorama_is_taken_from_one_place(focal: float | None) -> None:
    """Closed form: pixels of directions seen by a turning camera; with a step to the side at each turn they are no panorama."""
    photos = [Prepared(str(index), str(index), 1000, 800, "", focal) for index in range(5)]
    points = np.random.default_rng(0).uniform([-3, -3, 4], [3, 3, 9], (2000, 3))

    def evidence(step: float) -> VerifiedMatches:
        seen = []
        for index in range(5):
            rotation = Rotation.from_euler("yx", [6 * index, 2 * index], degrees=True).as_matrix()
            local = (points - [step * index, 0, 0]) @ rotation.T
            seen.append(1000 * local[:, :2] / local[:, 2:] + [500, 400])
        inside = [((place > 0) & (place < [1000, 800])).all(axis=1) for place in seen]
        shared = {(i, j): inside[i] & inside[j] for i, j in combinations(range(5), 2)}
        pairs = [MatchedPair(i, j, (seen[i][both], seen[j][both])) for (i, j), both in shared.items()]
        return VerifiedMatches((5000,) * 5, tuple(pairs))

    assert "turns of the camera alone" in registration_obstacle(photos, evidence(0.0))[0]
    assert registration_obstacle(photos, evidence(0.2)) is None


def test_a_flat_wall_passed_by_is_no_panorama() -> None:
    photos = [Prepared(str(index), str(index), 1600, 1200, "") for index in range(4)]
    places = np.random.default_rng(0).uniform([0, 0], [1600, 1200], (400, 2))
    pairs = [
        MatchedPair(i, j, (places[places[:, 0] > 300], places[places[:, 0] > 300] - [300, 0])) for i, j in ((0, 1), (2, 3))
    ]
    assert not is_panorama(photos, VerifiedMatches((5000,) * 4, tuple(pairs)))


def test_a_reconstruction_of_next_to_no_points_is_refused(truth) -> None:
    """All cameras are placed by two points, as of a panorama; the matches contradict nothing."""
    photos, evidence = photos_of(truth), evidence_of(truth)
    assert refusal(photos, evidence, [image.num_points3D for image in truth.images.values()]) is None
    for point in sorted(truth.points3D)[2:]:
        truth.delete_point3D(point)
    observed = [image.num_points3D for image in truth.images.values()]
    assert remove_outlier_cameras(truth, photos) == {}
    found = check_consistency(truth, photos, evidence)
    assert found["suspicious"] and "2 points in the median" in found["sentence"]
    assert refusal(photos, evidence, observed)[0].startswith("10 of 10 photographs were placed by next to nothing (2 points")


def test_photographs_of_another_piece_are_told_of_it() -> None:
    photos = [SimpleNamespace(name=str(index), source=f"{index}.jpg") for index in range(4)]
    pairs = [SimpleNamespace(first=0, second=1, motion=50.0), SimpleNamespace(first=2, second=3, motion=50.0)]
    images = {1: SimpleNamespace(name="2", has_pose=True), 2: SimpleNamespace(name="3", has_pose=True)}
    piece = SimpleNamespace(images=images, num_reg_images=lambda: 2)
    found = unplaced(photos, VerifiedMatches((5000,) * 4, tuple(pairs)), {"0", "1"}, {}, [piece])
    assert set(found) == {"2.jpg", "3.jpg"}
    assert all("a separate piece of 2 photographs" in why and "--matching exhaustive" in why for why in found.values())


@pytest.mark.parametrize(("key", "suspicious"), [("consistency", True), ("consistency", False), ("suspicion", True)])
def test_a_scene_repeats_the_inconsistency_of_its_import(key: str, suspicious: bool, tmp_path: Path) -> None:
    model = pycolmap.Reconstruction()
    for index, eye in enumerate(ring(9, distortion=None), start=1):
        save(eye.picture(), tmp_path / "images" / f"{index}.png")
        params = [*eye.focal, *eye.centre]
        camera = pycolmap.Camera(model="PINHOLE", width=eye.size[0], height=eye.size[1], params=params, camera_id=index)
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=f"{index}.png", camera_id=index, image_id=index)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.column_stack([eye.R, eye.t])))
    (tmp_path / "sparse/0").mkdir(parents=True)
    model.write(str(tmp_path / "sparse/0"))
    assert "poses" not in open_scene(str(tmp_path), SceneOptions()).notes
    profile = "of 9 photographs converted to sRGB: 9 from Display P3"
    quality = {
        "key": "k",
        "choice": "global mapper",
        "colour_profile": profile,
        key: {"suspicious": suspicious, "sentence": "3 of 9 contradict"},
    }
    (tmp_path / "quality.json").write_text(json.dumps(quality))
    for spelled in (".", "sparse", "sparse/0", "images"):  # any of the scene's folders names it
        notes = open_scene(str(tmp_path / spelled), SceneOptions()).notes
        assert (notes.get("poses"), notes.get("colour_profile")) == ("global mapper", profile), spelled
        assert notes.get("inconsistent_poses") == ("3 of 9 contradict" if suspicious else None)


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.timeout(3600)
@pytest.mark.skipif("INVGRAPHICS_DATA" not in os.environ, reason="INVGRAPHICS_DATA is not set")
def test_photographs_around_a_table_look_at_it(tmp_path: Path) -> None:
    """No flags: rings of cameras around what their optical axes have in common, which lies before all of them."""
    folder = Path(os.environ["INVGRAPHICS_DATA"]) / "bonsai_photos"
    quality = reconstruct(PhotoJob(str(folder)), tmp_path / "scene")
    assert quality["registered"] >= 60
    assert not quality["consistency"]["suspicious"]
    assert quality["reprojection_error_px"] < 0.7
    poses = np.array([camera["cam_to_world"] for camera in quality["cameras"]])
    centre, forward = poses[:, :3, 3], poses[:, :3, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None]
    middle = np.linalg.solve(across.sum(axis=0), (across @ centre[:, :, None]).sum(axis=0))[:, 0]
    depth = ((middle - centre) * forward).sum(axis=1)
    beside = np.linalg.norm(middle - centre - depth[:, None] * forward, axis=1)
    assert (depth > 0).all()
    assert np.median(beside / depth) < 0.15
    # All around: seen from the middle, no gap between neighbouring cameras is wider than a sixth of the circle.
    up = np.linalg.svd(centre - centre.mean(axis=0))[2][2]
    flat = (centre - middle) - np.outer((centre - middle) @ up, up)
    axes = np.linalg.svd(flat)[2][:2]
    azimuth = np.sort(np.arctan2(flat @ axes[1], flat @ axes[0]))
    assert np.diff(np.append(azimuth, azimuth[0] + 2 * np.pi)).max() < 2 * np.pi / 6
