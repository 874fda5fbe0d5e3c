"""Which device draws, and what is said where none can."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from schemas.errors import MachineError
from workers.render.raster.context import is_software, require_device

ROOT = Path(__file__).resolve().parents[4]


@pytest.mark.parametrize(
    ("name", "software"),
    [
        ("llvmpipe (LLVM 15.0.6, 256 bits)", True),
        ("softpipe", True),
        ("Software Rasterizer", True),
        ("SWR (LLVM 11.0.0, 256 bits)", True),
        ("ANGLE (Google, Vulkan 1.3.0 (SwiftShader Device (LLVM 10.0.0) (0x0000C0DE)), SwiftShader driver)", True),
        ("NVIDIA H100 80GB HBM3/PCIe/SSE2", False),
        ("Mesa Intel(R) UHD Graphics 630 (CFL GT2)", False),
        ("AMD Radeon RX 6800 (radeonsi, navi21, LLVM 15.0.7, DRM 3.49, 6.1.0)", False),
    ],
)
def test_software_is_told_from_a_gpu_by_its_name(name, software):
    assert is_software(name) == software


def test_software_is_refused_only_where_a_gpu_is_asked_for():
    require_device("llvmpipe (LLVM 15.0.6, 256 bits)", "any")
    require_device("NVIDIA H100 80GB HBM3/PCIe/SSE2", "gpu")
    with pytest.raises(MachineError, match=r"fell back to software.*llvmpipe.*set run.device: any"):
        require_device("llvmpipe (LLVM 15.0.6, 256 bits)", "gpu")


def test_a_machine_whose_egl_has_no_device_is_told_so():
    done = subprocess.run(
        [sys.executable, "-c", "from workers.render.raster.context import open_context; open_context()"],
        cwd=ROOT,
        env={**os.environ, "__EGL_VENDOR_LIBRARY_FILENAMES": "/dev/null"},
        capture_output=True,
        text=True,
        check=False,
    )
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("schemas.errors.MachineError: no OpenGL context could be opened (EGL has no device)")
    assert "apt-get install -y libgl1 libegl1 libgl1-mesa-dri" in last
