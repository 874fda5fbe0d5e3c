"""The stack's environment, set at the start of every Python in the image, also of `ray start`.

The image's ENV lines hold what is the same on every processor. OPENBLAS_CORETYPE is not: a processor without AVX2 must
not have it, and a shell's or an entry point's setting would not reach what is started beside them.
"""

import os

from schemas.environment import settings_to_change
from services.cli.environment import processor_flags

os.environ.update(settings_to_change(os.environ, processor_flags()))  # noqa: TID251 - before anything else reads it
