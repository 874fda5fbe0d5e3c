"""A minimal writer of Matroska files with the layout of an Azure Kinect recording.

Written from the published description of the format ("Azure Kinect record file format", RFC 9559 for the elements): tracks
COLOR and DEPTH with codec V_MS/VFW/FOURCC and a BITMAPINFOHEADER, time stamps in microseconds, one SimpleBlock a frame,
tags K4A_..., and the attachment calibration.json. It shares no code with the reader.
"""

import struct
from dataclasses import dataclass, field

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
    duration: bool = False,
    cluster_us: int = 32_000,
) -> bytes:
    """The bytes of a whole file; `duration` writes the length of the recording into its head."""
    head = element(
        0x1A45DFA3,
        element(0x4286, 1) + element(0x42F7, 1) + element(0x42F2, 4) + element(0x42F3, 8)
        + element(0x4282, "matroska") + element(0x4287, 2) + element(0x4285, 2),
    )  # fmt: skip
    last = max((stamp for track in tracks for stamp, _ in track.frames), default=0)
    info = element(0x2AD7B1, MICROSECONDS) + element(0x4D80, "libmatroska-1.4.9") + element(0x5741, "k4arecord-1.4.1")
    if duration:
        info += element(0x4489, struct.pack(">d", last + 1e6 / fps))
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
