"""The commands `verso capture ...`: each reads its options, prints what it did, and returns the exit code."""

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import ValidationError

from schemas.base import set_key
from schemas.capture import CaptureEstimate
from schemas.errors import CaptureError, InputError, OutputError, plural
from schemas.job.captures import Board, Captures
from schemas.job.job import Job
from schemas.job.views import Render
from services.job.job_file import change_key, validate_job

if TYPE_CHECKING:
    from workers.capture.process import CaptureViews, ProcessedFolder
    from workers.capture.score import SurfaceErrors


def capture_job(changes: Sequence[str] = (), keys: Mapping[str, Any] | None = None) -> Job:
    """A job named `capture`: the dotted `keys` of a command's own options, then `path.to.key=value` of --set.

    A key whose value is None is left at its default. Raises JobError, which is wrong input.
    """
    tree: dict[str, Any] = {"name": "capture", "scenes": 1, "captures": {}}
    for path, value in (keys or {}).items():
        if value is not None:
            set_key(tree, path, value)
    for change in changes:
        change_key(tree, change)
    return validate_job(tree, "verso capture")


def capture_settings(changes: Sequence[str] = (), keys: Mapping[str, Any] | None = None) -> Captures:
    """The branch `captures` of that job. Raises JobError."""
    captures = capture_job(changes, keys).captures
    assert captures is not None
    return captures


def board(options: argparse.Namespace) -> int:
    """Writes options.file (.pdf, .png, or .json alone), and a board.json beside it. Returns 0.

    Reads `board`, `other`, `solve`, `kind` with `size`, `marker`, `pitch` and `dictionary`, `tiles`, `dpi` and `json`.
    """
    from workers.capture.sheets import board_pdf, board_png, tiled_pdf

    path = Path(options.file)
    spec = _chosen_board(options)
    kind = path.suffix.lower()
    data = None
    if kind == ".pdf":
        data = tiled_pdf(spec) if options.tiles else board_pdf(spec)
    elif options.tiles:
        raise InputError("--tiles makes pages: name a file that ends in .pdf")
    elif kind == ".png":
        data = board_png(spec, options.dpi)
    elif kind != ".json":
        raise InputError(f"{path}: name a file that ends in .pdf, .png or .json")
    described, new = _describe_board(path, spec, data)
    written = spec.model_dump(mode="json", exclude=spec.unwritten)
    answer = {"ok": True, "board_file": str(described), "board": written}
    size = "" if spec.markers else f" of {spec.marker_m * 1000:g} mm"
    if data is not None:
        how = "A4 pages to glue" if options.tiles else "print at 100 %"
        print(f"{path}: {spec.words}{size} ({spec.dictionary}); {how}")
        answer["file"] = str(path)
        ruler = f"measure the printed ruler; if it is not {spec.ruler_m * 1000:g} mm"
        print(f"{ruler}, say so in {described} (measured_ruler_m)")
    print(f"{described}: {'the board, for --board' if new else 'was there and is kept'}")
    if options.json:
        print(json.dumps(answer))
    return 0


def _chosen_board(options: argparse.Namespace) -> Board:
    """The board of the file --board, of another program's file --from, of photographs, or of --kind. Raises InputError."""
    sizes = {"size": options.size, "marker": options.marker, "pitch": options.pitch}
    names = {"board": "--board", "other": "--from", "solve": "--solve", "kind": "--kind"}
    given = [name for name in names if getattr(options, name)]
    if len(given) > 1:
        raise InputError(f"{names[given[0]]} and {names[given[1]]} are two boards: give one of them")
    if options.solve:
        return _solved_board(options)
    if not options.kind:
        if stray := next((name for name, value in {**sizes, "dictionary": options.dictionary}.items() if value), None):
            raise InputError(f"--{stray} is of a board that --kind names: add --kind grid, charuco or aprilgrid")
        from workers.capture.board_kinds import read_board_file
        from workers.capture.folder import read_board

        return (
            read_board_file(options.other) if options.other else read_board(options.board) if options.board else Board()
        )
    from workers.capture.board_kinds import KINDS, BoardSizes

    if missing := next((name for name, value in sizes.items() if not value), None):
        raise InputError(f"--kind {options.kind} needs --{missing}, such as --size 8x6 --marker 0.022 --pitch 0.03")
    usual = "DICT_APRILTAG_36h11" if options.kind == "aprilgrid" else Board().dictionary
    columns, rows = options.size
    sizes_m = (options.marker, options.pitch)
    return KINDS[options.kind](BoardSizes(columns, rows, *sizes_m, options.dictionary or usual))


def _solved_board(options: argparse.Namespace) -> Board:
    """The places of tags in photographs. Raises InputError, CaptureError."""
    from workers.capture.folder import open_folder
    from workers.capture.poses.solve_board import describe, solve_board

    if not options.marker or options.size or options.pitch:
        raise InputError("--solve needs --marker, the side of every tag in metres, and no --size or --pitch")
    dictionary = options.dictionary or Board().dictionary
    solved = solve_board(open_folder(options.solve, Board()), options.marker, dictionary)
    print("\n".join(describe(solved)))
    return solved.board


def _describe_board(path: Path, spec: Board, data: bytes | None) -> tuple[Path, bool]:
    """Writes the print, if there is one, and a description unless one is there, which may hold what somebody measured."""
    from workers.capture.folder import read_board

    described = path.with_suffix(".json")
    new = not described.exists()
    if not new and read_board(described).model_copy(update={"measured_ruler_m": spec.measured_ruler_m}) != spec:
        raise InputError(f"{described} is of another board: print that with --board {described}, or name another file")
    printed = {"measured_ruler_m": spec.measured_ruler_m or spec.ruler_m} if data is not None else {}
    try:
        if data is not None:
            path.write_bytes(data)
        if new:
            text = spec.model_copy(update=printed).model_dump_json(indent=1, exclude=spec.unwritten)
            described.write_text(f"{text}\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror}") from error
    return described, new


def simulate(options: argparse.Namespace) -> int:
    """Writes the folder options.out; reads `views`, `seed`, `category`, `changes` (--set) and `json`. Returns 0.

    Raises JobError for settings that cannot be, AssetSourceError where no source has the category, OutputError where the
    folder has files.
    """
    keys = {"seed": options.seed, "categories": [options.category], "captures.simulate.views": options.views}
    if options.views is not None:
        keys["pairs_per_scene"] = options.views  # of a dataset, which this folder is not
    job = capture_job(options.changes, keys)
    assert job.captures is not None
    path, begun = Path(options.out), time.perf_counter()
    from workers.capture.folder import open_folder
    from workers.capture.make_capture import load_object
    from workers.capture.results import open_sources
    from workers.capture.score import describe_true_grazing
    from workers.capture.simulate.simulate import simulate_capture
    from workers.render.tiers import require_tier
    from workers.scene.draw.plan import SceneChance
    from workers.scene.effects import CAPTURE_EFFECTS, plan_capture

    settings, chance = job.captures.simulate, SceneChance(job.seed, job.first_scene)
    require_tier(Render(tier=settings.tier))
    catalogue = open_sources(job, Path.cwd())
    asset = load_object(job, catalogue, chance)
    plan = plan_capture(settings)
    around = job.look, catalogue
    truth = simulate_capture(settings, job.captures.printed_board, asset, chance, _make_empty(path), around=around)
    seconds, ran = time.perf_counter() - begun, [name for name in CAPTURE_EFFECTS if plan.runs(name)]
    views = len(truth.T_board_cam)
    print(
        f"{path}: {plural(views, 'view')} of {asset.instance_id} in {seconds:.1f} s; effects: {', '.join(ran) or 'none'}"
    )
    print(f"{path / 'truth'}: poses and the true mesh, which only `verso capture evaluate` reads")
    if (note := describe_true_grazing(open_folder(path))) is not None:
        print(f"note: {note}")
    if options.json:
        answer = {"ok": True, "out": str(path), "views": views, "category": asset.category}
        answer |= {"instance_id": asset.instance_id, "seed": job.seed, "effects": ran, "seconds": seconds, "note": note}
        print(json.dumps(answer))
    return 0


def import_recording(options: argparse.Namespace) -> int:
    """Reads options.recording, `out`, `frames`, `board` and `camera` (paths or None), `name`, `category`, `json`. Returns 0.

    Raises InputError and OutputError for what cannot be, CaptureError for a recording that cannot be used.
    """
    from workers.capture import import_recording as work
    from workers.capture.folder import CaptureFile, derive_name, read_board

    recording, out = Path(options.recording), Path(options.out)
    try:
        about = CaptureFile(name=options.name or derive_name(out.resolve().name), category=options.category)
    except ValidationError as error:
        first = error.errors()[0]
        words = f"--{first['loc'][0]} {first['input']!r}: letters, digits, - and _ only, at most 64"
        raise InputError(words) from error
    board = read_board(Path(options.board)) if options.board else Board()
    if not recording.exists():
        raise InputError(f"{recording}: no such file or folder")
    made = work.import_recording(recording, _make_empty(out), about, board, options.frames, options.camera)
    views = f"{plural(len(made.views), 'view')} of {plural(made.frames, 'frame')}"
    print(f"{out}: {views}, depth registered by {made.calibration}")
    for note in made.notes:
        print(f"  {note}")
    if not options.board:
        print(f"  no --board: board.json is the default board ({board.words}, {board.dictionary})")
    if options.json:
        answer = {"ok": True, "out": str(out), "frames": made.frames, "default_board": not options.board}
        print(json.dumps({**answer, **asdict(made)}))
    return 0


def _make_empty(out: Path) -> Path:
    """The folder, made if need be. Raises OutputError where it holds something or cannot be made."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise OutputError(f"{out} is not empty: name a new or an empty folder")
    except OSError as error:
        raise OutputError(f"{out} cannot be made: {error.strerror}") from error
    return out


def process(options: argparse.Namespace) -> int:
    """Processes options.folder; reads `estimate`, `calibrate`, `changes` (--set) and `json`. Returns 0.

    Raises JobError, CaptureError.
    """
    keys = {
        "captures.estimation.estimate": options.estimate,
        "captures.estimation.calibrate": options.calibrate or None,
    }
    captures = capture_settings(options.changes, keys)
    from workers.capture.process import process_folder

    done = process_folder(options.folder, captures)
    _print_processed(options.folder, done)
    if options.json:
        final, surface = done.estimates.estimate, done.merged.surface
        answer = {"ok": True, "folder": str(options.folder), "estimate": final.estimate, "views": len(final.views)}
        answer |= {"used": len(final.used), "points": len(surface.points), "faces": len(surface.faces)}
        answer |= {"notes": list(final.notes), "kept": list(done.users), "seconds": dict(done.seconds)}
        print(json.dumps(answer))
    return 0


def _print_processed(folder: Path, done: "ProcessedFolder") -> None:
    for estimate in done.estimates.by_name.values():
        chosen = " (chosen)" * (estimate.estimate == done.estimates.chosen)
        print(f"{estimate.estimate:8} {_describe_estimate(estimate)}{chosen}")
    for view in done.estimates.estimate.views:
        if view.status != "used":
            print(f"view {view.number} {view.status}: {'; '.join(view.reasons)}")
    for note in done.estimates.estimate.notes:
        print(f"note: {note}")
    for name in done.users:
        print(f"kept: {name}, which processing did not write")
    surface, slowest = done.merged.surface, sorted(done.seconds.items(), key=lambda item: -item[1])
    counts = f"{len(surface.points)} points, {len(surface.faces)} faces"
    print(f"{folder}: {counts}, {done.seconds['total']:.1f} s of processor time")
    print("  " + ", ".join(f"{name} {s:.1f} s" for name, s in slowest if name != "total"))


def _describe_estimate(estimate: CaptureEstimate) -> str:
    pixels = [view.reprojection_px for view in estimate.used if view.reprojection_px is not None]
    depth = [view.depth_mm for view in estimate.used if view.depth_mm is not None]
    words, correction = [f"{len(estimate.used)} of {len(estimate.views)} views"], estimate.depth
    if pixels:
        words.append(f"corners {np.median(pixels):.2f} px")
    if depth:
        words.append(f"depth off the board {np.median(depth):.1f} mm")
    if correction.identified:
        words.append(f"depth offset {1e3 * correction.offset_m:+.1f} mm, scale {correction.scale:.4f}")
    if estimate.print_scale != 1.0:
        words.append(f"print scale {estimate.print_scale:.4f}")
    return ", ".join(words)


def synthesize(options: argparse.Namespace) -> int:
    """Writes views of options.folder to options.out: from the pose in the file `pose`, or with `mirror` one for each view.

    Returns 0. Raises InputError where the pose file is missing, CaptureError where nothing was processed or nothing is seen.
    """
    from workers.capture.folder import read_pose
    from workers.capture.process import read_result, write_mirrors, write_synthesized

    out = options.out or Path(options.folder) / "views"
    result = read_result(options.folder)
    if options.mirror:
        made = write_mirrors(result, out)
    else:
        T_board_cam = read_pose(options.pose)
        if T_board_cam is None:
            raise InputError(f"{options.pose} is not there: it holds T_board_cam, 4 lines of 4 numbers")
        made = [write_synthesized(result, T_board_cam, out)]
    if not made:
        raise CaptureError("nothing_seen", f"no view of {options.folder} has a view from the other side")
    for view in made:
        what = (
            f"{view['name']}: {view['measured_share']:.1%} measured, from views {', '.join(map(str, view['sources']))}"
        )
        print(f"{what}; d_z {view['d_z_m']:.3f} m" if "d_z_m" in view else what)
    print(f"{out}: {plural(len(made), 'view')}")
    if options.json:
        print(json.dumps({"ok": True, "out": str(out), "views": made}))
    return 0


def evaluate(options: argparse.Namespace) -> int:
    """Scores options.folder against truth/, or its surface against the file `mesh`, which is aligned to it first. Returns 0.

    Raises CaptureError where the folder was not processed, or there is neither truth nor a mesh.
    """
    from workers.capture.process import read_result

    result = read_result(options.folder)
    surface, answer = _against_truth(result) if options.mesh is None else _against_mesh(result, options)
    _print_surface(surface)
    if options.json:
        known = {"ok": True, "folder": str(options.folder), "estimate": result.estimate.estimate}
        print(json.dumps({**known, **answer, **asdict(surface)}))
    return 0


def _against_truth(result: "CaptureViews") -> tuple["SurfaceErrors", dict[str, Any]]:
    from workers.capture.score import read_whole_truth, score_capture, score_measured

    truth = read_whole_truth(result.folder)
    if truth is None:
        raise CaptureError(
            "no_truth",
            f"{result.folder.path} has no truth/, which simulated captures have: give the object's mesh with --mesh",
        )
    score = score_capture(result, truth)
    poses = {"pose_mm": score.summary.pose_mm, "pose_deg": score.summary.pose_deg}
    for unit in ("mm", "deg"):
        poses[f"pose_worst_{unit}"] = max(getattr(view, f"pose_{unit}") for view in score.summary.views.values())
    print(f"poses    median {poses['pose_mm']:.3f} mm, {poses['pose_deg']:.4f} degrees")
    print(f"         worst {poses['pose_worst_mm']:.3f} mm, {poses['pose_worst_deg']:.4f} degrees")
    for number, errors in score.held_out.items():
        print(
            f"view {number} made of the others: depth {errors.depth_median_mm:.2f} mm (95 %: {errors.depth_p95_mm:.2f}), "
            f"colour {errors.color_error:.1f} of 255, covers {errors.covered:.1%}, {errors.measured_share:.1%} measured"
        )
    measured, complete = score_measured(result, truth)
    print(f"depth    of {measured:.1%} of what was visible in any view; {complete:.1%} of that has a point within 3 mm")
    answer = {
        **poses,
        "measured_of_visible": measured,
        "completeness_of_measured": complete,
        "aligned_by": None,
        "depth_median_mm": score.summary.depth_median_mm,
        "held_out": {str(number): asdict(errors) for number, errors in score.held_out.items()},
    }
    return score.surface, answer


def _against_mesh(result: "CaptureViews", options: argparse.Namespace) -> tuple["SurfaceErrors", dict[str, Any]]:
    from workers.capture.score import describe_misfit, read_mesh_file, score_against_mesh

    surface, T_board_obj, rms_mm = score_against_mesh(result, read_mesh_file(options.mesh))
    print(f"{options.mesh} was aligned to the cloud by ICP, which leaves {rms_mm:.2f} mm rms:")
    print("poses are not scored, and errors that a rigid motion explains are not seen")
    if note := describe_misfit(result.surface.points, rms_mm):
        print(f"note: {note}")
    answer = {"aligned_by": "icp", "icp_rms_mm": rms_mm, "T_board_obj": T_board_obj.tolist()}
    return surface, {**dict.fromkeys(("pose_mm", "pose_deg", "depth_median_mm")), **answer}


def _print_surface(errors: "SurfaceErrors") -> None:
    print(
        f"cloud    {errors.points} points; median {errors.cloud_median_mm:.3f} mm, 95 %: {errors.cloud_p95_mm:.3f} mm off "
        "the surface"
    )
    print(f"surface  median {errors.surface_median_mm:.3f} mm, 95 %: {errors.surface_p95_mm:.3f} mm off the mesh")
    print(
        f"         {errors.completeness:.1%} of what was visible has a point within 3 mm; visible was {errors.visible_share:.1%}"
    )
