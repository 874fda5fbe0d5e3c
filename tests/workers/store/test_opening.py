import subprocess
import sys

import pytest

from schemas.errors import OutputError
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore
from workers.store.opening import open_store


def test_opening_a_folder_loads_no_object_store(tmp_path):
    code = (
        "import sys; from workers.store.opening import open_store; "
        f"open_store({str(tmp_path)!r}); sys.exit('obstore' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert isinstance(open_store(str(tmp_path)), LocalStore)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("url", ["s3://", "ftp://host/x", "az://c/x"])
def test_a_url_that_names_no_store_is_an_error_of_the_command_line(url):
    with pytest.raises(OutputError, match="is not an object store that can be opened"):
        open_store(url)


def test_a_url_that_names_a_store_is_opened_with_its_prefix():
    store = open_store("s3://bucket/a/dataset")
    assert isinstance(store, ObjectStore)
    assert store.name == "s3://bucket/a/dataset"
    assert store._bucket.prefix == "a/dataset"
