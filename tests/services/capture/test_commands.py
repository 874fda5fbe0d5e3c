"""The commands `verso capture ...`: what they write and tell, and what they refuse."""

import json
import shutil

import pytest
import trimesh

from schemas.errors import CaptureError, InputError, JobError, OutputError
from services.capture import capture_job, capture_settings
from services.cli.main import main
from tests.workers.capture.simulated import VIEWS, box, copy_of, processed
from tests.workers.door.recordings import recording
from workers.capture.folder import open_folder, read_board
from workers.capture.truth import read_truth


@pytest.fixture
def run(capsys):
    """`run(words...)`: (exit code, output, errors, the JSON answer of the last line where there is one) of a command."""

    def run(*words):
        code = main(["capture", *map(str, words)])
        said = capsys.readouterr()
        last = said.out.splitlines()[-1] if "--json" in words and said.out else "null"
        return code, said.out, said.err, json.loads(last) if last[0] in "{n" else None

    return run


def test_options_come_first_and_set_has_the_last_word():
    keys = {"captures.simulate.views": 12, "captures.simulate.image_scale": None, "seed": 5, "categories": ["mug"]}
    job = capture_job(["captures.simulate.views=9"], keys)
    assert (job.captures.simulate.views, job.captures.simulate.image_scale, job.seed) == (9, 1.0, 5)
    assert list(job.categories) == ["mug"] and capture_settings().estimation.estimate == "joint"
    for change, words in (
        ("captures.fusion.voxl_m=0.1", "did you mean 'voxel_m'"),
        ("captures.fusion.voxel_m=9", "at most 0.02"),
        ("voxel_m", "path.to.key=value"),
    ):
        with pytest.raises(JobError, match=words) as caught:
            capture_settings([change])
        assert caught.value.exit_code == 2


def test_board_writes_the_sheet_that_was_asked_for_or_says_why_not(run, tmp_path):
    for name, more, start, pages in (
        ("b.pdf", (), b"%PDF", 1),
        ("t.pdf", ("--tiles", "a4"), b"%PDF", 8),
        ("b.PNG", ("--dpi", 50), b"\x89PNG", 0),
    ):
        code, _, _, answer = run("board", tmp_path / name, *more, "--json")
        data = (tmp_path / name).read_bytes()
        assert code == 0 and data.startswith(start) and data.count(b"/MediaBox") == pages
        assert answer["board"]["columns"] == 7
        written = (tmp_path / name).with_suffix(".json")
        assert answer["board_file"] == str(written) and read_board(written).measured_ruler_m == 0.2
    (tmp_path / "b.json").write_text('{"measured_ruler_m": 0.1987}')
    assert "was there and is kept" in run("board", tmp_path / "b.pdf")[1]
    assert read_board(tmp_path / "b.json").measured_ruler_m == 0.1987
    (tmp_path / "x.json").write_text('{"columns": 3}')
    own, wrong = tmp_path / "own.json", tmp_path / "wrong.json"
    own.write_text('{"columns": 3, "rows": 3, "width_m": 0.3, "height_m": 0.28}')
    wrong.write_text('{"columns": 30}')
    assert "3 x 3 markers" in run("board", tmp_path / "own.pdf", "--board", own)[1]
    for words, refusal, told in (
        ((tmp_path / "b.jpg",), InputError, "ends in .pdf, .png or .json"),
        ((tmp_path / "k.pdf", "--kind", "charuco", "--size", "8x6"), InputError, "--kind charuco needs --marker"),
        ((tmp_path / "k.pdf", "--marker", "0.03"), InputError, "add --kind grid"),
        ((tmp_path / "k.pdf", "--kind", "grid", "--from", own), InputError, "--from and --kind are two boards"),
        ((tmp_path / "k.pdf", "--from", own), InputError, "describes no board that is known"),
        ((tmp_path / "b",), InputError, "ends in"),
        ((tmp_path / "b.png", "--tiles", "a4"), InputError, "ends in"),
        ((tmp_path / "x.pdf", "--board", wrong), CaptureError, "wrong.json"),
        ((tmp_path / "none" / "b.pdf",), OutputError, "cannot be written"),
        ((tmp_path / "x.pdf",), InputError, "x.json is of another board"),
        ((tmp_path / "x.pdf", "--board", tmp_path / "no.json"), CaptureError, "`verso capture board` writes one"),
    ):
        code, _, err, _ = run("board", *words)
        assert code == refusal.exit_code and told in err and not words[0].exists()


def test_a_board_of_any_kind_is_printed_or_described_and_read_again(run, tmp_path):
    target = tmp_path / "target.yaml"
    target.write_text("target_type: aprilgrid\ntagCols: 4\ntagRows: 3\ntagSize: 0.05\ntagSpacing: 0.3\n")
    code, _, _, answer = run("board", tmp_path / "april.json", "--from", target, "--json")
    april = read_board(tmp_path / "april.json")
    assert code == 0 and len(april.markers) == 12 and april.border_bits == 2 and april.measured_ruler_m is None
    assert "file" not in answer and answer["board"]["dictionary"] == "DICT_APRILTAG_36h11"
    sizes = ("--size", "4x3", "--marker", "0.05", "--pitch", "0.065")
    assert run("board", tmp_path / "same.pdf", "--kind", "aprilgrid", *sizes)[0] == 0
    assert read_board(tmp_path / "same.json").model_copy(update={"measured_ruler_m": None}) == april
    assert (
        run("board", tmp_path / "grid.png", "--kind", "grid", *sizes, "--dictionary", "DICT_4X4_100", "--dpi", 50)[0]
        == 0
    )
    assert read_board(tmp_path / "grid.json").gap_m == pytest.approx(0.015)
    for wrong in (("--size", "8by6"), ("--size", "0x6"), ("--marker", "nan"), ("--pitch", "0"), ("--kind", "dots")):
        with pytest.raises(SystemExit) as stopped:
            run("board", tmp_path / "k.pdf", *wrong)
        assert stopped.value.code == 2


SMALL = ("--set", "captures.simulate.image_scale=0.1")


def test_simulate_writes_a_capture_that_can_be_read_and_the_seed_decides_what_is_seen(run, tmp_path):
    noisy = ("--set", "captures.simulate.depth_noise={}", "--json")
    for name, seed in (("a", 5), ("b", 5), ("c", 2)):
        out = tmp_path / name
        code, _, _, told = run(
            "simulate", "--out", out, "--views", 3, "--category", "can", "--seed", seed, *SMALL, *noisy
        )
        assert code == 0 and told["ok"]
        assert (told["views"], told["category"], told["effects"]) == (3, "can", ["depth_noise"])
        assert open_folder(out).numbers == (0, 1, 2) and open_folder(out).about.category == "can"
        assert len(read_truth(out).T_board_cam) == 3
    a, b, c = ((tmp_path / name / "rgb_00000.png").read_bytes() for name in "abc")
    assert a == b != c
    tiny = ("--set", "captures.simulate.image_scale=0.02")  # more views than a dataset keeps by default
    assert run("simulate", "--out", tmp_path / "x", "--views", 65, *tiny)[0] == 0
    assert len(open_folder(tmp_path / "x").numbers) == 65


def test_simulate_refuses_what_cannot_be(run, tmp_path):
    full = tmp_path / "full"
    full.mkdir()
    (full / "notes.txt").write_text("mine")
    for out, words, refusal, told in (
        (full, ("--views", 1), OutputError, "a new or an empty folder"),
        (tmp_path / "x", ("--category", "cat"), InputError, "cat"),
        (tmp_path / "x", ("--set", "captures.simulate.print_scale=3"), InputError, "print_scale"),
        (tmp_path / "x", ("--set", "captures.simulate.fog=1"), InputError, "fog"),
    ):
        code, _, err, _ = run("simulate", "--out", out, *SMALL, *words)
        assert code == refusal.exit_code and told in err and not (tmp_path / "x").exists()
    assert [file.name for file in full.iterdir()] == ["notes.txt"]


def test_import_writes_a_capture_and_tells_what_is_lost(run, tmp_path):
    saved, out, board = tmp_path / "Mug on table.mkv", tmp_path / "my mug", tmp_path / "board.json"
    data = recording(3)
    saved.write_bytes(data)
    code, told, _, answer = run("import", saved, "--out", out, "--frames", 2, "--category", "mug", "--json")
    assert code == 0 and "default board (7 x 5 markers, DICT_4X4_50)" in told
    assert (answer["frames"], len(answer["views"]), answer["notes"], answer["default_board"]) == (3, 2, [], True)
    folder = open_folder(out)
    assert (folder.about.name, folder.about.category, folder.numbers) == ("my_mug", "mug", (0, 1))
    saved.write_bytes(data[: int(len(data) * 0.7)])
    board.write_text('{"measured_ruler_m": 0.1987}')
    words = ("--out", tmp_path / "c", "--board", board, "--name", "mug-1", "--json")
    code, told, _, answer = run("import", saved, *words)
    assert code == 0 and "default board" not in told and len(answer["views"]) == 2
    assert answer["losses"]["cut"] == 1 and "about 1 frames are lost" in answer["notes"][0]
    folder = open_folder(tmp_path / "c")
    assert folder.board.measured_ruler_m == 0.1987 and folder.about.name == "mug-1"


def test_import_refuses_what_cannot_be_used_and_leaves_no_capture(run, tmp_path):
    full, saved, short = tmp_path / "full", tmp_path / "r.mkv", tmp_path / "short.mkv"
    full.mkdir()
    (full / "notes.txt").write_text("mine")
    saved.write_bytes(recording(1))
    short.write_bytes(recording(1)[:500])
    for words, refusal, told in (
        ((tmp_path / "none.mkv", "--out", tmp_path / "x"), InputError, "no such file"),
        ((saved, "--out", full), OutputError, "is not empty"),
        ((saved, "--out", saved), OutputError, "cannot be made"),
        ((saved, "--out", tmp_path / "x", "--category", "a mug"), InputError, "--category 'a mug'"),
        ((short, "--out", tmp_path / "x"), CaptureError, "copy it again"),
    ):
        code, _, err, _ = run("import", *words)
        assert code == refusal.exit_code and told in err
    assert [path.name for path in full.iterdir()] == ["notes.txt"]
    assert not (tmp_path / "x").exists() or not list((tmp_path / "x").iterdir())


@pytest.mark.minute
def test_process_writes_results_by_the_estimate_that_is_asked_for(run, tmp_path):
    path = copy_of(box(), tmp_path)
    quick = ("--set", "captures.fusion.voxel_m=0.003", "--json")
    _, out, _, answer = run("process", path, *quick)
    assert answer["ok"] and answer["estimate"] == "joint" and answer["views"] == VIEWS and answer["points"] > 1000
    assert [line.split()[0] for line in out.splitlines()[:3]] == ["markers", "article", "joint"]
    record = json.loads((path / "process.json").read_bytes())
    assert record["settings"]["fusion"]["voxel_m"] == 0.003 and answer["seconds"] == record["seconds"]
    assert run("process", path, "--estimate", "markers", *quick)[3]["estimate"] == "markers"
    code, _, err, _ = run("process", tmp_path / "nowhere")
    assert code == 2 and "there is no such folder" in err


@pytest.mark.minute
def test_synthesize_makes_a_view_from_a_pose_file_or_mirror_views(run, tmp_path):
    path = copy_of(processed()[0], tmp_path)
    code, _, _, answer = run("synthesize", path, "--pose", path / "board_00003.txt", "--out", tmp_path / "v", "--json")
    assert code == 0 and answer["ok"] and len(answer["views"]) == 1 and answer["views"][0]["sources"][0] == 3
    assert (tmp_path / "v" / "depth_00000.png").is_file()
    code, out, _, _ = run("synthesize", path, "--mirror")  # below the capture by default
    assert code == 0 and f"{VIEWS} views" in out and len(list((path / "views").glob("rgb_*.png"))) == VIEWS
    code, _, err, _ = run("synthesize", path, "--pose", tmp_path / "no.txt")
    assert code == 2 and "T_board_cam" in err
    code, _, err, _ = run("synthesize", box(), "--mirror", "--out", tmp_path / "w")
    assert code != 0 and "verso capture process" in err


@pytest.mark.minute
def test_evaluate_scores_a_simulated_capture_against_its_truth(run):
    code, _, _, answer = run("evaluate", processed()[0], "--json")
    keys = ("pose_mm", "pose_deg", "cloud_median_mm", "cloud_p95_mm", "completeness", "depth_median_mm")
    assert code == 0 and all(isinstance(answer[key], float) for key in keys) and answer["aligned_by"] is None
    assert answer["cloud_median_mm"] < 1.0 and answer["completeness"] > 0.9 and answer["pose_mm"] < 2.0
    assert len(answer["held_out"]) == 6


@pytest.mark.minute
def test_evaluate_aligns_a_given_mesh_first_and_says_so(run, tmp_path):
    path, given = copy_of(processed()[0], tmp_path), tmp_path / "given.ply"
    mesh = trimesh.load(path / "truth" / "mesh.glb", force="mesh", process=False)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(1.0, (0, 0, 1)))
    mesh.apply_translation((1, 2, 3))
    mesh.export(given)
    shutil.rmtree(path / "truth")
    code, out, _, answer = run("evaluate", path, "--mesh", given, "--json")
    assert code == 0 and "aligned to the cloud by ICP" in out and answer["aligned_by"] == "icp"
    assert answer["pose_mm"] is None and answer["cloud_median_mm"] < 1.0 and answer["completeness"] > 0.9
    code, _, err, _ = run("evaluate", path)
    assert code != 0 and "--mesh" in err
