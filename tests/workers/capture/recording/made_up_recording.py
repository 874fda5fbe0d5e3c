"""A made-up Azure Kinect recording of a marker board with a sphere on it, whose depth is known exactly in both cameras.

Modes 1280 x 720 and NFOV_2X2BINNED, which are the smallest. Rays and projections are OpenCV's, both lenses are far from zero.
"""

import dataclasses
import functools
import json
from typing import Any

import cv2
import numpy as np

from schemas.job.captures import Board
from schemas.scene.view import Intrinsics
from tests.workers.capture.recording.matroska import Track, write_recording
from tests.workers.geometry.made_up_kinect import (
    COLOR_LENS,
    DEPTH_LENS,
    T_COLOR_DEPTH,
    opencv_rays,
    sphere_depth,
)
from workers.capture.board.sheets import draw_board
from workers.geometry.camera import look_at

COLOR = Intrinsics(width=1280, height=720, fx=608.2, fy=607.9, cx=641.3, cy=365.9)
DEPTH = Intrinsics(width=320, height=288, fx=252.2, fy=252.3, cx=160.7, cy=168.9)
BOARD = Board()
RADIUS_M = 0.05
CENTRE = np.array([0.0, 0.04, RADIUS_M])
PX_PER_M = 900.0
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
def texture() -> np.ndarray:
    return draw_board(BOARD, PX_PER_M)


def photograph(T_board_cam: np.ndarray) -> np.ndarray:
    """[720, 1280, 3] uint8 RGB."""
    z, ball = true_depth("color", T_board_cam)
    at = (rays("color") * z[:, :, None]) @ T_board_cam[:3, :3].T + T_board_cam[:3, 3]
    u = ((at[:, :, 0] + 0.5 * BOARD.width_m) * PX_PER_M - 0.5).astype(np.float32)
    v = ((0.5 * BOARD.height_m - at[:, :, 1]) * PX_PER_M - 0.5).astype(np.float32)
    gray = cv2.remap(texture(), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=120)
    rgb = np.repeat(np.where(ball, 200, gray)[:, :, None], 3, axis=2).astype(np.uint8)
    rgb[ball, 2] = 40
    return rgb


def depth_bytes(T_board_cam: np.ndarray) -> bytes:
    return np.rint(true_depth("depth", T_board_cam)[0] * 1000.0).astype(">u2").tobytes()


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
        depth.append((stamp + DEPTH_DELAY_US, depth_bytes(T)))
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
