from services.read.verdict import PathIndex


def test_paths_and_their_folders_are_known_and_nothing_else(tmp_path):
    index = PathIndex(tmp_path)
    assert index.add("mug/RGB00000.png", "a") is None
    assert index.add("mug/RGB00000.png", "b") == "a"
    index.add_all(["assets/mug/one.glb", "assets/mug/one.glb", "strange\udcff/name"])
    assert "mug/RGB00000.png" in index and "strange\udcff/name" in index
    assert "mug" not in index and "mug/RGB0000" not in index
    index.close()
