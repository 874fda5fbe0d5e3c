"""Recordings of other cameras, written here byte by byte from their published layouts: every frame, time and camera read back."""

import bz2
import contextlib
import io
import json
import resource
import shutil
import struct
import zipfile

import cv2
import lzfse
import numpy as np
import pytest
import rosbags.rosbag1.writer
import rosbags.rosbag2.storage_mcap
from backports import zstd
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from schemas.capture import DepthCamera
from schemas.errors import CaptureError
from schemas.job.captures import Board
from tests.kit.tiers import first_of
from tests.workers.door.oracles import write
from tests.workers.door.recordings import recording
from workers.capture.folder import CaptureFile, open_folder, read_view
from workers.capture.import_recording import import_recording
from workers.door.recordings.formats import open_any
from workers.door.recordings.pictures import PictureError

W, H, COUNT = 64, 48, 3
RNG = np.random.default_rng(5)
SMOOTH = [
    cv2.resize(RNG.integers(0, 256, (6, 8, 3), np.uint8), (W, H), interpolation=cv2.INTER_CUBIC) for _ in range(COUNT)
]
JPEG_CODES = 6
"""What JPEG of quality 100 changes at most of these: it rounds brightness and colour, and all their waves."""
DEPTH_MM = [RNG.integers(500, 3000, (H, W)).astype(np.uint16) * (RNG.random((H, W)) > 0.2) for _ in range(COUNT)]
STAMPS_US = [1_305_031_452_791_720 + i * 33_333 for i in range(COUNT)]
FX, FY, CX, CY = 61.5, 62.25, 30.5, 22.75


def png(pixels):
    return cv2.imencode(".png", pixels[..., ::-1] if pixels.ndim == 3 else pixels)[1].tobytes()


def jpg(pixels):
    return cv2.imencode(
        ".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
    )[1].tobytes()


# ---------------------------------------------------------------------------------------------- what is written


TUM_STEP = 10
"""TUM's cameras have images of 640 x 480."""


def write_tum(path, units_per_mm=5):
    path = path / "rgbd_dataset_freiburg3_desk"
    for kind, late_us in (("rgb", 0), ("depth", 7_000)):
        stamps = [t + late_us for t in STAMPS_US]
        lines = [f"# {kind} images", *(f"{t / 1e6:.6f} {kind}/{t / 1e6:.6f}.png" for t in stamps)]
        write(path / f"{kind}.txt", "\n".join(lines) + "\n")
        for n, t in enumerate(stamps):
            pixels = SMOOTH[n] if kind == "rgb" else DEPTH_MM[n] * units_per_mm
            write(path / kind / f"{t / 1e6:.6f}.png", png(pixels.repeat(TUM_STEP, axis=0).repeat(TUM_STEP, axis=1)))
    return path


def write_bop(path):
    cameras = {}
    for n in range(COUNT):
        cameras[str(n)] = {"cam_K": [FX + n, 0, CX, 0, FY + n, CY, 0, 0, 1], "depth_scale": 0.1}
        write(path / "rgb" / f"{n:06d}.png", png(SMOOTH[n]))
        write(path / "depth" / f"{n:06d}.png", png(DEPTH_MM[n] * 10))
    write(path / "scene_camera.json", json.dumps(cameras))
    return path


def write_open3d(path):
    write(
        path / "intrinsic.json",
        json.dumps({"width": W, "height": H, "intrinsic_matrix": [FX, 0, 0, 0, FY, 0, CX, CY, 1]}),
    )
    for n in range(COUNT):
        write(path / "color" / f"{n:05d}.jpg", jpg(SMOOTH[n]))
        write(path / "depth" / f"{n:05d}.png", png(DEPTH_MM[n]))
    return path


DW, DH = 16, 12
SMALL_M = [(0.5 + RNG.random((DH, DW))).astype(np.float32) for _ in range(COUNT)]


def write_record3d(path, **changes):
    own = [[FX + n, FY + n, CX, CY] for n in range(COUNT)]
    metadata = {"w": W, "h": H, "dw": DW, "dh": DH, "fps": 30, "K": [FX, 0, 0, 0, FY, 0, CX, CY, 1]}
    metadata |= {"perFrameIntrinsicCoeffs": own, "frameTimestamps": [n / 30 for n in range(COUNT)]} | changes
    path.mkdir(exist_ok=True)
    with zipfile.ZipFile(path / "shot.r3d", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", json.dumps(metadata))
        for n in range(COUNT):
            archive.writestr(f"rgbd/{n}.jpg", jpg(SMOOTH[n]))
            archive.writestr(f"rgbd/{n}.depth", lzfse.compress(SMALL_M[n].tobytes()))
    return path / "shot.r3d"


def write_polycam(path):
    for n in range(COUNT):
        camera = {"fx": FX + n, "fy": FY + n, "cx": CX, "cy": CY, "width": W, "height": H, "t_00": 1, "blur_score": 90}
        write(path / "keyframes" / "cameras" / f"{638443502 + n * 33_333}.json", json.dumps(camera))
        write(path / "keyframes" / "images" / f"{638443502 + n * 33_333}.jpg", jpg(SMOOTH[n]))
        small = np.rint(SMALL_M[n] * 1000).astype(np.uint16)
        write(path / "keyframes" / "depth" / f"{638443502 + n * 33_333}.png", png(small))
    return path


def write_arkit(path):
    for n in range(COUNT):
        name, near = f"41069021_{305.377 + n / 30:.3f}", f"41069021_{305.376 + n / 30:.3f}"
        write(path / "lowres_wide" / f"{name}.png", png(SMOOTH[n]))
        write(path / "lowres_depth" / f"{name}.png", png(DEPTH_MM[n]))
        write(path / "lowres_wide_intrinsics" / f"{near}.pincam", f"{W} {H} {FX + n} {FY + n} {CX} {CY}")
    return path


# ---------------------------------------------------------------------------------------------- a bag

T_COLOR_REF = np.eye(4)
T_COLOR_REF[:3, 3] = [0.015, 0.001, -0.002]


def block(data):
    data = data.encode() if isinstance(data, str) else data
    return struct.pack("<I", len(data)) + data


def stamp(us):
    return struct.pack("<II", us // 1_000_000, us % 1_000_000 * 1000)


def header(us, frame="camera"):
    return struct.pack("<I", 0) + stamp(us) + block(frame)


def image(us, encoding, pixels, frame="camera"):
    height, width = pixels.shape[:2]
    body = struct.pack("<II", height, width) + block(encoding)
    return (
        header(us, frame)
        + body
        + struct.pack("<BI", 0, pixels.strides[0])
        + block(np.ascontiguousarray(pixels).tobytes())
    )


def info(width, height, lens=(0.0,) * 5, model="Brown Conrady", k=(FX, FY, CX, CY), rectified=None):
    D, p = struct.pack(f"<I{len(lens)}d", len(lens), *lens), rectified or k
    return (
        header(0)
        + struct.pack("<II", height, width)
        + block(model)
        + D
        + struct.pack("<9d", k[0], 0, k[2], 0, k[1], k[3], 0, 0, 1)
        + struct.pack("<9d", *range(9))  # R
        + struct.pack("<12d", p[0], 0, p[2], 0, 0, p[1], p[3], 0, 0, 0, 1, 0)
        + struct.pack("<6IB", *range(6), 0)  # binning and the region of interest
    )


def transform_message(T):
    return struct.pack("<7d", *T[:3, 3], 0.0, 0.0, 0.0, 1.0)


COLOR, DEPTH = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"
INFO, IMAGE, COMPRESSED = (f"sensor_msgs/msg/{name}" for name in ("CameraInfo", "Image", "CompressedImage"))
VIDEO = "theora_image_transport/msg/Packet"


def realsense(lens=(0.0,) * 5, model="Brown Conrady"):
    """(topic, type, time, message) of an SDK's recording: depth in units of a tenth of a millimetre."""
    pictures = [(t, mm * 10, rgb) for t, mm, rgb in zip(STAMPS_US, DEPTH_MM, SMOOTH, strict=True)]
    return recorded(pictures, 0.0001, T_COLOR_REF, lens=lens, model=model)


def recorded(pictures, unit_m, T_color_ref, **camera):
    """The messages of an SDK's recording of (time, depth [H, W], RGB [H, W, 3]); `camera`: what `info` takes, of colour."""
    height, width = pictures[0][1].shape
    k = {"k": camera["k"]} if "k" in camera else {}
    said = [
        ("/device_0/sensor_0/option/Depth Units/value", "std_msgs/msg/Float32", 0, struct.pack("<f", unit_m)),
        (f"{COLOR}/info/camera_info", INFO, 0, info(width, height, **camera)),
        (f"{DEPTH}/info/camera_info", INFO, 0, info(width, height, **k)),
        (f"{DEPTH}/tf/0", "geometry_msgs/msg/Transform", 0, transform_message(np.eye(4))),
        (f"{COLOR}/tf/0", "geometry_msgs/msg/Transform", 0, transform_message(T_color_ref)),
    ]
    for t, depth, rgb in pictures:
        said.append((f"{DEPTH}/image/data", IMAGE, t, image(t, "mono16", depth)))
        said.append((f"{COLOR}/image/data", IMAGE, t + 900, image(t + 900, "rgb8", rgb)))
    return said


def write_bag(path, said=None, compression="lz4", kind="bag"):
    """A bag of messages as ROS 1 has them; of ROS 2, `kind` mcap or db3, the folder that holds it."""
    path.mkdir(parents=True, exist_ok=True)
    for old in (path / "shot.bag", path / "shot"):
        shutil.rmtree(old) if old.is_dir() else old.unlink(missing_ok=True)
    ros1, ros2 = (get_typestore(store) for store in (Stores.ROS1_NOETIC, Stores.ROS2_HUMBLE))
    for store in (ros1, ros2):
        store.register(get_types_from_msg("std_msgs/Header header\nuint8[] data\n", VIDEO))
    if kind == "bag":
        writer = Writer1(path / "shot.bag")
        if compression != "none":
            writer.set_compression(Writer1.CompressionFormat[compression.upper()])
        writer.chunk_threshold = 3 * W * H
    else:
        writer = Writer2(path / "shot", version=9, storage_plugin=StoragePlugin[{"db3": "SQLITE3"}.get(kind, "MCAP")])
        if compression in ("zstd", "message"):
            mode = CompressionMode.STORAGE if compression == "zstd" else CompressionMode.MESSAGE
            writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        topics = {}
        for topic, name, us, data in realsense() if said is None else said:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, name, typestore=ros1 if kind == "bag" else ros2)
            writer.write(topics[topic], 1000 * us, data if kind == "bag" else ros2.ros1_to_cdr(data, name))
    return writer.path


def write_realsense(capture, path):
    """The photographs of a capture's folder as a RealSense's recording, its depth camera where the colour camera is."""
    camera = json.loads((capture / "camera.json").read_text())
    pictures = []
    for n, rgb in enumerate(sorted(capture.glob("rgb_*.png"))):
        depth = cv2.imread(str(rgb).replace("rgb_", "depth_"), cv2.IMREAD_UNCHANGED)
        pictures.append((1_000_000 + 33_333 * n, depth, cv2.cvtColor(cv2.imread(str(rgb)), cv2.COLOR_BGR2RGB)))
    k = tuple(camera[name] for name in ("fx", "fy", "cx", "cy"))
    said = recorded(pictures, 1.0 / camera["depth_units_per_m"], np.eye(4), k=k)
    write_bag(path.parent, said).rename(path)


WRITTEN = {
    "tum": write_tum,
    "bop": write_bop,
    "open3d": write_open3d,
    "record3d": write_record3d,
    "polycam": write_polycam,
    "arkit": write_arkit,
    "bag": write_bag,
    "db3": lambda path: write_bag(path, kind="db3"),
    "mcap": lambda path: write_bag(path, kind="mcap"),
}
BAGS = ("bag", "db3", "mcap")


# ---------------------------------------------------------------------------------------------- what is read


def frames_of(recording):
    found = list(recording.frames())
    return [f for f in found if not f.is_depth], [f for f in found if f.is_depth]


def k_of(frame, recording):
    k = frame.camera or recording.color.intrinsics
    return [k.fx, k.fy, k.cx, k.cy]


@pytest.mark.parametrize("kind", WRITTEN)
def test_every_frame_time_and_camera_is_what_was_written(kind, tmp_path):
    recording = open_any(WRITTEN[kind](tmp_path))
    color, depth = frames_of(recording)
    apple = kind in ("record3d", "polycam", "arkit")  # whose principal point counts from the image's corner
    own = [0, 1, 2] if kind in ("bop", "record3d", "polycam", "arkit") else [0] * COUNT
    written = (535.4, 539.2, 320.1, 247.6) if kind == "tum" else (FX, FY, CX, CY)
    first_us = {
        "tum": STAMPS_US[0],
        **dict.fromkeys(BAGS, STAMPS_US[0] + 900),
        "polycam": 638443502,
        "arkit": 305_377_000,
    }.get(kind, 0)
    assert len(color) == len(depth) == COUNT
    step = TUM_STEP if kind == "tum" else 1
    for n, (rgb, z) in enumerate(zip(color, depth, strict=True)):
        assert rgb.stamp_us == pytest.approx(first_us + n * 33_333, abs=1 + 500 * (kind == "arkit"))
        late = {"tum": 7_000, **dict.fromkeys(BAGS, -900)}.get(kind, 0)
        assert z.stamp_us - rgb.stamp_us == late
        centre = 0.0 if apple else 0.5
        fx, fy, cx, cy = written
        expected = [fx + own[n], fy + own[n], cx + centre, cy + centre]
        assert k_of(rgb, recording) == pytest.approx(expected)
        seen = rgb.load(False)[::step, ::step]
        loss = 0 if kind in ("tum", "bop", "arkit", *BAGS) else JPEG_CODES
        assert seen.shape == (H, W, 3) and np.abs(seen.astype(int) - SMOOTH[n]).max() <= loss
        assert rgb.load(True).shape == (step * H // 2, step * W // 2)
        small = kind in ("record3d", "polycam")
        true = SMALL_M[n] if small else DEPTH_MM[n] / 1000
        assert z.load(False)[::step, ::step] == pytest.approx(true, abs=5.1e-4 if kind == "polycam" else 1e-7)
        if small:
            assert isinstance(z.camera, DepthCamera) and np.array_equal(z.camera.T_color_depth, np.eye(4))
            k = z.camera.intrinsics
            assert [k.width, k.height, k.fx, k.cx, k.cy] == pytest.approx([DW, DH, (FX + n) / 4, CX / 4, CY / 4])
    assert recording.period_us == pytest.approx(33_333, abs=700)
    assert recording.color.intrinsics.fx == pytest.approx(written[0] + sorted(own)[COUNT // 2])
    if kind in BAGS:
        assert recording.color.depth_units_per_m == pytest.approx(10_000)
        # The transforms take the reference's coordinates to a stream's, so this one takes depth's to colour's.
        assert recording.depth.T_color_depth == pytest.approx(T_COLOR_REF)


@pytest.mark.parametrize("kind", WRITTEN)
def test_a_recording_of_any_kind_becomes_a_folder(kind, tmp_path):
    made, folder = imported(WRITTEN[kind](tmp_path / "from"), tmp_path / "capture")
    assert len(made.views) == made.frames == COUNT and folder.numbers == (0, 1, 2)
    assert (made.losses.dropped, made.losses.without_depth, made.losses.damaged, made.losses.cut) == (0, 0, 0, 0)
    for n in range(COUNT):
        view = read_view(folder, n)
        units = folder.camera.depth_units_per_m
        assert view.depth.any() and 0.4 < np.median(view.depth[view.depth > 0]) / units < 3.0
        if kind == "open3d" or (kind in ("bop", "arkit") and n == 1):  # the camera of the middle focal length
            assert view.depth / units == pytest.approx(DEPTH_MM[n] / 1000, abs=1e-7)
            assert np.abs(view.rgb.astype(int) - SMOOTH[n]).max() <= JPEG_CODES


def imported(path, out, camera=None, **changes):
    """The folder made of a recording, with a camera.json of pictures of W x H where `changes` say how it differs."""
    out.mkdir()
    if changes:
        camera = out.parent / f"{out.name}.json"
        spec = {"width": W, "height": H, "fx": FX, "fy": FY, "cx": CX, "cy": CY, "pixel_centre": "0"} | changes
        write(camera, json.dumps(spec))
    made = import_recording(path, out, CaptureFile(name="x"), Board(), 9, camera)
    return made, open_folder(out)


LENS = [0.1, -0.2, 1e-3, 2e-3, 0.05, 0.01, 0.02, 0.03, 1e-3, 1e-3, 1e-3, 1e-3]


@pytest.mark.parametrize("kind", WRITTEN)
def test_the_camera_of_a_file_takes_the_place_of_what_any_recording_says(kind, tmp_path):
    size = {"width": 640, "height": 480} if kind == "tum" else {}
    path = WRITTEN[kind](tmp_path / "from")
    made, folder = imported(path, tmp_path / "c", **size, fx=70.0, cx=31.0, distortion=LENS[:8])
    assert (folder.stored.fx, folder.stored.cx, folder.stored.distortion) == (70.0, 31.0, LENS[:8])
    assert made.calibration == str(tmp_path / "c.json")
    for number in range(COUNT):  # as it is stored: neither scaled nor moved nor without its lens
        seen = read_view(folder, number).rgb[:: TUM_STEP if kind == "tum" else 1, :: TUM_STEP if kind == "tum" else 1]
        assert np.abs(seen.astype(int) - SMOOTH[number]).max() <= JPEG_CODES
    refusal = "describe depth_camera" if kind in ("record3d", "polycam", *BAGS) else None
    with pytest.raises(CaptureError, match=refusal) if refusal else contextlib.nullcontext():
        _, folder = imported(path, tmp_path / "d", **size, distortion=LENS)
        assert folder.stored.distortion == LENS
    with pytest.raises(CaptureError, match=r"its pictures are .* and .*e.json says 65 x 48"):
        imported(path, tmp_path / "e", width=65)


@pytest.mark.parametrize("kind", ["record3d", "polycam"])
def test_depth_of_a_phone_is_seen_by_the_camera_of_the_file(kind, tmp_path):
    """The recording's own numbers in a file give what the recording gives."""
    path = WRITTEN[kind](tmp_path / "from")
    keys, expected = (
        {"fx": FX + 1, "fy": FY + 1, "pixel_centre": "0.5"},
        read_view(imported(path, tmp_path / "a")[1], 1),
    )
    assert np.array_equal(read_view(imported(path, tmp_path / "b", **keys)[1], 1).depth, expected.depth)
    small = {"width": DW, "height": DH, "fx": (FX + 1) / 4, "fy": (FY + 1) / 4, "cx": CX / 4, "cy": CY / 4}
    described = imported(path, tmp_path / "c", **keys, depth_camera={**small, "T_color_depth": np.eye(4).tolist()})[1]
    assert np.abs(read_view(described, 1).depth.astype(int) - expected.depth).max() <= 1  # rounded before, not after


def test_a_folder_without_a_camera_asks_for_one_and_takes_no_one_elses(tmp_path):
    own = write_tum(tmp_path / "from").rename(tmp_path / "mine")
    for name, more in (
        ("mine", "it has its camera"),
        ("freiburg1_mine", "TUM's freiburg1 has images of 640 x 480, not"),
    ):
        path = tmp_path / name
        own.rename(path)
        own = path
        for file in path.glob("*/*.png"):
            write(file, png(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[:240]))
        with pytest.raises(CaptureError, match=more) as error:
            imported(path, tmp_path / f"no {name}")
        assert "--camera" in str(error.value) and "rename" not in str(error.value)
    write(
        own / "camera.json",
        json.dumps({"width": 640, "height": 240, "fx": 500, "fy": 500, "cx": 320, "cy": 120, "pixel_centre": "0"}),
    )
    made, folder = imported(own, tmp_path / "beside")
    assert folder.camera.intrinsics.fx == 500.0 and made.calibration == str(own / "camera.json")
    assert folder.camera.depth_units_per_m == 5000 and "taken for 5000 units" in made.notes[0]
    made, folder = imported(own, tmp_path / "units", width=640, height=240, depth_units_per_m=1000)
    assert (
        not made.notes
        and read_view(folder, 0).depth.max() / folder.camera.depth_units_per_m == DEPTH_MM[0][:24].max() / 200
    )
    bare = write_open3d(tmp_path / "bare")
    (bare / "intrinsic.json").unlink()
    with pytest.raises(CaptureError, match=r"it has no intrinsic\.json: describe it in a camera\.json"):
        imported(bare, tmp_path / "no bare")
    assert imported(bare, tmp_path / "bare_own", fx=66.0)[1].camera.intrinsics.fx == 66.0


def test_frames_that_are_numbered_without_zeros_are_in_the_order_of_their_numbers(tmp_path):
    path = write_open3d(tmp_path)
    for folder, end in (("color", "jpg"), ("depth", "png")):
        for n, to in ((2, 10), (1, 9), (0, 1)):
            (path / folder / f"{n:05d}.{end}").rename(path / folder / f"{to}.{end}")
        write(path / folder / ".DS_Store", b"Bud1")
    color, depth = frames_of(open_any(path))
    for n in range(COUNT):
        assert np.abs(color[n].load(False).astype(int) - SMOOTH[n]).max() <= JPEG_CODES
        assert depth[n].load(False) == pytest.approx(DEPTH_MM[n] / 1000)


def test_folders_of_other_names_and_grey_pictures_are_read(tmp_path):
    path = write_open3d(tmp_path / "o")
    (path / "color").rename(path / "rgb")
    assert np.abs(frames_of(open_any(path))[0][2].load(False).astype(int) - SMOOTH[2]).max() <= JPEG_CODES
    write(path / "intrinsic.json", (path / "intrinsic.json").read_text().replace('"width": 64', '"width": 32'))
    with pytest.raises(CaptureError, match="is of 32 x 48, its images are 64 x 48: describe it in"):
        imported(path, tmp_path / "wrong")
    assert imported(path, tmp_path / "right", fx=66.0)[1].camera.intrinsics.fx == 66.0
    path = write_bop(tmp_path / "b")
    for file in sorted(path.glob("*/*.png")):
        folder, pixels = file.parent.name, cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        grey = pixels[..., 1] if folder == "rgb" else pixels
        write(path / {"rgb": "gray"}.get(folder, folder) / f"{file.stem}.tif", cv2.imencode(".tif", grey)[1].tobytes())
        file.unlink()
    color, depth = frames_of(open_any(path))
    assert np.array_equal(color[1].load(False), SMOOTH[1][..., 1:2].repeat(3, axis=2))
    assert depth[1].load(False) == pytest.approx(DEPTH_MM[1] / 1000)


@pytest.mark.parametrize("kind", ["record3d", "polycam", "arkit"])
def test_depth_of_the_lowest_confidence_is_none(kind, tmp_path):
    path = WRITTEN[kind](tmp_path)
    sure = [RNG.integers(0, 3, (DH, DW) if kind != "arkit" else (H, W)).astype(np.uint8) for _ in range(COUNT)]
    before = [frame.load(False) for frame in frames_of(open_any(path))[1]]
    if kind == "record3d":
        with zipfile.ZipFile(path, "a") as archive:
            for n in range(COUNT):
                archive.writestr(f"rgbd/{n}.conf", lzfse.compress(sure[n].tobytes()))
    else:
        for n, file in enumerate(sorted(path.rglob("*depth/*.png"))):
            levels = np.array([0, 127, 255] if kind == "polycam" else [0, 1, 2], np.uint8)
            write(file.parents[1] / "confidence" / file.name, png(levels[sure[n]]))
    for n, frame in enumerate(frames_of(open_any(path))[1]):
        assert np.array_equal(frame.load(False), np.where(sure[n] > 0, before[n], 0.0))


def test_a_focal_length_that_changes_is_made_one(tmp_path):
    """A picture of a plane, ramps of colour over the ray, is the same after another focal length is made the common one."""
    focal = (60.0, 63.0, 66.0)
    cameras = {}
    for n, f in enumerate(focal):
        x = (np.arange(W) - CX) / f
        ramp = np.repeat(np.clip(128 + 200 * x, 0, 255)[None, :], H, axis=0)
        write(tmp_path / "rgb" / f"{n:06d}.png", png(np.repeat(np.rint(ramp).astype(np.uint8)[..., None], 3, axis=2)))
        write(tmp_path / "depth" / f"{n:06d}.png", png(np.full((H, W), 1000, np.uint16)))
        cameras[str(n)] = {"cam_K": [f, 0, CX, 0, f, CY, 0, 0, 1], "depth_scale": 1.0}
    write(tmp_path / "scene_camera.json", json.dumps(cameras))
    _, folder = imported(tmp_path, tmp_path / "capture")
    views = [read_view(folder, n).rgb[5:-5, 5:-5, 0].astype(int) for n in range(3)]
    assert folder.camera.intrinsics.fx == 63.0
    assert np.abs(views[0] - views[1]).max() <= 1 and np.abs(views[2] - views[1]).max() <= 1


def test_bags_are_read_however_they_are_packed_and_a_file_of_ros_2_alone(tmp_path):
    packed = [write_bag(tmp_path / how, compression=how) for how in ("none", "bz2")]
    packed.append(write_bag(tmp_path / "zstd", compression="zstd", kind="mcap"))
    for kind in ("db3", "mcap"):
        file = write_bag(tmp_path / kind, kind=kind) / f"shot.{kind}"
        packed.append(file.rename(tmp_path / f"odd?mode=rw#%41.{kind}"))
    for path in packed:
        color, depth = frames_of(open_any(path))
        assert all(np.array_equal(frame.load(False), SMOOTH[n]) for n, frame in enumerate(color))
        assert len(color) == len(depth) == COUNT


T_DEPTH_REF = np.array([[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1.0]])


def as_texts(said):
    """What the SDK's ROS 2 recorder writes in place of a bag's messages of ROS 1: texts, of rotations column by column."""
    camera = f"width={W};height={H};fx={FX};ppx={CX};fy={FY};ppy={CY};model=Inverse Brown Conrady;coeffs=0.1,-0.2,0.01,0.02,0"

    def places(T):
        return f"rotation={','.join(map(str, T[:3, :3].T.ravel()))};translation={','.join(map(str, T[:3, 3]))}"

    texts = {"/device_0/sensor_0/option/Depth_Units/value": "0.000100", f"{COLOR}/image/metadata": "timestamp=1;;a"}
    for stream, T in ((COLOR, T_COLOR_REF), (DEPTH, T_DEPTH_REF)):
        texts |= {f"{stream}/camera_info": camera, f"{stream}/tf/ref_0": places(T)}
    images = [message for message in said if message[1] == IMAGE]
    return [(topic, "std_msgs/msg/String", 0, block(text)) for topic, text in texts.items()] + images


@pytest.mark.parametrize("compression", ["none", "message"])
def test_a_recording_of_the_sdk_for_ros_2_is_read(compression, tmp_path):
    path = write_bag(tmp_path, as_texts(realsense()), compression, kind="db3") / "shot.db3"
    recording = open_any(path)
    color, depth = frames_of(recording)
    assert [len(color), len(depth)] == [COUNT, COUNT] and k_of(color[0], recording) == [FX, FY, CX + 0.5, CY + 0.5]
    assert recording.color.lens.tolist() == [0.1, -0.2, 0.01, 0.02, 0, 0, 0, 0]
    assert recording.depth.T_color_depth == pytest.approx(T_COLOR_REF @ np.linalg.inv(T_DEPTH_REF))
    assert np.array_equal(color[1].load(False), SMOOTH[1]) and depth[2].load(False) == pytest.approx(DEPTH_MM[2] / 1000)
    path.rename(path.with_suffix(".db3.zstd"))
    refused(path.parent, "is compressed: unpack it")


@pytest.mark.parametrize("name", ["YUYV", "yuyv", "yuv422_yuy2", "yuv422", "UYVY", "uyvy", "bgr8", "rgba8"])
def test_colour_is_the_same_in_every_encoding_of_the_sdk_and_of_ros(name, tmp_path):
    codes = {"bgr8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGB2RGBA}
    packed = cv2.COLOR_RGB2YUV_YUY2 if "yuy" in name.lower() else cv2.COLOR_RGB2YUV_UYVY
    pixels = cv2.cvtColor(SMOOTH[0], codes.get(name, packed))
    said = [m if "Color" not in m[0] or m[1] != IMAGE else (*m[:3], image(0, name, pixels)) for m in realsense()]
    color, _ = frames_of(open_any(write_bag(tmp_path, said)))
    assert np.abs(color[0].load(False).astype(int) - SMOOTH[0]).mean() < (4 if name not in codes else 0.1)


def test_the_inverse_lens_of_a_realsense_is_where_its_sdk_projects_a_point(tmp_path):
    """The SDK's rs2_project_point_to_pixel, which scales before it adds the tangential part."""
    k1, k2, p1, p2, k3 = lens = (-0.0544, 0.0635, -0.0008, 0.0008, -0.0205)
    recording = open_any(write_bag(tmp_path, realsense(lens, "Inverse Brown Conrady")))
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-0.6, 0.6, 7)))
    r2 = x * x + y * y
    f = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    X, Y = x * f, y * f
    sdk = np.stack([X + 2 * p1 * X * Y + p2 * (r2 + 2 * X * X), Y + 2 * p2 * X * Y + p1 * (r2 + 2 * Y * Y)], axis=1)
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    seen = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), recording.color.lens)[0][:, 0]
    assert np.abs(seen - sdk).max() < 1e-4  # 0.06 pixels of a D455


BENT, P = (0.1, -0.2, 1e-3, 0, 0.05), (58.0, 58.5, 31.0, 23.0)


def published(streams, late_us=0):
    """Of a driver: images by topic, (encoding, pictures, frame), and the `camera_info` beside each; depth is stored later."""
    said = []
    for topic, (encoding, pictures, frame) in streams.items():
        k = (FX, FY, CX, CY) if "color" in frame else (50.0, 50.0, 30.0, 24.0)
        place = topic.rpartition("/")[0]
        said.append(
            (f"{place}/camera_info", INFO, 0, info(W, H, BENT, "plumb_bob", k, P if "color" in frame else None))
        )
        for n, t in enumerate(STAMPS_US):
            stored = t + late_us * ("depth" in topic)
            said.append((topic, IMAGE, stored, image(t, encoding, pictures[n], frame)))
    return sorted(said, key=lambda message: message[2])


BGR = [np.ascontiguousarray(rgb[..., ::-1]) for rgb in SMOOTH]
BGRA = [np.dstack([bgr, bgr[..., 0]]) for bgr in BGR]
OTHER = [255 - bgra for bgra in BGRA]
DEPTH_M = [(mm / 1000).astype(np.float32) for mm in DEPTH_MM]
DRIVERS = {
    "realsense": {
        "/camera/color/image_raw": ("bgr8", BGR, "color"),
        "/camera/depth/image_rect_raw": ("16UC1", DEPTH_MM[::-1], "depth"),
        "/camera/aligned_depth_to_color/image_raw": ("16UC1", DEPTH_MM, "aligned_to_color"),
        "/camera/infra1/image_rect_raw": ("mono8", DEPTH_MM, "depth"),
    },
    "azure": {
        "/ir/image_raw": ("mono16", DEPTH_MM[::-1], "depth"),
        "/depth/image_raw": ("16UC1", DEPTH_MM[::-1], "depth"),
        "/rgb_to_depth/image_raw": ("bgra8", OTHER, "depth"),
        "/depth_to_rgb/image_raw": ("32FC1", DEPTH_M, "color"),
        "/rgb/image_raw": ("bgra8", BGRA, "color"),
    },
    "two": {
        "/a/color/image_raw": ("bgr8", BGR, "a_color"),
        "/b/color/image_raw": ("bgra8", OTHER, "b_color"),
        "/b/aligned_depth_to_color/image_raw": ("16UC1", DEPTH_MM[::-1], "b_color"),
        "/a/aligned_depth_to_color/image_raw": ("16UC1", DEPTH_MM, "a_color"),
    },
}
"""Topics of the drivers realsense-ros and Azure_Kinect_ROS_Driver, and of two cameras of the first."""


@pytest.mark.parametrize("driver", DRIVERS)
def test_of_a_drivers_bag_colour_is_taken_with_the_depth_registered_to_it(driver, tmp_path):
    recording = open_any(write_bag(tmp_path, published(DRIVERS[driver])))
    color, depth = frames_of(recording)
    assert recording.depth is None and recording.color.lens.tolist() == [*BENT, 0, 0, 0]
    for n in range(COUNT):
        assert np.array_equal(color[n].load(False), SMOOTH[n])
        assert depth[n].load(False) == pytest.approx(DEPTH_MM[n] / 1000)
    assert ("/b/color/image_raw" in " ".join(recording.notes)) == (driver == "two")


def test_images_are_of_the_time_they_were_taken_not_stored(tmp_path):
    streams = {name: DRIVERS["realsense"][name] for name in list(DRIVERS["realsense"])[::2]}
    color, depth = frames_of(open_any(write_bag(tmp_path, published(streams, late_us=40_000))))
    assert [frame.stamp_us for frame in color] == [frame.stamp_us for frame in depth] == STAMPS_US
    said = realsense()  # of the SDK without a common clock: its images say nothing that joins them
    lost = [(*m[:3], image(m[2] - STAMPS_US[0], "mono16", DEPTH_MM[0])) if "Depth_0/image" in m[0] else m for m in said]
    color, depth = frames_of(open_any(write_bag(tmp_path, lost)))
    assert [frame.stamp_us - 900 for frame in color] == [frame.stamp_us for frame in depth] == STAMPS_US


def test_a_rectified_image_has_the_camera_of_its_projection_matrix_and_no_lens(tmp_path):
    streams = {
        "/camera/rgb/image_rect_color": ("bgr8", BGR, "color"),
        "/camera/depth_registered/hw_registered/image_rect": ("16UC1", DEPTH_MM, "color"),
    }
    recording = open_any(write_bag(tmp_path, published(streams)))
    assert recording.depth is None and not recording.color.has_lens
    assert k_of(frames_of(recording)[0][0], recording) == [P[0], P[1], P[2] + 0.5, P[3] + 0.5]
    raw = open_any(write_bag(tmp_path, published({"/camera/rgb/image_raw": ("bgr8", BGR, "color")} | streams)))
    assert not raw.color.has_lens, "depth is rectified as well"
    del streams["/camera/rgb/image_rect_color"]
    raw = open_any(write_bag(tmp_path, published({"/camera/rgb/image_raw": ("bgr8", BGR, "color")} | streams)))
    assert raw.color.has_lens and not raw.depth.lens.any() and raw.depth.intrinsics.fx == P[0]
    assert np.array_equal(raw.depth.T_color_depth, np.eye(4))


def compressed(us, form, data, frame):
    return header(us, frame) + block(form) + block(data)


QUANTA = 100.0 * 101.0
"""Codes by 1 / metre of compressed_depth_image_transport, as it is set unless it is told otherwise."""


def quantized(metres):
    """As compressed_depth_image_transport has depth of 32FC1 up to 10 m."""
    b = 1.0 - QUANTA / 10.0
    codes = np.where(metres > 0, QUANTA / np.maximum(metres, 0.1) + b, 0)
    return struct.pack("<iff", 0, QUANTA, b) + png(codes.astype(np.uint16))


BEFORE = struct.pack("<iff", -1, 0.0, 0.0)
PICTURES = {
    "jpeg": ("compressed", [("rgb8; jpeg compressed bgr8", jpg(rgb)) for rgb in SMOOTH]),
    "jpeg of a driver": ("compressed", [("jpeg", jpg(rgb)) for rgb in SMOOTH]),
    "png in the order of rgb": ("compressed", [("rgb8; png compressed rgb8", png(bgr)) for bgr in BGR]),
    "png": ("compressed", [("bgr8; png compressed bgr8", png(rgb)) for rgb in SMOOTH]),
}
DEPTH_CODES = {
    "16 bits": ("compressedDepth", [("16UC1; compressedDepth png", BEFORE + png(mm)) for mm in DEPTH_MM]),
    "16 bits of ROS 1": ("compressedDepth", [("16UC1; compressedDepth", BEFORE + png(mm)) for mm in DEPTH_MM]),
    "quantized": ("compressedDepth", [("32FC1; compressedDepth png", quantized(m)) for m in DEPTH_M]),
    "16 bits of old": ("compressedDepth", [("16UC1", BEFORE + png(mm)) for mm in DEPTH_MM]),
    "a picture": ("compressed", [("16UC1; png compressed ", png(mm)) for mm in DEPTH_MM]),
}


def transported(pictures, codes, also=()):
    """A bag of realsense-ros as `record --all` has it, with images that image_transport compressed."""
    said = published({name: DRIVERS["realsense"][name] for name in list(DRIVERS["realsense"])[::2]})
    for topic, (transport, images) in zip(list(DRIVERS["realsense"])[::2], (pictures, codes), strict=True):
        frame = DRIVERS["realsense"][topic][2]
        said = [message for message in said if message[0] != topic or topic in also]
        for us, (form, data) in zip(STAMPS_US, images, strict=True):
            said.append((f"{topic}/{transport}", COMPRESSED, us, compressed(us, form, data, frame)))
    return sorted(said, key=lambda message: message[2])


@pytest.mark.parametrize("codes", DEPTH_CODES)
@pytest.mark.parametrize("picture", PICTURES)
def test_images_that_image_transport_compressed_are_those_it_was_given(picture, codes, tmp_path):
    recording = open_any(write_bag(tmp_path, transported(PICTURES[picture], DEPTH_CODES[codes])))
    color, depth = frames_of(recording)
    assert recording.depth is None and [frame.stamp_us for frame in color + depth] == STAMPS_US * 2
    for n in range(COUNT):
        codes_off = np.abs(color[n].load(False).astype(int) - SMOOTH[n])
        assert codes_off.max() <= (0 if "png" in picture else JPEG_CODES)
        small = cv2.resize(cv2.cvtColor(SMOOTH[n], cv2.COLOR_RGB2GRAY), (W // 2, H // 2), interpolation=cv2.INTER_AREA)
        assert np.corrcoef(color[n].load(True).ravel(), small.ravel())[0, 1] > 0.8
        metres = DEPTH_MM[n] / 1000
        assert np.abs(depth[n].load(False) - metres).max() <= (metres**2 / QUANTA / 2 * 1.01).max() * (
            codes == "quantized"
        )


def test_of_an_image_in_several_ways_the_raw_one_is_taken_then_the_one_without_loss(tmp_path):
    broken = ("compressed", [("16UC1; jpeg compressed ", jpg(SMOOTH[0]))] * COUNT)
    raw, aligned = list(DRIVERS["realsense"])[::2]
    said = transported(("compressed", [("jpeg", jpg(SMOOTH[0] * 0))] * COUNT), broken, also=(raw, aligned))
    color, depth = frames_of(open_any(write_bag(tmp_path, said)))
    assert np.array_equal(color[1].load(False), SMOOTH[1]) and len(color) == len(depth) == COUNT
    said = [message for message in said if message[0] != aligned]
    said += [m for m in transported(PICTURES["png"], DEPTH_CODES["16 bits"]) if "compressedDepth" in m[0]]
    _, depth = frames_of(open_any(write_bag(tmp_path, sorted(said, key=lambda message: message[2]))))
    assert np.array_equal(depth[2].load(False), DEPTH_MM[2] / 1000)


def test_what_is_compressed_in_another_way_is_named(tmp_path):
    for codes, told in (
        (
            ("compressedDepth", [("16UC1; compressedDepth rvl", BEFORE + bytes(99))] * COUNT),
            "compressedDepth rvl', not one",
        ),
        (("compressed", [("16UC1; jpeg compressed ", jpg(SMOOTH[0]))] * COUNT), "jpeg compressed ', not one of mono16"),
        (("compressed", [("png", b"no picture")] * COUNT), "has no images of depth"),
    ):
        refused(write_bag(tmp_path, transported(PICTURES["jpeg"], codes)), told)
    said = transported(PICTURES["jpeg"], DEPTH_CODES["16 bits"])
    video = ("/camera/color/image_raw/theora", VIDEO, STAMPS_US[0], header(0) + block(bytes(16)))
    bag = write_bag(tmp_path, [video, *(m for m in said if "color/image_raw/" not in m[0] or "aligned" in m[0])])
    refused(bag, "no images of colour; /camera/color/image_raw/theora is video .*: convert it to raw")
    damaged = ("compressed", [*PICTURES["jpeg"][1][:2], ("jpeg", PICTURES["jpeg"][1][2][1][:300])])
    color, _ = frames_of(open_any(write_bag(tmp_path, transported(damaged, DEPTH_CODES["16 bits"]))))
    assert color[1].load(False) is not None


def test_a_drivers_bag_needs_depth_registered_to_colour(tmp_path):
    color, raw, aligned, _ = DRIVERS["realsense"]
    with pytest.raises(CaptureError, match="aligned_depth_to_color of a RealSense or depth_to_rgb of an Azure Kinect"):
        open_any(write_bag(tmp_path, published({name: DRIVERS["realsense"][name] for name in (color, raw)})))
    said = published({name: DRIVERS["realsense"][name] for name in (color, aligned)})
    bare = write_bag(tmp_path, [message for message in said if "color/camera_info" not in message[0]])
    with pytest.raises(CaptureError, match="no camera_info for /camera/color/image_raw: describe it in a camera"):
        imported(bare, tmp_path / "no")
    assert np.array_equal(read_view(imported(bare, tmp_path / "given", fx=70.0)[1], 2).rgb, SMOOTH[2])


# ---------------------------------------------------------------------------------------------- what is refused


def everything(path):
    """Opens a recording and loads all of it, as an import does."""
    recording = open_any(path)
    for frame in recording.frames():
        frame.load(False)
    return recording


def refused(path, told):
    with pytest.raises((CaptureError, PictureError), match=told) as error:
        everything(path)
    assert "\n" not in str(error.value)


def test_what_cannot_be_read_is_named_in_one_line(tmp_path):
    for name, data, told in (
        ("a.db3", b"SQLite format 3\0" + bytes(64), "a.db3 cannot be read: .*: `ros2 bag reindex FOLDER`"),
        ("a.mcap", b"\x89MCAP0\r\n", "a.mcap cannot be read: .*: `mcap recover FILE`"),
        ("a.mp4", b"\0\0\0\x18ftypmp42", "is a video alone"),
        ("a.txt", b"hello", "none of the formats that are read: an Azure Kinect"),
        ("a.r3d", b"PK\5\6" + bytes(18), "none of the formats"),
        ("a.mkv", b"hello", "cannot be read as a Matroska file"),
        ("a.bag", b"", "has no bytes"),
        ("b.mkv", recording(1).replace(b"V_MS/VFW/FOURCC", b"V_XX/XXX/XXXXXX"), "b.mkv cannot be read: "),
    ):
        write(tmp_path / name, data)
        refused(tmp_path / name, told)
    refused(tmp_path / "none", "no such file or folder")
    refused(tmp_path, "none of the formats")


def test_hostile_folders_end_in_one_line(tmp_path):
    def changed(kind, name, data, told):
        path = WRITTEN[kind](tmp_path / str(len(list(tmp_path.iterdir()))))
        write(path / name, data)
        refused(path, told)

    K = [FX, 0, CX, 0, FY, CY, 0, 0, 1]
    bomb = png(np.zeros((12_000, 12_000), np.uint8))
    changed("tum", "rgb.txt", "1.0 ../../../etc/passwd\n", "which is not in it")
    changed("tum", "rgb.txt", "1.0 rgb/a\0b.png\n", "embedded null byte")
    changed("tum", "rgb.txt", "nan rgb/1.png\n", "is not a time in seconds and a file")
    changed("tum", "rgb.txt", "# none\n", "names no image")
    changed("tum", "depth.txt", "1.0 depth/none.png\n", "cannot be read: No such file")
    changed(
        "tum", f"depth/{(STAMPS_US[0] + 7_000) / 1e6:.6f}.png", bomb, "is 12000 x 12000, and its camera has 640 x 480"
    )
    changed(
        "tum",
        f"rgb/{STAMPS_US[1] / 1e6:.6f}.png",
        png(SMOOTH[1].repeat(TUM_STEP, 0).repeat(TUM_STEP, 1))[:100],
        "no image that can be read",
    )
    changed("bop", "scene_camera.json", '{"0": {"cam_K": [NaN]}}', "NaN is no number of JSON")
    changed("bop", "scene_camera.json", json.dumps({"0": {"cam_K": K}}), "depth_scale is None")
    changed(
        "bop",
        "scene_camera.json",
        json.dumps({"0": {"cam_K": [-1, *K[1:]], "depth_scale": 1}}),
        "its intrinsics cannot be read",
    )
    changed("bop", "scene_camera.json", json.dumps({"9": {"cam_K": K, "depth_scale": 1}}), "has no rgb/000009.png")
    changed("bop", "scene_camera.json", "[" * 100_000, "RecursionError")
    changed("bop", "scene_camera.json", json.dumps({"9" * 5000: {"cam_K": K, "depth_scale": 1}}), "4300 digits")
    changed("bop", "depth/000001.png", png(SMOOTH[0]), "uint8 with 3 channels: depth has one")
    changed("open3d", "intrinsic.json", "{}", "no intrinsic_matrix of nine numbers")
    changed("open3d", "color/00009.jpg", jpg(SMOOTH[0]), "4 images in color/ and 3 in depth/")
    changed("polycam", "keyframes/cameras/7.json", "{}", "must be named by its time and have fx")
    changed("arkit", "lowres_wide/x.png", png(SMOOTH[0]), "must be named VIDEO_SECONDS")
    changed("arkit", "lowres_wide/1_9.png", png(SMOOTH[0]), "has no camera for 1_9.png")


def test_hostile_archives_end_in_one_line(tmp_path):
    for changes, told in (
        ({"K": None, "perFrameIntrinsicCoeffs": None}, "its intrinsics cannot be read"),
        ({"perFrameIntrinsicCoeffs": [[float("inf")] * 4] * 3}, "is no number of JSON"),
        ({"dw": 10**9}, "cannot be"),
        ({"dw": "wide"}, "its metadata cannot be read"),
        ({"dw": 17}, "has 768 bytes, and depth of 17 x 12 has 816"),
        ({"w": 640}, "is 64 x 48, and its camera has 640 x 48"),
        ({"frameTimestamps": [0.0]}, "its metadata cannot be read"),
    ):
        refused(write_record3d(tmp_path, **changes), told)
    whole = write_record3d(tmp_path).read_bytes()
    for data in (whole[: len(whole) // 2], whole[:100]):
        write(tmp_path / "cut.r3d", data)
        refused(tmp_path / "cut.r3d", "none of the formats")
    with zipfile.ZipFile(tmp_path / "bomb.r3d", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", b"0" * 300_000_000)
    refused(tmp_path / "bomb.r3d", "unpacks to more than 256 MB")
    with zipfile.ZipFile(io.BytesIO(whole)) as before, zipfile.ZipFile(tmp_path / "torn.r3d", "w") as after:
        for name in before.namelist():
            data = before.read(name)
            after.writestr(name, data[:30] if name.endswith("1.depth") else data)
    refused(tmp_path / "torn.r3d", "compressed by LZFSE, and cut or altered")


def test_hostile_bags_end_in_one_line(tmp_path):
    said = realsense()

    def but(topic, kind="{}", change=lambda data: data):
        return [(t, kind.format(k), u, change(d)) if topic in t else (t, k, u, d) for t, k, u, d in said]

    short = struct.pack("<II", H, W) + block("mono16") + struct.pack("<BI", 0, W) + block(bytes(H * W))
    for changed, told in (
        ([m for m in said if "Color" not in m[0]], "has no images of colour; it has /device_0"),
        ([m for m in said if "image" not in m[0]], "has no images of colour; it has no topic of images"),
        ([], "has no images of colour; it has no topic of images"),
        ([m for m in said if "camera_info" not in m[0]], "has no camera_info for"),
        ([m for m in said if "/tf/" not in m[0]], "does not say where the depth camera is"),
        (realsense((0.1,) * 5, "Kannala Brandt4"), "lens 'Kannala Brandt4' with .* is not read"),
        (realsense((float("nan"),) * 5), "lens 'Brown Conrady' with"),
        (but("Color", change=lambda data: data.replace(b"rgb8", b"bay8")), "colour is 'bay8', not one of rgb8"),
        (but("Color_0/image", "sensor_msgs/msg/CompressedImage"), "no images of colour; it has /device_0"),
        (
            but("camera_info", change=lambda _: info(W, H, k=(float("nan"), FY, CX, CY))),
            "its intrinsics cannot be read",
        ),
        (but("camera_info", change=lambda data: data[:40]), "has no camera_info for"),
        (but("Depth_0/image", change=lambda _: header(0) + short), None),
    ):
        path = write_bag(tmp_path, changed)
        if told is not None:
            refused(path, told)
            continue
        assert [frame.load(False) for frame in frames_of(open_any(path))[1]] == [None] * COUNT  # rows too short


def bomb(path, kind):
    """A bag of a few hundred bytes, one chunk of which unpacks to over 9 GB, and its index."""
    packer = bz2.BZ2Compressor() if kind == "bag" else zstd.ZstdCompressor()
    packed = b"".join(packer.compress(bytes(1 << 24)) for _ in range(40)) + packer.flush()
    with pytest.MonkeyPatch.context() as patch:
        if kind == "bag":
            patch.setattr(rosbags.rosbag1.writer, "bz2_compress", lambda data, level: packed)
            return write_bag(path, compression="bz2")
        patch.setattr(rosbags.rosbag2.storage_mcap.zstd, "compress", lambda data: packed)
        return write_bag(path, compression="zstd", kind="mcap")


@pytest.mark.parametrize("kind", first_of(["mcap", "bag"], 1))
def test_a_chunk_that_unpacks_without_end_is_refused_before_it_fills_the_memory(kind, tmp_path):
    path = bomb(tmp_path, kind)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(path, "unpacks to more than 512 MB")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1_600_000


@pytest.mark.parametrize("kind", BAGS)
def test_a_bag_that_was_cut_or_altered_is_used_or_refused_with_the_command_that_mends_it(kind, tmp_path):
    path = write_bag(tmp_path, kind=kind)
    file = path if kind == "bag" else path / f"shot.{kind}"
    whole, mends = file.read_bytes(), {"bag": "rosbag reindex", "db3": "ros2 bag reindex", "mcap": "mcap recover"}[kind]
    for share in (0.05, 0.5, 0.99):
        file.write_bytes(whole[: int(share * len(whole))])
        refused(path, f"cannot be read: .*: `{mends} F")
    rng = np.random.default_rng(0)
    for _ in range(25):  # any byte may be another: the frames that are left, or one line
        data = bytearray(whole)
        for at in rng.integers(13, len(data), 20):
            data[at] = rng.integers(256)
        file.write_bytes(bytes(data))
        with contextlib.suppress(CaptureError):
            everything(path)
