"""``invgraphics import-photos``: reconstruct a scene with camera poses from a folder of photographs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from invgraphics.cli.output import show_table
from invgraphics.errors import InputError

_MOST_FILES = 10


@dataclass(frozen=True, kw_only=True)
class ImportPhotos:
    """Reconstruct camera poses and points from photographs (structure from motion), and write them as a scene.

    The folder of the scene gets straight pictures, poses and points in COLMAP's format, quality.json, and a plot of cameras and
    points. Where a check finds the poses suspicious, or a tenth of the photographs that match others is not placed, other
    strategies are tried and the best result is kept. An interrupted import continues when the same command is given again;
    another mapper or lens finds the features and matches of the last one in FOLDER/.import, which may be deleted. A result with
    too few photographs replaces no usable one: it is written into FOLDER/refused.

    Attributes:
        folder: A folder of photographs, with masks of their names in `masks/` in it or beside it if there are any (dark pixels
            do not count); or a data set, whose pictures are taken without its poses.
        out: Folder of the scene, new or empty.
        matching: Which pairs are compared: all of them, or each photograph with those near it in name order; auto: all, up to
            200 photographs, or up to 500 where less than half of them could be placed.
        mapper: How poses are found: one photograph after the other, or all at once (GLOMAP); auto: the first, and the other
            where the result is suspicious or leaves photographs out.
        lens: What distortion is estimated and removed; auto: radial, and pinhole and opencv where the result is suspicious or
            leaves photographs out.
        single_camera: All photographs share one set of intrinsics (default: those of one size and one EXIF lens do).
        camera_per_photo: Each photograph has intrinsics of its own.
        max_size: Longest side that pictures are reduced to.
        truth: A data set with the true poses of these photographs, to score the recovered ones.
        seed: Seed of all random choices.
    """

    folder: Annotated[Positional[Path], arg(metavar="DIR")]
    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: scenes/DIR)")] = None
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    mapper: Literal["auto", "incremental", "global"] = "auto"
    lens: Literal["auto", "pinhole", "radial", "opencv", "fisheye"] = "auto"
    single_camera: bool = False
    camera_per_photo: bool = False
    max_size: Annotated[int, arg(metavar="PIXELS")] = 1600
    truth: Annotated[Path | None, arg(metavar="SCENE", help_behavior_hint="(default: the data set that DIR lies in)")] = None
    seed: int = 0

    def run(self) -> int:
        """Reconstruct; prints the quality and the scene's folder. Returns exit status 0."""
        if self.single_camera and self.camera_per_photo:
            raise InputError("--single-camera and --camera-per-photo exclude each other.")
        if self.truth is not None and not self.truth.exists():
            raise InputError(f"There is no data set '{self.truth}'.")
        out = self.out or Path("scenes") / (self.folder.resolve().name or "photos")

        from invgraphics.experiments.progress import Reporter
        from invgraphics.scenes.photos import PhotoJob
        from invgraphics.scenes.photos.maker import result_folder
        from invgraphics.tools.photos import import_photos

        job = PhotoJob(
            folder=str(self.folder),
            matching=self.matching,
            mapper=self.mapper,
            lens=self.lens,
            cameras="single" if self.single_camera else "per-photo" if self.camera_per_photo else "auto",
            max_size=self.max_size,
            seed=self.seed,
        )
        with Reporter(f"importing {self.folder.name}") as reporter:
            quality = import_photos(
                job, out, self.truth, progress=lambda done, total, what: reporter.show(done / max(total, 1), what)
            )
        show_quality(quality)
        if not quality["usable"]:
            sentence, remedy = quality["refusal"]
            place = result_folder(out, quality)
            kept = f" What could be placed is kept in {place}." if quality["registered"] else ""
            earlier = f" {out} keeps the usable scene of an earlier import." if place != out else ""
            raise InputError(sentence, remedy + kept + earlier)
        print(out)
        return 0


def show_quality(quality: Mapping[str, Any]) -> None:
    """Print the quality of the reconstruction, and the photographs that were left out."""
    show_table("Structure from motion", ("what", "found"), list(_rows(quality)))
    for kind, files in (("left out", quality["skipped"]), ("not placed", quality["unplaced"])):
        for name, why in list(files.items())[:_MOST_FILES]:
            print(f"{kind}: {name}: {why}")
        if len(files) > _MOST_FILES:
            print(f"{kind}: {len(files) - _MOST_FILES} more, see quality.json")
    consistency = quality["consistency"]
    if consistency is not None and consistency["suspicious"]:
        print(f"SUSPICIOUS: {consistency['sentence']}")


def _rows(quality: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    pieces = "".join(f", a separate piece of {count}" for count in quality["other_pieces"])
    yield "photographs placed", f"{quality['registered']} of {quality['used']}{pieces}"
    if quality.get("masked"):
        yield "masks", f"{quality['masked']} photographs have one: dark pixels do not count"
    if quality["registered"]:
        yield "points", f"{quality['points']}, each in {quality['track_length']:.1f} photographs"
        yield "reprojection error", f"{quality['reprojection_error_px']:.2f} px"
        models = Counter(lens["model"] for lens in quality["lenses"])
        lenses = ", ".join(f"{count} {model}" for model, count in models.items())
        yield "cameras", f"{lenses}; distortion moves pixels by up to {quality['bend_px']:.1f} px"
    if quality["consistency"] is not None:
        found = quality["consistency"]
        yield "pairs against poses", f"{found['contradicting']} of the {found['pairs']} best matched contradict them"
        yield "photographs in doubt", f"{len(found['doubtful'])} of {found['asked']}"
        yield "matches explained", f"{100 * found['support']:.0f} %"
    for row in quality["attempts"] if len(quality["attempts"]) > 1 else ():
        yield "kept" if row["kept"] else "tried", f"{row['strategy']}: {row['outcome']}, {row['seconds']:.0f} s"
    if "truth" in quality:
        truth = quality["truth"]
        turn, shift = truth["rotation_degrees"], truth["translation_per_cent"]
        yield "rotation error", f"{turn['median']:.3f}° median, {turn['max']:.3f}° largest ({truth['cameras']} cameras)"
        yield "translation error", f"{shift['median']:.3f} % of the scene's extent median, {shift['max']:.3f} % largest"
        yield "truth", truth["source"]
    yield "time", ", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in quality["seconds"].items())
