"""Recordings of a made-up Azure Kinect: a marker board with a sphere on it, whose depth is known exactly in both cameras.

Modes 1280 x 720 and NFOV_2X2BINNED, which are the smallest. Rays and projections are OpenCV's, both lenses are far from zero.
The Matroska file is written from the published descriptions ("Azure Kinect record file format", RFC 9559 for the elements) and
shares no code with the reader: tracks with codec V_MS/VFW/FOURCC and a BITMAPINFOHEADER, time stamps in microseconds, one
SimpleBlock a frame, tags K4A_..., and the attachment calibration.json.
"""

import dataclasses
import functools
import json
import struct
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from schemas.job.captures import Board
from schemas.scene.view import Intrinsics
from tests.workers.capture.drawn import printed
from tests.workers.geometry.made_up_kinect import COLOR_LENS, DEPTH_LENS, T_COLOR_DEPTH, opencv_rays, sphere_depth
from workers.geometry.camera import look_at

MICROSECONDS = 1000
"""TimestampScale, nanoseconds."""


def number(value: int) -> bytes:
    return value.to_bytes(max((value.bit_length() + 7) // 8, 1), "big")


def element(identity: int, payload: bytes | int | str) -> bytes:
    if isinstance(payload, int):
        payload = number(payload)
    elif isinstance(payload, str):
        payload = payload.encode()
    size = (len(payload) | 1 << 56).to_bytes(8, "big")  # always eight bytes long
    return number(identity) + size + payload


def bitmap_header(width: int, height: int, fourcc: bytes, bits: int) -> bytes:
    """BITMAPINFOHEADER: 40 bytes, little-endian."""
    return struct.pack("<IiiHH4sIiiII", 40, width, height, 1, bits, fourcc, 0, 0, 0, 0, 0)


@dataclass(frozen=True)
class Track:
    """A video track; `frames` are (time stamp in microseconds, bytes)."""

    name: str
    width: int
    height: int
    fourcc: bytes
    frames: list[tuple[int, bytes]]
    tags: dict[str, str] = field(default_factory=dict)
    bits: int = 16


IMU_TRACK = 9
"""Number of the track of inertial samples, which every recording of a device has unless it was switched off."""


def tag(name: str, value: str, track_uid: int = 0, attachment_uid: int = 0) -> bytes:
    targets = b""
    if track_uid:
        targets = element(0x63CA, "TRACK") + element(0x63C5, track_uid)
    if attachment_uid:
        targets = element(0x63CA, "ATTACHMENT") + element(0x63C6, attachment_uid)
    return element(0x7373, element(0x63C0, targets) + element(0x67C8, element(0x45A3, name) + element(0x4487, value)))


def write_recording(
    tracks: list[Track],
    calibration: bytes | None,
    tags: dict[str, str],
    fps: int = 30,
    closed: bool = True,
    cluster_us: int = 32_000,
) -> bytes:
    """The bytes of a whole file; `closed`: its length is in its head, as the last time stamp."""
    head = element(
        0x1A45DFA3,
        element(0x4286, 1) + element(0x42F7, 1) + element(0x42F2, 4) + element(0x42F3, 8)
        + element(0x4282, "matroska") + element(0x4287, 2) + element(0x4285, 2),
    )  # fmt: skip
    last = max((stamp for track in tracks for stamp, _ in track.frames), default=0)
    info = element(0x2AD7B1, MICROSECONDS) + element(0x4D80, "libmatroska-1.4.9") + element(0x5741, "k4arecord-1.4.1")
    if closed:
        info += element(0x4489, struct.pack(">d", last))
    entries, all_tags, blocks = b"", b"", []
    for n, track in enumerate(tracks, start=1):
        uid = 7_000_000_000 + n
        entries += element(0xAE, (
            element(0xD7, n) + element(0x73C5, uid) + element(0x83, 1) + element(0x536E, track.name)
            + element(0x86, "V_MS/VFW/FOURCC") + element(0x23E383, round(1e9 / fps))
            + element(0x63A2, bitmap_header(track.width, track.height, track.fourcc, track.bits))
            + element(0xE0, element(0xB0, track.width) + element(0xBA, track.height))
        ))  # fmt: skip
        all_tags += tag(f"K4A_{track.name}_TRACK", str(uid), uid)
        all_tags += b"".join(tag(name, value, uid) for name, value in track.tags.items())
        blocks += [(stamp, n, data) for stamp, data in track.frames]
    imu = element(0xD7, IMU_TRACK) + element(0x73C5, 7_000_000_999) + element(0x83, 0x11) + element(0x536E, "IMU")
    entries += element(0xAE, imu + element(0x86, "S_K4A/IMU"))
    all_tags += tag("K4A_IMU_TRACK", "7000000999", 7_000_000_999) + tag("K4A_IMU_MODE", "ON", 7_000_000_999)
    all_tags += b"".join(tag(name, value) for name, value in tags.items())
    body = element(0x1549A966, info) + element(0x1654AE6B, entries)
    if calibration is not None:
        file = element(0x466E, "calibration.json") + element(0x4660, "application/octet-stream")
        body += element(0x1941A469, element(0x61A7, file + element(0x465C, calibration) + element(0x46AE, 99)))
        all_tags += tag("K4A_CALIBRATION_FILE", "calibration.json", attachment_uid=99)
    body += element(0x1254C367, all_tags)
    return head + element(0x18538067, body + b"".join(clusters(sorted(blocks), cluster_us)))


def clusters(blocks: list[tuple[int, int, bytes]], length_us: int) -> list[bytes]:
    made: list[bytes] = []
    while blocks:
        start = blocks[0][0]
        inside = [block for block in blocks if block[0] < start + length_us]
        blocks = blocks[len(inside) :]
        simple = [
            element(0xA3, bytes([0x80 | track]) + struct.pack(">hB", stamp - start, 0x80) + data)
            for stamp, track, data in inside
        ]
        samples = element(0xA1, bytes([0x80 | IMU_TRACK]) + bytes(3) + bytes(48))
        group = element(0xA0, samples + element(0x9B, 20_000))
        checksum = element(0xBF, bytes(4))  # readers do not check it; the device's is right
        made.append(element(0x1F43B675, checksum + element(0xE7, start) + b"".join(simple) + group))
    return made


# ---------------------------------------------------------------------------------------------- what it shows

COLOR = Intrinsics(width=1280, height=720, fx=608.2, fy=607.9, cx=641.3, cy=365.9)
DEPTH = Intrinsics(width=320, height=288, fx=252.2, fy=252.3, cx=160.7, cy=168.9)
BOARD = Board()
RADIUS_M = 0.05
CENTRE = np.array([0.0, 0.04, RADIUS_M])
PX_PER_M = 1000.0
PERIOD_US = 33_333
START_US = 1_234
DEPTH_DELAY_US = 160


def sensor_parameters(k: Intrinsics, sensor: tuple[int, int], cut: tuple[int, int], lens: np.ndarray) -> list[float]:
    """The 14 numbers of the device's calibration file."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (float(x) for x in lens)
    across, down = sensor
    place = [(k.cx + cut[0]) / across, (k.cy + cut[1]) / down, k.fx / across, k.fy / down]
    return [*place, k1, k2, k3, k4, k5, k6, 0, 0, p2, p1]


def camera_entry(location: str, parameters: list[float], T: np.ndarray, sensor: tuple[int, int]) -> dict:
    return {
        "Intrinsics": {
            "ModelParameterCount": 14,
            "ModelParameters": parameters,
            "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
        },
        "Location": f"CALIBRATION_CameraLocation{location}",
        "Purpose": "CALIBRATION_CameraPurposeAny",
        "MetricRadius": 1.74,
        "Rt": {"Rotation": T[:3, :3].ravel().tolist(), "Translation": T[:3, 3].tolist()},
        "SensorWidth": sensor[0],
        "SensorHeight": sensor[1],
        "Shutter": "CALIBRATION_ShutterTypeUndefined",
    }


def calibration() -> dict:
    """calibration.json of COLOR and DEPTH, as the device writes it."""
    depth = sensor_parameters(DEPTH, (512, 512), (96, 90), DEPTH_LENS)
    color = sensor_parameters(COLOR, (1280, 960), (0, 120), COLOR_LENS)
    cameras = [
        camera_entry("D0", depth, np.eye(4), (1024, 1024)),
        camera_entry("PV0", color, np.asarray(T_COLOR_DEPTH), (4096, 3072)),
    ]
    return {"CalibrationInformation": {"Cameras": cameras, "InertialSensors": [], "Metadata": {"SerialId": "0"}}}


@functools.cache
def rays(name: str) -> np.ndarray:
    k, lens = {"color": (COLOR, COLOR_LENS), "depth": (DEPTH, DEPTH_LENS)}[name]
    return opencv_rays(k, np.asarray(lens))


def poses(count: int) -> list[np.ndarray]:
    """T_board_cam of the colour camera: an arc round the board."""
    made = []
    for angle in np.linspace(-2.2, 0.9, count):
        position = np.array([0.55 * np.cos(angle), 0.55 * np.sin(angle), 0.5 + 0.05 * np.sin(3 * angle)])
        made.append(look_at(position, np.array([0.0, 0.0, 0.02])))
    return made


def true_depth(name: str, T_board_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([h, w] z, metres, [h, w] bool of the sphere) in the camera `color` or `depth` when the colour camera is at a pose."""
    T = T_board_cam if name == "color" else T_board_cam @ T_COLOR_DEPTH
    R, t = T[:3, :3], T[:3, 3]
    with np.errstate(divide="ignore"):
        table = -t[2] / (rays(name) @ R[2])
    ball = sphere_depth(rays(name), R.T @ (CENTRE - t), RADIUS_M)
    return np.where(ball > 0, ball, np.where(table > 0, table, 0.0)), ball > 0


@functools.cache
def picture() -> np.ndarray:
    return cv2.resize(printed(BOARD), None, fx=PX_PER_M / 4000, fy=PX_PER_M / 4000, interpolation=cv2.INTER_AREA)


def photograph(T_board_cam: np.ndarray) -> np.ndarray:
    """[720, 1280, 3] uint8 RGB."""
    z, ball = true_depth("color", T_board_cam)
    at = (rays("color") * z[:, :, None]) @ T_board_cam[:3, :3].T + T_board_cam[:3, 3]
    u = ((at[:, :, 0] + 0.5 * BOARD.width_m) * PX_PER_M - 0.5).astype(np.float32)
    v = ((0.5 * BOARD.height_m - at[:, :, 1]) * PX_PER_M - 0.5).astype(np.float32)
    gray = cv2.remap(picture(), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=120)
    rgb = np.repeat(np.where(ball, 200, gray)[:, :, None], 3, axis=2).astype(np.uint8)
    rgb[ball, 2] = 40
    return rgb


def color_bytes(rgb: np.ndarray, fourcc: str) -> bytes:
    if fourcc == "MJPG":
        return cv2.imencode(".jpg", rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    if fourcc == "BGRA":
        return cv2.cvtColor(rgb, cv2.COLOR_RGB2BGRA).tobytes()
    if fourcc == "YUY2":
        return cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_YUY2).tobytes()
    planar = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420)  # NV12 has the two colour planes interleaved
    height, width = rgb.shape[:2]
    chroma = planar[height:].reshape(2, -1)
    return planar[:height].tobytes() + chroma.T.tobytes()[: width * height // 2]


@functools.cache
def frames(count: int, fourcc: str = "MJPG") -> tuple[list[tuple[int, bytes]], list[tuple[int, bytes]]]:
    """Colour and depth frames with their time stamps, the depth camera a little later, as the device has it."""
    color, depth = [], []
    for i, T in enumerate(poses(count)):
        stamp = START_US + i * PERIOD_US
        color.append((stamp, color_bytes(photograph(T), fourcc)))
        depth_mm = np.rint(true_depth("depth", T)[0] * 1000.0).astype(">u2")
        depth.append((stamp + DEPTH_DELAY_US, depth_mm.tobytes()))
    return color, depth


def tracks(count: int, fourcc: str = "MJPG") -> list[Track]:
    """COLOR, DEPTH and IR as the recorder writes them."""
    color, depth = frames(count, fourcc)
    mode = {"K4A_COLOR_MODE": f"{fourcc}_720P"}
    return [
        Track("COLOR", 1280, 720, fourcc.encode(), color, mode, 24),
        Track("DEPTH", 320, 288, b"b16g", depth, {"K4A_DEPTH_MODE": "NFOV_2X2BINNED"}),
        Track("IR", 320, 288, b"b16g", depth, {"K4A_IR_MODE": "ACTIVE"}),
    ]


TAGS = {
    "K4A_DEPTH_DELAY_NS": str(DEPTH_DELAY_US * 1000),
    "K4A_WIRED_SYNC_MODE": "STANDALONE",
    "K4A_DEVICE_SERIAL_NUMBER": "000123",
}


def recording(count: int = 4, fourcc: str = "MJPG", **settings: Any) -> bytes:
    """The bytes of a whole recording."""
    return write_recording(tracks(count, fourcc), json.dumps(calibration()).encode(), TAGS, **settings)


def without(made: list[Track], name: str) -> list[Track]:
    return [track for track in made if track.name != name]


def renamed(made: list[Track], name: str, **changes: Any) -> list[Track]:
    return [dataclasses.replace(track, **changes) if track.name == name else track for track in made]
