"""The package `datasets` goes to no network, and writes nothing into the user's cache."""

import os
import tempfile

FOLDER = tempfile.TemporaryDirectory(prefix="verso-tests-hf-")
# Read when it is imported.
os.environ.update(HF_HUB_OFFLINE="1", HF_HUB_DISABLE_TELEMETRY="1", HF_HOME=FOLDER.name)
