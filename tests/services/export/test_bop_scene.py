import shutil

from services.export.bop import NO_SHAPE
from services.job.record import require_job
from tests.exported import export_to
from workers.store.local import LocalStore


def test_a_pair_whose_hidden_object_has_no_shape_is_left_out(pile, tmp_path):
    shutil.copytree(pile.name, tmp_path / "copy")
    shutil.rmtree(tmp_path / "copy" / "assets")
    job, catalogue = tmp_path / "copy" / "job.yaml", require_job(pile).catalogue
    job.write_text(job.read_text().replace(catalogue, "f" * len(catalogue)))
    manifest = export_to(LocalStore(tmp_path / "copy"), tmp_path / "new", "bop").manifest
    assert manifest["left_out"] == {NO_SHAPE: 1}
    assert manifest["models"] == 0 and any(line.startswith("3 models") for line in manifest["not_exported"])
    assert not (tmp_path / "new" / "train").exists()
