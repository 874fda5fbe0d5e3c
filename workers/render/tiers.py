"""Whether the packages of a tier of rendering are installed. Importing this module loads none of them."""

import ctypes
import importlib.util

from schemas.errors import InputError
from schemas.job.views import Render

SYSTEM_LIBRARY = "libatomic.so.1"
"""A library of the compiler's run time: Mitsuba's wheel does not bring it, and small images of Debian lack it."""

REMEDY = "`./verso extra pathtraced` installs it (mitsuba==3.9.1), or set render.tier to raster or flat"


def require_mitsuba() -> None:
    """Raises InputError, with the remedy, where Mitsuba or the system library that it loads is missing."""
    if importlib.util.find_spec("mitsuba") is None:
        raise InputError(f"render.tier is pathtraced, and Mitsuba is not installed: {REMEDY}")
    try:
        ctypes.CDLL(SYSTEM_LIBRARY)
    except OSError as error:
        remedy = "on Debian or Ubuntu: apt-get install -y libatomic1"
        raise InputError(
            f"render.tier is pathtraced, and Mitsuba needs {SYSTEM_LIBRARY} ({error}): {remedy}"
        ) from error


def require_tier(render: Render) -> None:
    """Raises InputError, with the remedy, where the tier's packages are not installed."""
    if render.tier == "pathtraced" and render.rgb:
        require_mitsuba()
