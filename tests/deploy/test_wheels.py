"""The wheel that only reads: what it holds, that it is enough for reading and its pages, and that both are the same each time."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import numpy as np
import pytest

from deploy import wheels
from schemas.dataset.codec import read_matrix
from schemas.scene.shape import REGION_FIRST_OBJECT
from services.dataset.dataset import open_dataset
from tests.datasets import make_dataset
from tests.docs.test_pages import READERS, blocks
from tests.services.export.conftest import SHAPED, STUDIO, with_samples
from workers.store.images import encode_png

ROOT = Path(__file__).parents[2]
IMPORTED_AS = {"annotated-types": "annotated_types", "pillow": "PIL", "pyyaml": "yaml", "zlib-ng": "zlib_ng"}

HEAVY = {
    *(
        "ray",
        "pybullet",
        "OpenGL",
        "pyrender",
        "numba",
        "llvmlite",
        "manifold3d",
        "embreex",
        "av",
        "skimage",
        "shapely",
        "rtree",
    ),
    *("mapbox_earcut", "daqp", "reportlab", "rosbags", "prometheus_client", "networkx", "pyglet", "cv2"),
}
"""What only making needs."""


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    out = tmp_path_factory.mktemp("wheels")
    subprocess.run([sys.executable, "-P", "deploy/wheels.py", str(out)], cwd=ROOT, check=True)
    return out


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return make_dataset(tmp_path_factory.mktemp("made") / "out", scenes=2, objects_per_scene=3)[0].root


def test_reading_loads_what_the_wheel_names_and_nothing_that_makes_data():
    modules, others = wheels.reading_modules()
    named = tomllib.loads((ROOT / "pyproject.toml").read_text())["dependency-groups"]["reading"]
    names = {package.split(">")[0] for package in named}
    assert others == {IMPORTED_AS.get(name, name) for name in names}
    rooms = {".".join(name.split(".")[:2]) for name in modules}
    assert not rooms & {"workers.physics", "workers.render", "workers.capture", "workers.shard", "services.queue"}
    assert len(modules) < 117  # nine export formats are thirteen of them
    code = "import sys, verso; verso.open; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    ours = {name for name in loaded if name.split(".")[0] in wheels.OURS and wheels.file_of(name).name != "__init__.py"}
    assert ours <= modules.keys() and not {*HEAVY, "scipy", "trimesh", "duckdb", "obstore"} & set(loaded)


@pytest.fixture(scope="module")
def predictions(dataset, tmp_path_factory):
    """What is true of depth, colour and poses, as predictions."""
    folder = tmp_path_factory.mktemp("predictions")
    lines = ["scene_id,im_id,obj_id,R,t"]
    for kind in ("depth", "rgb"):
        (folder / kind).mkdir()
    for pair in open_dataset(str(dataset)).pairs():
        view = pair.mirror
        np.save(folder / "depth" / f"{view.pose_id}.npy", view.depth() / view.depth_units_per_m)
        (folder / "rgb" / f"{view.pose_id}.png").write_bytes(encode_png(view.rgb()))
        for region in (region for region in view.regions if region >= REGION_FIRST_OBJECT):
            T = read_matrix(view.regions[region]["T_cam_obj"])
            R, t = (" ".join(map(repr, part.ravel().tolist())) for part in (T[:3, :3], 1e3 * T[:3, 3]))
            lines.append(f"{pair.scene_id},{view.pose_id},{region},{R},{t}")
    (folder / "poses.csv").write_text("\n".join(lines))
    return folder


def check_score(answer: str) -> None:
    """The JSON line of a score of the truth."""
    told = json.loads(answer.splitlines()[-1])
    values = {name: figure["value"] for name, figure in told["metrics"].items()}
    assert (told["missing"], told["refused"]) == (0, 0), told
    assert values["depth_mae_m"] == 0.0 and values["rgb_ssim"] == 1.0 and values["pose_add_s_m"] < 1e-9, values


ALONE = f"""
import contextlib, io, json, sys
for name in {[*sorted(HEAVY), *wheels.OURS]}:
    sys.modules[name] = None  # as if it were not installed
from verso.services.cli.main import main
ends = []
for words in json.loads(sys.argv[1]):
    out, err = io.TextIOWrapper(io.BytesIO()), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(words)
    out.flush()
    ends.append([code, out.buffer.getvalue().decode(), err.getvalue()])
print(json.dumps(ends))
"""


def read(site: Path, *commands: list[str]) -> list[tuple[int, str, str]]:
    """(exit code, standard output, standard error) of commands of the unpacked wheel, one after another in one process.

    What only making needs cannot be imported there.
    """
    command = [sys.executable, "-P", "-c", ALONE, json.dumps(commands)]
    environ = {**os.environ, "PYTHONPATH": str(site)}
    done = subprocess.run(command, env=environ, stdout=subprocess.PIPE, text=True, check=True)
    return [(code, out, err) for code, out, err in json.loads(done.stdout)]


@pytest.fixture(scope="module")
def site(built, tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    (wheel,) = built.glob("verso_read-*.whl")
    with zipfile.ZipFile(wheel) as packed:
        assert {name.split("/")[0] for name in packed.namelist()} == {"verso", "verso_read-0.1.0.dist-info"}
        packed.extractall(folder)
    return folder


@pytest.mark.minute
def test_every_command_of_reading_works_from_the_wheel_and_the_others_say_what_to_install(
    site, dataset, predictions, tmp_path
):
    out = str(dataset)
    commands = [["status", out], ["columns"], ["query", out, "select count(*) from scenes"], ["verify", out]]
    commands += [["export", out, str(tmp_path / name), "--format", name] for name in ("bop", "gltf", "huggingface")]
    commands += [["export", out, str(tmp_path / name), "--format", name] for name in ("mirror-recon", "webdataset")]
    commands += [["report", out, "--out", str(tmp_path / "page.html")]]
    commands += [
        ["score", "check", out, str(predictions)],
        ["score", out, str(predictions), "--out", str(tmp_path / "score"), "--json"],
        ["score", "merge", out, str(tmp_path / "score"), "--out", str(tmp_path / "leaderboard")],
        ["verify", out, "--json"],
    ]
    refused = [["run", str(ROOT / "deploy/jobs/tabletop.yaml")], ["replay", out, "0"]]
    (tmp_path / "shapes" / "shape").mkdir(parents=True)
    (tmp_path / "shapes" / "shape" / "1.ply").touch()
    refused += [["doctor"], ["verify", out, "--audit", "1"], ["score", out, str(tmp_path / "shapes")]]
    ends = read(site, *commands, *refused)
    assert [code for code, *_ in ends] == [0] * len(commands) + [1] * len(refused), ends
    check_score(ends[len(commands) - 3][1])
    told = ends[len(commands) - 1][1]
    assert json.loads(told.splitlines()[-1])["pairs"] == 0 and "deriving labels again needs what makes data" in told
    assert all("install verso-data" in err for _, _, err in ends[len(commands) :]), ends


# ------------------------------------------------------------------------------------------------ pages as typed

PACKAGES = {"reader": ("verso_read", "verso.services"), "data": ("verso_data", "services")}
"""By installation the wheel, and the package of the command line."""


def environment_of(installation: str, built: Path, folder: Path) -> dict[str, str]:
    """The variables of a shell in which an installation's `python` and `verso` are the first ones on the path."""
    (wheel, services), site, programs = PACKAGES[installation], folder / "site", folder / "bin"
    with zipfile.ZipFile(next(built.glob(f"{wheel}-*.whl"))) as packed:
        packed.extractall(site)
    missing = [*sorted(HEAVY), *wheels.OURS] if installation == "reader" else []
    (site / "sitecustomize.py").write_text(f"import sys\nsys.modules.update(dict.fromkeys({missing}))\n")
    programs.mkdir()
    start = f"import sys; from {services}.cli.main import main; sys.exit(main())"
    for name, words in {"python": sys.executable, "verso": f"{sys.executable} -P -c '{start}'"}.items():
        (programs / name).write_text(f'#!/bin/sh\nexec {words} "$@"\n')
        (programs / name).chmod(0o755)
    places = {"PATH": f"{programs}:{os.environ['PATH']}", "PYTHONPATH": str(site), "HF_HOME": str(folder / "hf")}
    return {**os.environ, **places, "HF_HUB_OFFLINE": "1"}


@pytest.mark.minute
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("page", "installation"),
    [*((page, "reader") for page in READERS), pytest.param("docs/reading.md", "data", marks=pytest.mark.slow)],
)
def test_blocks_of_pages_run_as_typed_from_a_wheel_outside_of_any_checkout(page, installation, built, tmp_path):
    """Python's blocks in one process."""
    if installation == "reader":
        make_dataset(tmp_path / "data/tabletop", scenes=6, categories=["mug", "can"])
    if page == "docs/export.md":
        with_samples(make_dataset(tmp_path / "data/targets", **SHAPED)[0])
        make_dataset(tmp_path / "data/studio", **STUDIO)
    typed = [(language, text) for language, where, text in blocks(page) if where == installation and language]
    python = "\n".join(text for language, text in typed if language == "python")
    environ = environment_of(installation, built, tmp_path)
    sessions = [["bash", "-ec", text] for language, text in typed if language == "sh"]
    for command in (*sessions, ["python", "-W", "ignore", "-c", python]):
        done = subprocess.run(command, cwd=tmp_path, env=environ, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, f"{page}\n{command[-1]}\n{done.stderr[-2000:]}"
    assert len(typed) == 1 if installation == "data" else len(typed) >= 4


@pytest.mark.minute
def test_both_wheels_are_the_same_bytes_from_the_same_source(built, tmp_path):
    subprocess.run([sys.executable, "-P", "deploy/wheels.py", str(tmp_path)], cwd=ROOT, check=True)
    first, second = ({path.name: path.read_bytes() for path in folder.glob("*.whl")} for folder in (built, tmp_path))
    assert len(first) == 2 and first == second


PYTHON = """
import json, sys, time
began = time.process_time()
import verso
pair = next(iter(verso.open(sys.argv[1]).pairs()))
made = {"shape": pair.input.rgb().shape, "watertight": pair.mesh(welded=True).is_watertight}
made["pairs"] = [len(points) for points in pair.partial_and_complete(8)] + [pair.correspondence().visible.ndim]
try:
    verso.make_scene({}, 0)
except verso.VersoError as error:
    made["told"] = str(error)
print(json.dumps(made))
"""


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("version", ["3.10", "3.12", "3.13"])
def test_the_wheel_installs_and_reads_on(version, built, dataset, predictions, tmp_path):
    python = find_python(version)
    if python is None:
        pytest.skip(f"no Python {version} is installed")
    subprocess.run([python, "-m", "venv", str(tmp_path / "env")], check=True)
    own, (wheel,) = tmp_path / "env/bin", built.glob("verso_read-*.whl")
    subprocess.run([str(own / "pip"), "install", "-q", str(wheel)], check=True)
    for words in (["verify", str(dataset)], ["export", str(dataset), str(tmp_path / "bop"), "--format", "bop"]):
        subprocess.run([str(own / "verso"), *words], check=True, cwd=tmp_path)
    words = ["score", str(dataset), str(predictions), "--out", str(tmp_path / "score"), "--json"]
    scored = subprocess.run([str(own / "verso"), *words], check=True, cwd=tmp_path, capture_output=True, text=True)
    check_score(scored.stdout)
    ended = subprocess.run(
        [str(own / "python"), "-c", PYTHON, str(dataset)], capture_output=True, text=True, cwd=tmp_path
    )
    found = json.loads(ended.stdout)
    assert found["pairs"] == [8, 8, 2] and found["watertight"] and len(found["shape"]) == 3, ended.stderr
    assert "verso-data" in found["told"], ended.stderr


def find_python(version: str) -> str | None:
    """An interpreter of this version on the path, or among pyenv's."""
    asks = f"import sys; sys.exit('{version}' != '%d.%d' % sys.version_info[:2])"
    places = [shutil.which(f"python{version}"), *sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))]
    found = (str(one) for one in places if one)
    return next((one for one in found if subprocess.run([one, "-c", asks], capture_output=True).returncode == 0), None)
