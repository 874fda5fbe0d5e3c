"""Which files a mesh refers to."""

from schemas.job.assets import MeshLimits
from tests.workers.assets.oracles import CUBE, write
from workers.assets.external.formats import list_mesh_files, material_files


def test_material_files_are_found_wherever_they_are_named():
    text = b"# xmtllib no\r\nmtllib a b.mtl\r\nv 0 0 0\nmtllib c.mtl\n"
    assert material_files(text) == ["a b.mtl", "c.mtl"]
    assert material_files(b"mtllib first.mtl") == ["first.mtl"]


def test_an_obj_comes_with_its_materials_and_their_textures(tmp_path):
    write(tmp_path / "m" / "cube.obj", "mtllib cube.mtl\n" + CUBE)
    write(tmp_path / "m" / "cube.mtl", "newmtl a\nmap_Kd ../t/a.png\nnewmtl b\nmap_Kd none.png\n")
    write(tmp_path / "t" / "a.png", b"png")
    files = list_mesh_files(tmp_path / "m" / "cube.obj", tmp_path, MeshLimits())
    assert [file.relative_to(tmp_path).as_posix() for file in files] == ["m/cube.obj", "m/cube.mtl", "t/a.png"]
